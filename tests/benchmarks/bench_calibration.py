"""Errors of calibrations by the number of presses, compared with alternatives and with the linearised limit.

    python tests/benchmarks/bench_calibration.py [--sensors NAME,...] [--films 40] [--fine 8] [--coverage 100]
        [--workers 2] [--seed 1] [--output FOLDER]

The films are drawn from the prior of the network for all films. The presses are known to 0.1 mm and 1 %, and the
charges have `reference` noise. For the first `--fine` films, the charges come from forward maps that are solved for
each film, and the Gauss-Newton method on the calibrated map is compared as well. For all other films, the charges come
from the same family of forward maps that the calibration uses.

The benchmark also measures how often the 95 % intervals contain the true quantities of `--coverage` films. It writes
calibration.json and calibration.png.
"""

import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.ticker import FormatStrFormatter, NullFormatter, ScalarFormatter
from measured_films import FORCE_STD, POSITION_STD_mm, measured_presses, with_rig_errors
from shared import arguments

from isocharge.common.contact_errors import position_error
from isocharge.common.errors import PressError
from isocharge.common.statistics import rms
from isocharge.serve import MeasuredPresses
from isocharge.serve.benchmark import machine
from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.simulate.plots.figure import new_figure
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.calibration.contact_error import ContactSensitivity, fisher_information
from isocharge.train.calibration.quantities import NORMAL_95
from isocharge.train.data.presses import draw_contacts
from isocharge.train.report.gauss_newton import GaussNewton

SENSORS = "four-25um-biaxial,three-25um-biaxial,four-25um-uniaxial"
COUNTS = (1, 3, 5, 8, 15, 30)
"""Numbers of presses."""

N_TEST_CONTACTS = 1000
"""Number of contacts on which the errors are measured, for each film."""

COVERAGE_PRESSES = 10
"""Number of presses of the calibrations whose intervals are examined."""


@lru_cache(maxsize=4)
def problem_of(sensor: str) -> CalibrationProblem:
    """Return the calibration problem of a sensor, given by its name."""
    return CalibrationProblem.of(load_sensor(sensor), Circle(1.0))


