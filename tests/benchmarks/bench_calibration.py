"""Error against number of presses: calibration, its alternatives and the linearised limit; coverage of the intervals.

    python tests/benchmarks/bench_calibration.py [--sensors NAME,...] [--films 40] [--fine 8] [--coverage 100]
        [--workers 2] [--seed 1] [--output FOLDER]

Films are drawn from the prior of the network for all films; presses are known to 0.1 mm and 1 %, charges have
`reference` noise. Their truth comes from forward maps that are solved for each film, not from the family that the
calibration uses, for the `--fine` films on which Gauss-Newton on the calibrated map runs as well; the others take the
family's.
Writes calibration.json and calibration.png.
"""

import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.ticker import FormatStrFormatter, NullFormatter, ScalarFormatter
from shared import arguments

from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.serve import MeasuredPresses
from isocharge.serve.benchmark import machine
from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.simulate.plots.figure import new_figure
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.calibration.contact_error import ContactSensitivity, information_of
from isocharge.train.data.presses import draw_contacts

SENSORS = "four-25um-biaxial,three-25um-biaxial,four-25um-uniaxial"
COUNTS = (1, 3, 5, 8, 15, 30)
POSITION_MM, FORCE = 0.1, 0.01
CONTACTS = 1000
"""Fresh contacts on which errors are measured, for each film."""


@lru_cache(maxsize=4)
def problem_of(sensor: str) -> CalibrationProblem:
    return CalibrationProblem.of(load_sensor(sensor), Circle(1.0))


