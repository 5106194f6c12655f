"""Errors and flags on a film with a closed back: the table of simulate/docs/imperfections.md.

    python tests/benchmarks/bench_closed_back.py [--sensor four-25um-biaxial] [--presses 1000] [--json]

A model is trained for a film with a pretension of 0.8 MPa and a vented back. The model then answers presses on the same
film with a closed cavity behind it. The benchmark takes about two minutes.
"""

from dataclasses import replace

import numpy as np
from shared import arguments, percentiles, print_results, training_data

from isocharge.common.arrays import Array
from isocharge.simulate import Circle, ForwardMap, Sensor, Sweep, load_sensor, noise_model
from isocharge.train import Fitted, fit
from isocharge.train.data.contact_errors import force_error_percent, position_error, rms

PROBE = Circle(1.0)
RADIUS_mm = 8.0
FORCE_RANGE_N = (0.05, 2.0)
PRETENSION_MPa = 0.8
DEPTHS_mm = (20.0, 2000.0)
MISFIT_LIMIT = 5.0
NOISE = noise_model("reference")


def with_cavity(sensor: Sensor, depth_mm: float) -> Sensor:
    """Return a sensor with a closed cavity of the area of the film and a given depth behind it."""
    return replace(sensor, film=replace(sensor.film, back_volume=depth_mm * np.pi * sensor.film.radius**2))


def errors(fitted: Fitted, contact: Array, charge: Array) -> dict[str, float]:
    """Return the errors of a model, and the shares of presses with the flags `misfit` and `outside`."""
    estimate, _, misfit = fitted.predict(charge)
    force_percent = force_error_percent(estimate, contact)
    is_misfit = misfit[:, 0] > MISFIT_LIMIT
    is_outside = fitted.domain.is_outside(estimate)
    return {
        "position_rms_mm": round(rms(position_error(estimate, contact)), 2),
        "force_rms_percent": round(rms(force_percent), 1),
        "force_mean_percent": round(float(np.mean(force_percent)), 1),
        "misfit_percent": 100.0 * is_misfit.mean(),
        "outside_percent": 100.0 * is_outside.mean(),
        "neither_percent": 100.0 * np.mean(~is_misfit & ~is_outside),
    }


def main() -> None:
    asked = arguments(__doc__, sensor="four-25um-biaxial", presses=1000)
    sensor = load_sensor(asked.sensor)
    sensor = replace(sensor, film=replace(sensor.film, pretension=PRETENSION_MPa))
    contact = Sweep(0.999 * RADIUS_mm, FORCE_RANGE_N, asked.presses, 1).contacts()
    vented = ForwardMap.build(sensor, PROBE, RADIUS_mm, FORCE_RANGE_N)
    fitted = fit(training_data(vented, 24_000))
    rng = np.random.default_rng(1)
    vented_charge = vented.charges(contact)
    results = {}
    for depth_mm in DEPTHS_mm:
        charge = ForwardMap.build(with_cavity(sensor, depth_mm), PROBE, RADIUS_mm, FORCE_RANGE_N).charges(contact)
        factor = percentiles((charge / vented_charge).ravel(), (5, 50, 95), 2)
        results[f"cavity of {depth_mm:g} mm"] = {"factor": factor, **errors(fitted, contact, NOISE.add(charge, rng))}
    print_results("closed_back", asked, results)


if __name__ == "__main__":
    main()