def rms_errors(contact: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the root-mean-square errors of the position, mm, and of the force, %."""
    return rms(position_error(contact, truth)), 100.0 * rms(contact[:, 2] / truth[:, 2] - 1.0)


def linearised_limit(problem: CalibrationProblem, truth: np.ndarray, contact: np.ndarray) -> tuple[float, float]:
    """Compute the errors that the uncertainty of the film causes after presses, linearised at the true film.

    Args:
        problem: The films.
        truth: Parameters of the true film.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.

    Returns:
        Root-mean-square errors of the position, mm, and of the force, %.
    """
    press_information = fisher_information(problem, truth, contact, POSITION_STD_mm, FORCE_STD).sum(axis=0)
    covariance = np.linalg.inv(np.eye(truth.size) + press_information)
    error = ContactSensitivity.for_film(problem, truth).contact_error(covariance)
    return error.position_mm, error.force_percent


def film_with_fitted_gains(problem: CalibrationProblem, presses: MeasuredPresses) -> np.ndarray:
    """Return the parameters of the described film with the gains that fit the presses best."""
    parameters = problem.before.parameters.copy()
    expected = problem.charges.charges(parameters, presses.contact)
    ratio = np.maximum(presses.charge_pC, 1.0) / np.maximum(expected, 1.0)
    for electrode, log_gain in zip(problem.electrodes, np.median(np.log(ratio), axis=0), strict=True):
        parameters[problem.prior.index(f"gain {electrode}")] += log_gain
    return parameters


def gauss_newton(problem: CalibrationProblem, parameters: np.ndarray, charge: np.ndarray) -> np.ndarray:
    """Estimate contacts from charges by the Gauss-Newton method on the forward map of the calibrated film."""
    forward_map = problem.charges.forward_map(parameters)
    starts = draw_contacts(np.random.default_rng(0), problem.domain, 600)
    search = GaussNewton(problem.domain, problem.noise, forward_map)
    return search.fit(forward_map.charges(starts), starts).predict(charge)


class FilmJob(NamedTuple):
    """A film to calibrate.

    Attributes:
        sensor: Name of the sensor.
        seed: Seed of the film and its presses.
        is_solved: Whether the charges come from a forward map that is solved for this film.
    """

    sensor: str
    seed: int
    is_solved: bool


def study_film(job: FilmJob) -> dict[str, Any]:
    """Calibrate one film with different numbers of presses, and return the errors of all methods."""
    torch.set_num_threads(1)
    problem = problem_of(job.sensor)
    rng = np.random.default_rng([job.seed, 7])
    truth = problem.prior.draw(rng, 1)[0]
    film = problem.charges.forward_map(truth)
    if job.is_solved:
        film = ForwardMap.build(*problem.prior.film(truth), 1.02 * problem.domain.radius)
    press_contact = draw_contacts(rng, problem.domain, max(COUNTS))
    test_contact = draw_contacts(rng, problem.domain, N_TEST_CONTACTS)
    press_charge = problem.noise.add(film.charges(press_contact), rng)
    test_charge = problem.noise.add(film.charges(test_contact), rng)
    presses = measured_presses(problem, with_rig_errors(press_contact, rng), press_charge)

    def estimate(parameters: np.ndarray) -> np.ndarray:
        """Estimate the test contacts with the network of a film."""
        contact, _, _ = problem.films.fold(parameters).predict(test_charge)
        return contact

    contact_of_true_film = estimate(truth)
    by_count = {}
    for count in COUNTS:
        start = time.perf_counter()
        try:
            result = calibrate(presses[:count], problem)
        except PressError:  # a single press of an unusual film may look like a press with swapped channels
            continue
        seconds = time.perf_counter() - start
        contact, _, _ = result.fitted.predict(test_charge)
        with_gains = film_with_fitted_gains(problem, presses[:count])
        row = {
            "left": rms_errors(contact, contact_of_true_film),
            "limit": linearised_limit(problem, truth, press_contact[:count]),
            "error": rms_errors(contact, test_contact),
            "gains_only": rms_errors(estimate(with_gains), test_contact),
            "bad": int(result.posterior.bad.sum()),
            "seconds": seconds,
        }
        if job.is_solved:
            contact = gauss_newton(problem, result.posterior.parameters, test_charge)
            row["gauss_newton"] = rms_errors(contact, test_contact)
        by_count[count] = row
    return {
        "sensor": job.sensor,
        "seed": job.seed,
        "noise": rms_errors(contact_of_true_film, test_contact),
        "uncalibrated": rms_errors(estimate(problem.before.parameters), test_contact),
        "by_count": by_count,
    }


def count_covered(job: tuple[str, int]) -> tuple[int, int]:
    """Calibrate a film, and count the identified quantities that lie in their 95 % intervals.

    Args:
        job: Name of the sensor, and seed of the film.

    Returns:
        Number of quantities in their intervals, and number of identified quantities.
    """
    sensor, seed = job
    problem = problem_of(sensor)
    rng = np.random.default_rng([seed, 11])
    truth = problem.prior.draw(rng, 1)[0]
    contact = draw_contacts(rng, problem.domain, COVERAGE_PRESSES)
    charge = problem.noise.add(problem.charges.charges(truth, contact), rng)
    result = calibrate(measured_presses(problem, with_rig_errors(contact, rng), charge), problem)
    deviation = (result.posterior.parameters - truth) / problem.prior.std
    identified = [quantity for quantity in result.quantities.values() if quantity.identified]
    covered = [abs(float(quantity.weights @ deviation)) <= NORMAL_95 * quantity.std for quantity in identified]
    return sum(covered), len(identified)


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the root mean squares over films of the errors of position, mm, and force, %, by number of presses.

    The errors that the uncertainty of the film causes are also compared with their linearised limit.
    """

    def rms_pair(pairs: list[tuple[float, float]]) -> list[float]:
        """Return the root mean squares of position errors and of force errors."""
        position_errors, force_errors = zip(*pairs, strict=True)
        return [rms(position_errors), rms(force_errors)]

    noise_mm, _ = rms_pair([record["noise"] for record in records])
    table: dict[str, Any] = {
        "films": len(records),
        "noise_mm": noise_mm,
        "uncalibrated": rms_pair([record["uncalibrated"] for record in records]),
    }
    for count in COUNTS:
        rows = [record["by_count"][count] for record in records if count in record["by_count"]]
        entry: dict[str, Any] = {}
        for method in ("left", "limit", "error", "gains_only", "gauss_newton"):
            pairs = [row[method] for row in rows if method in row]
            entry[method] = rms_pair(pairs) if pairs else None
        ratio = np.array([row["left"] for row in rows]) / np.array([row["limit"] for row in rows])
        table[str(count)] = entry | {
            "over_limit_median": np.median(ratio, axis=0).tolist(),
            "over_limit_max": ratio.max(axis=0).tolist(),
            "refused": len(records) - len(rows),
            "bad": sum(row["bad"] for row in rows),
            "seconds_median": float(np.median([row["seconds"] for row in rows])),
        }
    return table


LINES = {
    "gains only": ("gains_only", {"marker": "s", "color": "#c07a2c", "lw": 1.0}),
    "Gauss-Newton on the calibrated map, some films": ("gauss_newton", {"marker": "x", "color": "#5a9a5a", "lw": 1.0}),
    "calibrated network": ("error", {"marker": "o", "color": "#24476b", "lw": 2.0}),
    "part of it by the uncertainty of the film": (
        "left",
        {"marker": "o", "ls": "", "mfc": "white", "color": "#24476b"},
    ),
    "linearised limit of this part": ("limit", {"ls": ":", "color": "k"}),
}
"""Key in the table and style of each line of the picture, by its label."""


def draw_errors(tables: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw position error and force error against the number of presses, with a column for each sensor."""
    figure = new_figure(4.6 * len(tables), 7.6)
    rows = figure.subplots(2, len(tables), sharex=True, squeeze=False)
    for quantity, label in enumerate(("position error (rms), mm", "force error (rms), %")):
        rows[quantity, 0].set(ylabel=label)
        for axes, (sensor, table) in zip(rows[quantity], tables.items(), strict=True):
            axes.axhline(table["uncalibrated"][quantity], color="#b03a3a", ls="--", label="no calibration")
            for name, (key, style) in LINES.items():
                pairs = [table[str(count)][key] or (np.nan, np.nan) for count in COUNTS]
                axes.plot(COUNTS, [pair[quantity] for pair in pairs], label=name, **style)
            axes.set(xscale="log", yscale="log", xticks=COUNTS, title=sensor, xlabel="presses")
            axes.xaxis.set_major_formatter(ScalarFormatter())
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axes.grid(alpha=0.3)
    figure.legend(*rows[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(tables), fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    options = arguments(
        __doc__, sensors=SENSORS, films=40, fine=8, coverage=100, workers=2, seed=1, output=Path("build/calibration")
    )
    options.output.mkdir(parents=True, exist_ok=True)
    tables: dict[str, dict[str, Any]] = {}
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        for sensor in options.sensors.split(","):
            first_seed = 1000 * options.seed
            jobs = [FilmJob(sensor, first_seed + number, number < options.fine) for number in range(options.films)]
            tables[sensor] = summarise(list(pool.map(study_film, jobs)))
            counts = list(pool.map(count_covered, [(sensor, 500 + seed) for seed in range(options.coverage)]))
            covered_count = sum(covered for covered, _ in counts)
            interval_count = sum(identified for _, identified in counts)
            tables[sensor]["coverage_95"] = covered_count / interval_count if interval_count else None
            tables[sensor]["intervals"] = interval_count
            print(sensor, json.dumps(tables[sensor], indent=1), flush=True)
    record = {"machine": machine(), "seed": options.seed, "sensors": tables}
    (options.output / "calibration.json").write_text(json.dumps(record, indent=1))
    draw_errors(tables, options.output / "calibration.png")


if __name__ == "__main__":
    main()
