"""
Does it work on data that others measured?
==========================================

The authors of "Tactile Perception through Fluid-Solid Interaction" (TactileFSI, SDU Soft Robotics, CC BY 4.0) measured
a soft pad of 60 x 60 mm with four pressure channels. The pad has no piezoelectric film, so the simulator cannot compute
its channels. A model is therefore fitted to the measured presses alone. The errors of the model are measured at places
that were not used for the fit, and compared with those of boosted trees. At these places, the intervals of the model
contain about the stated share of the presses.
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
_, place_number = np.unique(presses.contact[:, :2], axis=0, return_inverse=True)
place_number = place_number.ravel()
shuffled_places = np.random.default_rng(0).permutation(place_number.max() + 1)
is_held_out = shuffled_places[place_number] % 5 == 0  # all presses at a fifth of the places
training_presses = presses[~is_held_out]
test_presses = presses[is_held_out]
n_test_places = len(np.unique(place_number[is_held_out]))
with tempfile.TemporaryDirectory() as temporary:
    model = release(fit_presses(training_presses, "pad"), Path(temporary) / "pad")
    answers = Predictor(model.folder).predict_batch(test_presses.charge_pC)
trees = [
    HistGradientBoostingRegressor().fit(training_presses.charge_pC, training_presses.contact[:, axis])
    for axis in (0, 1)
]
positions = {
    "model": np.stack([answers.x_mm, answers.y_mm], axis=1),
    "boosted trees": np.stack([tree.predict(test_presses.charge_pC) for tree in trees], axis=1),
}
for name, position in positions.items():
    error = np.hypot(*(position - test_presses.contact[:, :2]).T)
    print(f"{name}: position error {np.sqrt(np.mean(error**2)):.2f} mm rms at {n_test_places} held-out places")
    plt.plot(np.sort(error), np.linspace(0.0, 1.0, len(error)), label=name)
x_error = np.abs(answers.x_mm - test_presses.contact[:, 0])
for stated_percent, n_std in ((68, 1.0), (95, 2.0)):
    is_inside = x_error < n_std * answers.x_std_mm
    print(f"the {stated_percent} % intervals of x contain {100 * is_inside.mean():.0f} % of the presses")
plt.gca().set(xlabel="position error at held-out places, mm", ylabel="share of presses", xlim=(0.0, 25.0))
plt.legend()
plt.show()