def errors(answer: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Root-mean-square errors of the position, mm, and of the force, %."""
    return rms(position_error(answer, truth)), 100.0 * rms(answer[:, 2] / truth[:, 2] - 1.0)


def as_read(problem: CalibrationProblem, contact: np.ndarray, charge: np.ndarray, rng: Any) -> MeasuredPresses:
    """Presses as a rig reads them."""
    read, count = contact.copy(), len(contact)
    read[:, :2] += POSITION_MM * rng.standard_normal((count, 2))
    read[:, 2] *= np.exp(FORCE * rng.standard_normal(count))
    std = np.full(count, POSITION_MM), np.full(count, FORCE)
    return MeasuredPresses(read, charge, *std, problem.electrodes, tuple(range(count)))


def limit(problem: CalibrationProblem, truth: np.ndarray, contact: np.ndarray) -> tuple[float, float]:
    """The linearised limit of what not knowing the film leaves after presses at `contact`, at the true film."""
    information = np.eye(truth.size) + information_of(problem, truth, contact, POSITION_MM, FORCE).sum(axis=0)
    left = ContactSensitivity.at(problem, truth).contact_error(np.linalg.inv(information))
    return left.position_mm, left.force_percent


def gains_only(problem: CalibrationProblem, presses: MeasuredPresses) -> np.ndarray:
    """The described film with the gains that fit the presses best."""
    parameters = problem.before.parameters.copy()
    expected = problem.charges.charges(parameters, presses.contact)
    ratio = np.maximum(presses.charge_pC, 1.0) / np.maximum(expected, 1.0)
    parameters[-expected.shape[1] :] += np.median(np.log(ratio), axis=0)
    return parameters


def gauss_newton(problem: CalibrationProblem, parameters: np.ndarray, charge: np.ndarray) -> np.ndarray:
    """Contacts by least squares on the calibrated film's forward map."""
    forward_map = problem.charges.forward_map(parameters)
    at = draw_contacts(np.random.default_rng(0), problem.domain, 600)
    search = GaussNewton(problem.domain, problem.noise, forward_map)
    return search.fit(forward_map.charges(at), at).predict(charge)


def study(job: tuple[str, int, bool]) -> dict[str, Any]:
    """One film: errors of every method by number of presses."""
    torch.set_num_threads(1)
    sensor, seed, fine = job
    problem, rng = problem_of(sensor), np.random.default_rng([seed, 7])
    films, truth = problem.films, problem.prior.draw(rng, 1)[0]
    film = problem.charges.forward_map(truth)
    if fine:  # solved for this film, independently of the family
        film = ForwardMap.build(*problem.prior.film(truth), 1.02 * problem.domain.radius)
    real, fresh = (draw_contacts(rng, problem.domain, count) for count in (max(COUNTS), CONTACTS))
    charge, test = (problem.noise.add(film.charges(at), rng) for at in (real, fresh))
    presses, at_truth = as_read(problem, real, charge, rng), films.fold(truth).predict(test)[0]
    record: dict[str, Any] = {
        "sensor": sensor,
        "seed": seed,
        "noise": errors(at_truth, fresh),
        "uncalibrated": errors(films.fold(problem.before.parameters).predict(test)[0], fresh),
        "by_count": {},
    }
    for count in COUNTS:
        began = time.perf_counter()
        result = calibrate(presses[:count], problem)
        seconds = time.perf_counter() - began
        answer = result.fitted.predict(test)[0]
        row = {
            "left": errors(answer, at_truth),
            "limit": limit(problem, truth, real[:count]),
            "error": errors(answer, fresh),
            "gains_only": errors(films.fold(gains_only(problem, presses[:count])).predict(test)[0], fresh),
            "bad": int(result.posterior.bad.sum()),
            "seconds": seconds,
        }
        if fine:
            row["gauss_newton"] = errors(gauss_newton(problem, result.posterior.parameters, test), fresh)
        record["by_count"][count] = row
    return record


def covered(job: tuple[str, int]) -> tuple[int, int]:
    """How many of the identified quantities of a film lie in their 95 % intervals, and how many there are."""
    sensor, seed = job
    problem, rng = problem_of(sensor), np.random.default_rng([seed, 11])
    truth, real = problem.prior.draw(rng, 1)[0], draw_contacts(rng, problem.domain, 10)
    charge = problem.noise.add(problem.charges.charges(truth, real), rng)
    result = calibrate(as_read(problem, real, charge, rng), problem)
    deviation = (result.posterior.parameters - truth) / problem.prior.std
    identified = [quantity for quantity in result.quantities.values() if quantity.identified]
    inside = sum(abs(float(quantity.weights @ deviation)) <= 1.96 * quantity.std for quantity in identified)
    return inside, len(identified)


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Errors over films, mm and %, and how much of the limit is left."""
    table: dict[str, Any] = {
        "films": len(records),
        "noise_mm": rms([record["noise"][0] for record in records]),
        "uncalibrated": [rms([record["uncalibrated"][axis] for record in records]) for axis in (0, 1)],
    }
    for count in COUNTS:
        rows = [record["by_count"][count] for record in records]
        entry: dict[str, Any] = {
            key: [rms([row[key][axis] for row in rows if key in row]) for axis in (0, 1)] if key in rows[0] else None
            for key in ("left", "limit", "error", "gains_only", "gauss_newton")
        }
        ratio = np.array([row["left"] for row in rows]) / np.array([row["limit"] for row in rows])
        table[str(count)] = entry | {
            "over_limit_median": np.median(ratio, axis=0).tolist(),
            "over_limit_max": ratio.max(axis=0).tolist(),
            "bad": sum(row["bad"] for row in rows),
            "seconds_median": float(np.median([row["seconds"] for row in rows])),
        }
    return table


LINES = {
    "gains only": ("gains_only", {"marker": "s", "color": "#c07a2c", "lw": 1.0}),
    "Gauss-Newton on the calibrated map, some films": ("gauss_newton", {"marker": "x", "color": "#5a9a5a", "lw": 1.0}),
    "calibrated network": ("error", {"marker": "o", "color": "#24476b", "lw": 2.0}),
    "of it by not knowing the film": ("left", {"marker": "o", "ls": "", "mfc": "white", "color": "#24476b"}),
    "its linearised limit": ("limit", {"ls": ":", "color": "k"}),
}


def picture(tables: dict[str, dict[str, Any]], path: Path) -> None:
    """Position error and force error against the number of presses, a column for each sensor."""
    figure = new_figure(4.6 * len(tables), 7.6)
    rows = figure.subplots(2, len(tables), sharex=True, squeeze=False)
    for axis, label in enumerate(("position error (rms), mm", "force error (rms), %")):
        rows[axis, 0].set(ylabel=label)
        for axes, (sensor, table) in zip(rows[axis], tables.items(), strict=True):
            axes.axhline(table["uncalibrated"][axis], color="#b03a3a", ls="--", label="no calibration")
            for name, (key, style) in LINES.items():
                values = [(table[str(count)][key] or (np.nan, np.nan))[axis] for count in COUNTS]
                axes.plot(COUNTS, values, label=name, **style)
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
            seeds = range(1000 * options.seed, 1000 * options.seed + options.films)
            jobs = [(sensor, seed, number < options.fine) for number, seed in enumerate(seeds)]
            tables[sensor] = summary(list(pool.map(study, jobs)))
            counts = list(pool.map(covered, [(sensor, 500 + seed) for seed in range(options.coverage)]))
            inside, total = np.sum(counts, axis=0) if counts else (0, 0)
            tables[sensor]["coverage_95"] = float(inside / total) if total else None
            tables[sensor]["intervals"] = int(total)
            print(sensor, json.dumps(tables[sensor], indent=1), flush=True)
    record = {"machine": machine(), "seed": options.seed, "sensors": tables}
    (options.output / "calibration.json").write_text(json.dumps(record, indent=1))
    picture(tables, options.output / "calibration.png")


if __name__ == "__main__":
    main()
