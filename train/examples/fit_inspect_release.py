"""
How do I train a model of my sensor?
====================================

The function ``fit`` trains a network on presses, ``evaluate`` measures its errors, and ``release`` writes the model
folder. This example writes the folder only if the errors are small enough. The training takes fewer steps and fewer
examples of the misfit than a training with the default settings, and its errors are therefore larger.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Predictor
from isocharge.simulate import Circle, Sweep, load_sensor, noise_model, read_dataset, run_sweep
from isocharge.train import FitConfig, TrainingConfig, evaluate, fit, release

sensor = load_sensor("three-25um-biaxial")
noise = noise_model("reference")
with tempfile.TemporaryDirectory() as temporary:
    folder = Path(temporary)
    presses = read_dataset(run_sweep(folder / "presses", sensor, (Circle(1.0),), Sweep(samples=6000)))
    fitted = fit(presses, FitConfig(training=TrainingConfig(steps=1500, misfit_steps=200, misfit_charges=4000)))
    errors = evaluate(fitted)
    print(f"position {errors['position_rms_mm']:.3f} mm rms, force {errors['force_rms_percent']:.2f} % rms")
    if errors["position_rms_mm"] > 0.5:
        raise SystemExit("the position error is too large to release the model")
    model = release(fitted, folder / "models" / "mine")
    predictor = Predictor(model.folder)

samples = presses.samples
answers = predictor.predict_batch(noise.add(samples.charge_pC, np.random.default_rng(1)))
error = np.hypot(answers.x_mm - samples.x_mm, answers.y_mm - samples.y_mm)
figure, axes = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
axes.loglog(samples.force_N, error, ".", ms=2, alpha=0.4, label="presses")
order = np.argsort(samples.force_N)
for group in np.array_split(order, 12):  # twelve groups with similar forces
    axes.loglog(np.median(samples.force_N[group]), np.median(error[group]), "o", color="C1")
axes.set(
    xlabel="force, N",
    ylabel="position error, mm",
    ylim=(1e-3, None),
    title="light presses have large errors",
)
plt.show()
