"""
What does a model for a 1 mm tip report under a fingertip?
==========================================================

A fingertip touches the film in a circle of 4 to 8 mm radius, and its pressure falls off towards the edge of this
circle. The released models are for a rigid tip of 1 mm radius. This script compares such a model with a model that is
trained on presses of fingers. The training is short, so its errors are larger than those of a full training.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Predictor
from isocharge.simulate import Finger, ForwardMap, Sweep, load_sensor, noise_model, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train import FitConfig, TrainingConfig, fit, release

sensor = load_sensor("four-25um-biaxial")
film = ForwardMap.build(sensor, Finger(6.0))
with tempfile.TemporaryDirectory() as temporary:
    folder = Path(temporary)
    training_presses = read_dataset(write_sweep(folder / "presses", (film,), Sweep(samples=6000)))
    fresh_presses = read_dataset(write_sweep(folder / "fresh", (film,), Sweep(samples=2000, seed=1)))
    settings = FitConfig(training=TrainingConfig(steps=1500, misfit_steps=200, misfit_charges=4000))
    finger_model = release(fit(training_presses, settings), folder / "models" / "fingers")
    predictors = {
        "model for a tip of 1 mm": Predictor("four-25um-biaxial"),
        "model for fingers": Predictor(finger_model.folder),
    }

presses = fresh_presses.samples
charges = noise_model("reference").add(presses.charge_pC, np.random.default_rng(2))
figure, axes = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
for label, predictor in predictors.items():
    contacts = predictor.predict_batch(charges)
    position_error = np.hypot(contacts.x_mm - presses.x_mm, contacts.y_mm - presses.y_mm)
    relative_force_error = contacts.force_N / presses.force_N - 1.0
    flagged = np.mean([bool(set(flags) - {"stress"}) for flags in predictor.validity.batch_flags(contacts)])
    print(
        f"{label}: position {np.sqrt(np.mean(position_error**2)):.2f} mm rms, "
        f"force {100 * np.sqrt(np.mean(relative_force_error**2)):.1f} % rms, {100 * flagged:.0f} % flagged"
    )
    axes.plot(np.sort(position_error), np.linspace(0.0, 1.0, len(position_error)), label=label)
axes.set(xscale="log", xlabel="position error, mm", ylabel="share of presses", title="finger of 6 mm radius")
axes.legend()
plt.show()
