"""
How accurate is the network, compared with other methods?
=========================================================

This example compares the released network with two other methods on the same 1,000 presses. The nearest of 20,000 known
presses has a position error of more than three times that of the network. The error of a polynomial of degree 9 is
about a sixth larger than the error of the network.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.linear_model import Ridge
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from isocharge.serve import Predictor
from isocharge.simulate import ChargeSpline, Circle, ForwardMap, Sweep, load_sensor, noise_model

RADIUS_mm = 8.0
FORCE_RANGE_N = (0.05, 2.0)
charge_map = ChargeSpline.of(ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1.0), RADIUS_mm, FORCE_RANGE_N))


def presses(samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Simulate presses, and return their contacts (x, y, force; mm and N) and their charges with noise (pC)."""
    contact = Sweep(RADIUS_mm, FORCE_RANGE_N, samples, seed).contacts()
    return contact, noise_model("reference").add(charge_map.charges(contact), np.random.default_rng(seed))


known, known_charge = presses(20_000, 1)
contact, charge = presses(1000, 2)
nearest = KNeighborsRegressor(1).fit(np.log(known_charge), known[:, :2])
polynomial = make_pipeline(StandardScaler(), PolynomialFeatures(9), Ridge(1e-2)).fit(np.log(known_charge), known[:, :2])
answers = {
    "nearest of 20,000": nearest.predict(np.log(charge)),
    "polynomial of degree 9": polynomial.predict(np.log(charge)),
    "released network": np.stack(Predictor("three-25um-biaxial").predict_batch(charge)[:2], axis=1),
}
for name, position in answers.items():
    error = np.hypot(*(position - contact[:, :2]).T)
    print(f"{name:<24} median {np.median(error):.3f} mm, rms {np.sqrt(np.mean(error**2)):.3f} mm")
    plt.plot(np.sort(error), np.linspace(0.0, 1.0, len(error)), label=name)
plt.gca().set(xscale="log", xlim=(1e-3, 10.0), xlabel="position error, mm", ylabel="share of presses")
plt.legend()
plt.show()
