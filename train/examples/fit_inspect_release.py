"""Fit a network, look at its errors, and release it only if they are good: `fit`, `evaluate`, `release`."""

import sys
from pathlib import Path

from isocharge.serve import Predictor
from isocharge.simulate import Circle, Sweep, load_sensor, press, read_dataset, run_sweep, touch_charge
from isocharge.train import evaluate, fit, load_config, release

folder = Path(sys.argv[1])
config = load_config(Path(sys.argv[2])) if len(sys.argv) > 2 else None  # train/configs/quick.toml takes seconds
sensor, probe = load_sensor("three-25um-biaxial"), Circle(1.0)
fitted = fit(read_dataset(run_sweep(folder / "presses", sensor, (probe,), Sweep(samples=6000))), config)
errors = evaluate(fitted)
print(f"position {errors['position_rms_mm']:.3f} mm rms, force {errors['force_rms_percent']:.2f} % rms")
if errors["position_rms_mm"] > 0.5:
    raise SystemExit("not good enough to release")
model = release(fitted, folder / "models" / "mine", errors=errors)

charge = touch_charge(sensor, press(sensor.film, probe, at=(3.0, -2.0), force=1.0))
contact = Predictor(model.folder).predict(charge)
print(f"pressed at (3, -2) mm with 1 N, estimated ({contact.x_mm:.1f}, {contact.y_mm:.1f}) mm, {contact.force_N:.1f} N")
