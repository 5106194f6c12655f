"""
Does it work on data that others measured?
==========================================

A soft pad of 60 x 60 mm with four pressure channels, measured by the authors of "Tactile Perception through Fluid-Solid
Interaction" (TactileFSI, SDU Soft Robotics, CC BY 4.0). No film, no simulator: a model is fitted to presses alone and
judged at places that it never saw, beside boosted trees. The intervals that it states hold there.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from isocharge.serve import Predictor, read_presses
from isocharge.train import fit_presses, release

presses = read_presses(Path(sys.argv[0]).resolve().parents[2] / "tests" / "data" / "tactile_fsi.csv")
number = np.unique(presses.contact[:, :2], axis=0, return_inverse=True)[1].ravel()  # of its place
unseen = np.random.default_rng(0).permutation(number.max() + 1)[number] % 5 == 0
known = presses[~unseen]
tested = presses[unseen]
with tempfile.TemporaryDirectory() as temporary:
    model = release(fit_presses(known, "pad"), Path(temporary) / "pad")
    answers = Predictor(model.folder).predict_batch(tested.charge_pC)
trees = [HistGradientBoostingRegressor().fit(known.charge_pC, known.contact[:, axis]) for axis in (0, 1)]
positions = {
    "our model": np.stack([answers.x_mm, answers.y_mm], axis=1),
    "boosted trees": np.stack([tree.predict(tested.charge_pC) for tree in trees], axis=1),
}
for name, position in positions.items():
    error = np.hypot(*(position - tested.contact[:, :2]).T)
    print(f"{name}: {np.sqrt(np.mean(error**2)):.2f} mm rms at {len(np.unique(number[unseen]))} unseen places")
    plt.plot(np.sort(error), np.linspace(0.0, 1.0, len(error)), label=name)
for share, sigmas in ((68, 1.0), (95, 2.0)):
    held = np.abs(positions["our model"][:, 0] - tested.contact[:, 0]) < sigmas * answers.x_std_mm
    print(f"{share} % intervals of x hold {100 * held.mean():.0f} %")
plt.gca().set(xlabel="position error at unseen places, mm", ylabel="share of presses", xlim=(0.0, 25.0))
plt.legend()
plt.show()
