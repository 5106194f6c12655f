"""
How accurate is the network, compared with other methods?
=========================================================

The Bayes limit is the smallest mean square error that any method can reach. This example compares three methods with
this limit. The nearest of 20,000 known presses has a position error of more than three times the limit. The error of a
polynomial of degree 9 is about a fifth larger than the limit, and the error of the released network about 3 % larger.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.linear_model import Ridge
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from isocharge.serve import Predictor
from isocharge.simulate import ChargeSpline, Circle, Sweep, load_sensor, noise_model
from isocharge.train import BayesProblem, bayes_estimate

problem = BayesProblem(load_sensor("three-25um-biaxial"), Circle(1.0), radius=8.0, force_range=(0.05, 2.0))
charge_map = ChargeSpline.of(problem.forward_map())


def presses(samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Simulate presses, and return their contacts (x, y, force; mm and N) and their charges with noise (pC)."""
    contact = Sweep(problem.radius, problem.force_range, samples, seed).contacts()
    return contact, noise_model("reference").add(charge_map.charges(contact), np.random.default_rng(seed))


known, known_charge = presses(20_000, 1)
contact, charge = presses(1000, 2)
nearest = KNeighborsRegressor(1).fit(np.log(known_charge), known[:, :2])
polynomial = make_pipeline(StandardScaler(), PolynomialFeatures(9), Ridge(1e-2)).fit(np.log(known_charge), known[:, :2])
answers = {
    "nearest of 20,000": nearest.predict(np.log(charge)),
    "polynomial of degree 9": polynomial.predict(np.log(charge)),
    "released network": np.stack(Predictor("three-25um-biaxial").predict_batch(charge)[:2], axis=1),
    "Bayes limit": bayes_estimate(problem, charge)[0][:, :2],
}
for name, position in answers.items():
    error = np.hypot(*(position - contact[:, :2]).T)
    print(f"{name:<24} median {np.median(error):.3f} mm, rms {np.sqrt(np.mean(error**2)):.3f} mm")
    plt.plot(np.sort(error), np.linspace(0.0, 1.0, len(error)), label=name)
plt.gca().set(xscale="log", xlim=(1e-3, 10.0), xlabel="position error, mm", ylabel="share of presses")
plt.legend()
plt.show()
