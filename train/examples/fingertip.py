"""
Which model is right about a fingertip?
=======================================

A fingertip touches the film in a circle of 4 to 8 mm radius, and its pressure falls off towards the edge of this
circle. The circle grows with the force. According to Hertz, its radius is proportional to the cube root of the force.
The probe ``growing-finger:6.0`` has a radius of 6 mm at 1 N, and the probe ``finger:6.0`` has it at every force. This
script trains a model for each of them. It compares both, and a released model for a rigid tip of 1 mm radius, on
presses of the growing finger. The training is short, so the errors are larger than those of a full training.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Predictor
from isocharge.simulate import Finger, ForwardMap, GrowingFinger, Sweep, load_sensor, noise_model, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train import FitConfig, TrainingConfig, fit, release

sensor = load_sensor("four-25um-biaxial")
films = {probe.notation: ForwardMap.build(sensor, probe) for probe in (Finger(6.0), GrowingFinger(6.0))}
settings = FitConfig(training=TrainingConfig(steps=1500, misfit_steps=200, misfit_charges=4000))
predictors = {"circle:1.0": Predictor("four-25um-biaxial")}
with tempfile.TemporaryDirectory() as temporary:
    folder = Path(temporary)
    for index, (notation, film) in enumerate(films.items()):
        presses = read_dataset(write_sweep(folder / f"presses-{index}", [film], Sweep(samples=6000)))
        predictors[notation] = Predictor(release(fit(presses, settings), folder / "models" / f"finger-{index}").folder)

# Presses of the growing finger. Between 0.3 and 2 N, its radius is 4.0 to 7.6 mm.
rng = np.random.default_rng(2)
distance_mm = 8.0 * np.sqrt(rng.random(2000))
angle = 2.0 * np.pi * rng.random(2000)
force_N = np.exp(rng.uniform(np.log(0.3), np.log(2.0), 2000))
x_mm = distance_mm * np.cos(angle)
y_mm = distance_mm * np.sin(angle)
charges = films["growing-finger:6.0"].charges(np.column_stack([x_mm, y_mm, force_N]))
noisy_charges = noise_model("reference").add(charges, rng)

figure, axes = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
for notation, predictor in predictors.items():
    predicted = predictor.predict_batch(noisy_charges)
    position_error = np.hypot(predicted.x_mm - x_mm, predicted.y_mm - y_mm)
    relative_force_error = predicted.force_N / force_N - 1.0
    is_flagged = np.array([bool(set(flags) - {"stress"}) for flags in predictor.validity.batch_flags(predicted)])
    x_deviation = np.abs(predicted.x_mm - x_mm) / predicted.x_std_mm
    y_deviation = np.abs(predicted.y_mm - y_mm) / predicted.y_std_mm
    force_deviation = np.abs(predicted.force_N - force_N) / predicted.force_std_N
    largest_deviation = np.max([x_deviation, y_deviation, force_deviation], axis=0)
    print(
        f"model for {notation}: position {np.sqrt(np.mean(position_error**2)):.2f} mm rms, "
        f"force {100 * np.sqrt(np.mean(relative_force_error**2)):.1f} % rms, "
        f"{100 * np.mean((largest_deviation > 4.0) & ~is_flagged):.0f} % wrong by more than four standard deviations "
        "without a flag"
    )
    axes.plot(np.sort(position_error), np.linspace(0.0, 1.0, len(position_error)), label=f"model for {notation}")
axes.set(
    xscale="log",
    xlabel="position error, mm",
    ylabel="share of presses",
    title="finger of 6 mm radius at 1 N",
)
axes.legend()
plt.show()
