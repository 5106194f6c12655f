"""From a sensor to contacts with public functions only: sweep, fit, what it reached, predict.

python train/examples/pipeline.py OUTPUT_FOLDER [--quick]
"""

import sys
from pathlib import Path

from isocharge.serve import Contact, Predictor
from isocharge.simulate import Circle, Sweep, load_sensor, press, read_dataset, run_sweep, touch_charge
from isocharge.train import FitConfig, TrainingConfig, train_model


def main(folder: Path, quick: bool = False) -> Contact:
    """Make everything in `folder`, which must not exist; print each stage's result and return the last contact."""
    sensor, probe = load_sensor("three-25um-biaxial"), Circle(radius=1e-3)
    dataset = read_dataset(run_sweep(folder / "presses", sensor, (probe,), Sweep(samples=4_000 if quick else 24_000)))
    print(f"{len(dataset.samples)} presses, charges up to {dataset.samples.charge_pC.max():.0f} pC")

    config = (
        FitConfig(training=TrainingConfig(steps=1_500, misfit_steps=500, misfit_charges=5_000))
        if quick
        else FitConfig()
    )
    release = train_model(dataset, folder / "models" / sensor.name, config)
    for name, value in release.metadata.errors.items():
        print(f"{name:28} {value:g}")

    at, force = (3e-3, -2e-3), 1.0
    charge_pC = 1e12 * touch_charge(sensor, press(sensor.film, probe, at, force))
    contact = Predictor(release.folder).predict(charge_pC)
    estimate = f"({contact.x_mm:.2f}, {contact.y_mm:.2f}) mm, {contact.force_N:.3f} N"
    print(f"pressed at (3, -2) mm with 1 N, estimated at {estimate}")
    return contact


if __name__ == "__main__":
    main(Path(sys.argv[1]), quick="--quick" in sys.argv[2:])
