"""Update of a calibration by one known weight at an unknown place: a table of train/docs/calibration_results.md.

    python tests/benchmarks/bench_one_weight.py [--seeds 2] [--presses 1000] [--json]

Films of three sensors are calibrated with 20 presses. Then the pretension decreases by 0.35 MPa, as if film and ring
became one kelvin warmer. The calibration is updated by one press of 0.1 N at an unknown place, or by three presses at
known places. The errors of further contacts include the `reference` noise. The benchmark takes about three minutes.
"""

from dataclasses import replace

import numpy as np
from shared import arguments, print_results

from isocharge.common.arrays import Array
from isocharge.common.contact_errors import force_error_percent, position_error
from isocharge.common.statistics import rms
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, load_sensor, noise_model
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.data.presses import draw_contacts

SENSORS = ("three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial")
PRETENSION_MPa = 1.2
CHANGE_MPa = -0.35
WEIGHT_N = 0.1
NOISE = noise_model("reference")


def measure(sensor: str, seed: int, n_press: int) -> list[str]:
    """Return a line with the errors of one film for each model: not updated, and updated in two ways."""
    problem = CalibrationProblem.of(load_sensor(sensor), Circle(1.0))
    rng = np.random.default_rng(seed)
    film = problem.prior.draw(rng, 1)[0]
    pretension = problem.prior.index("pretension")
    film[pretension] = PRETENSION_MPa

    def charges(contact: Array) -> Array:
        """Return charges with noise, shape (n, n_electrode), pC, of presses on the present film."""
        return NOISE.add(problem.charges.forward_map(film).charges(contact), rng)

    def presses(contact: Array, known: Array) -> MeasuredPresses:
        """Simulate presses, of which only the values in `known` are stated."""
        count = len(contact)
        position_std, force_std = np.full(count, 0.1), np.full(count, 0.01)
        lines = tuple(range(1, count + 1))
        return MeasuredPresses(known, charges(contact), position_std, force_std, problem.electrodes, lines)

    places = draw_contacts(rng, problem.domain, 20)
    calibration = calibrate(presses(places, places), problem)
    film[pretension] += CHANGE_MPa
    later = replace(problem, earlier=calibration.posterior.drifted(problem.prior))

    weight = presses(np.array([[2.0, 1.0, WEIGHT_N]]), np.array([[np.nan, np.nan, WEIGHT_N]]))
    three_places = draw_contacts(rng, problem.domain, 3)
    models = {
        "not updated": calibration,
        "one weight": calibrate(weight, later),
        "three places": calibrate(presses(three_places, three_places), later),
    }

    lines = []
    contact = draw_contacts(rng, problem.domain, n_press)
    for label, result in models.items():
        estimate, _, _ = result.fitted.predict(charges(contact))
        position_mm = rms(position_error(estimate, contact))
        force_percent = rms(force_error_percent(estimate, contact))
        lines.append(f"film {seed}, {label}: {position_mm:.2f} mm, {force_percent:.1f} %")
    return lines


def main() -> None:
    requested = arguments(__doc__, seeds=2, presses=1000, json=False)
    seeds = range(5, 5 + requested.seeds)
    results = {
        sensor: [line for seed in seeds for line in measure(sensor, seed, requested.presses)] for sensor in SENSORS
    }
    print_results("one_weight", requested, results)


if __name__ == "__main__":
    main()
