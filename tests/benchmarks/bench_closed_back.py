"""Errors and flags on a film with a closed back: the tables of simulate/docs/imperfections_results.md.

    python tests/benchmarks/bench_closed_back.py [--sensor four-25um-biaxial] [--presses 1000] [--rig 100] [--films 2]
        [--json]

The first part trains a model of a film with a pretension of 0.8 MPa and a vented back. The model then answers presses
on the same film with a closed cavity behind it. The second part trains a model of a film with a closed cavity of 20 mm.
This model answers presses on random films with the same cavity and a pretension of 1 MPa, before and after a
correction by measured presses. The benchmark takes about four minutes.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from shared import arguments, print_results

from isocharge.common.arrays import Array
from isocharge.common.contact_errors import force_error_percent, position_error
from isocharge.common.statistics import rms
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, ForwardMap, Sensor, Sweep, load_sensor, noise_model, virtual_film
from isocharge.train import Fitted, LabelledPresses, Rig, TrainingData, fit, rig_data
from isocharge.train.data.presses import draw_contacts

PROBE = Circle(1.0)
RADIUS_mm = 8.0
FORCE_RANGE_N = (0.05, 2.0)
PRETENSION_MPa = 0.8
OTHER_PRETENSION_MPa = 1.0
DEPTHS_mm = (2.0, 20.0, 200.0, 2000.0)
DEPTH_mm = 20.0
MISFIT_LIMIT = 5.0
NOISE = noise_model("reference")


def with_cavity(sensor: Sensor, depth_mm: float) -> Sensor:
    """Return a sensor with a closed cavity of the area of the film and a given depth behind it."""
    return replace(sensor, film=replace(sensor.film, back_volume=depth_mm * np.pi * sensor.film.radius**2))


def train(sensor: Sensor) -> Fitted:
    """Train a network on 24,000 presses, as `isocharge train fit --sensor` does."""
    film_map = ForwardMap.build(sensor, PROBE, RADIUS_mm, FORCE_RANGE_N)
    contact = Sweep(RADIUS_mm, FORCE_RANGE_N, 24_000, 0).contacts()
    presses = LabelledPresses(contact, film_map.charges(contact))
    return fit(
        TrainingData(sensor=sensor, probes=(PROBE.notation,), domain=film_map.domain, presses=presses, sha256="-")
    )


def errors(fitted: Fitted, contact: Array, charge: Array) -> str:
    """Return the rms errors of a model, and the shares of presses with the flags `misfit` and `outside`."""
    estimate, _, misfit = fitted.predict(charge)
    force_percent = force_error_percent(estimate, contact)
    min_force, max_force = FORCE_RANGE_N
    is_misfit = misfit[:, 0] > MISFIT_LIMIT
    is_far = np.hypot(estimate[:, 0], estimate[:, 1]) > fitted.domain.radius
    is_outside = is_far | (estimate[:, 2] < min_force) | (estimate[:, 2] > max_force)
    return (
        f"{rms(position_error(estimate, contact)):.2f} mm, force {rms(force_percent):.1f} % rms, "
        f"{np.mean(force_percent):+.1f} % on average, misfit {100.0 * np.mean(is_misfit):.0f} %, outside "
        f"{100.0 * np.mean(is_outside):.0f} %, neither {100.0 * np.mean(~is_misfit & ~is_outside):.0f} %"
    )


def unnoticed_cavity(sensor: Sensor, contact: Array, rng: np.random.Generator) -> Iterator[str]:
    """Yield the errors of a model for a vented back on films with a closed back."""
    fitted = train(sensor)
    vented_charge = ForwardMap.build(sensor, PROBE, RADIUS_mm, FORCE_RANGE_N).charges(contact)
    for depth_mm in DEPTHS_mm:
        charge = ForwardMap.build(with_cavity(sensor, depth_mm), PROBE, RADIUS_mm, FORCE_RANGE_N).charges(contact)
        low, median, high = np.percentile(charge / vented_charge, [5, 50, 95])
        ratios = f"charges times {median:.2f} ({low:.2f} to {high:.2f})"
        yield f"{depth_mm:g} mm: {ratios}, {errors(fitted, contact, NOISE.add(charge, rng))}"


def stated_cavity(sensor: Sensor, contact: Array, n_rig: int, n_film: int, rng: np.random.Generator) -> Iterator[str]:
    """Yield the errors of a model whose sensor file states the cavity, without and with measured presses."""
    described = with_cavity(sensor, DEPTH_mm)
    fitted = train(described)
    for seed in range(n_film):
        film, probe = virtual_film(described, PROBE, seed)
        film = replace(film, film=replace(film.film, pretension=OTHER_PRETENSION_MPa))
        film_map = ForwardMap.build(film, probe, RADIUS_mm, FORCE_RANGE_N)
        charge = NOISE.add(film_map.charges(contact), rng)
        yield f"film {seed}, not corrected: {errors(fitted, contact, charge)}"

        rig_contact = draw_contacts(rng, film_map.domain, n_rig)
        stds = np.full(n_rig, 0.05), np.full(n_rig, 0.005)
        rig_charge = NOISE.add(film_map.charges(rig_contact), rng)
        lines = tuple(range(1, n_rig + 1))
        presses = MeasuredPresses(rig_contact, rig_charge, *stds, film_map.electrodes, lines)
        corrected = fit(rig_data(Rig(presses, described, PROBE)))
        yield f"film {seed}, corrected by {n_rig} presses: {errors(corrected, contact, charge)}"


def main() -> None:
    requested = arguments(__doc__, sensor="four-25um-biaxial", presses=1000, rig=100, films=2, json=False)
    sensor = load_sensor(requested.sensor)
    sensor = replace(sensor, film=replace(sensor.film, pretension=PRETENSION_MPa))
    contact = Sweep(0.999 * RADIUS_mm, FORCE_RANGE_N, requested.presses, 1).contacts()
    rng = np.random.default_rng(1)
    results = {"cavity that the model does not know": list(unnoticed_cavity(sensor, contact, rng))}
    if requested.films:
        stated = stated_cavity(sensor, contact, requested.rig, requested.films, rng)
        results[f"cavity of {DEPTH_mm:g} mm in the sensor file"] = list(stated)
    print_results("closed_back", requested, results)


if __name__ == "__main__":
    main()
