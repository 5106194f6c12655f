"""Error against number of presses: calibration, its alternatives and the linearised limit; coverage of the intervals.

    python tests/benchmarks/bench_calibration.py [--sensor NAME ...] [--films 40] [--fine 8] [--coverage 100]
        [--workers 2] [--seed 1] [-o FOLDER]

Films are drawn from the prior of the network for all films; presses are known to 0.1 mm and 1 %, charges have
`reference` noise. Their truth comes from forward maps that are solved for each film, not from the family that the
calibration uses, for the `--fine` films on which the slow alternatives run as well; the others take the family's.
Writes calibration.json and calibration.png.
"""

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_predictor import machine
from matplotlib.ticker import FormatStrFormatter, NullFormatter, ScalarFormatter

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, ForwardMap, load_sensor
from isocharge.simulate.plots.figure import new_figure
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.calibration.contact_error import ContactSensitivity, information_of
from isocharge.train.data.presses import draw_contacts
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.fit import likelihood_loss, start_loss, with_fresh_noise
from isocharge.train.training.network import Features, InverseNetwork

SENSORS = ("four-25um-biaxial", "three-25um-biaxial", "four-25um-uniaxial")
COUNTS = (1, 3, 5, 8, 15, 30)
POSITION_MM, FORCE = 0.1, 0.01
CONTACTS = 1000
"""Fresh contacts on which errors are measured, for each film."""

POOLED_FILMS, POOLED_PRESSES, POOLED_STEPS = 4000, 16, 5000
"""What the network without context learns from, and for how long."""

TUNING_STEPS = 300
"""Steps of fine-tuning on the presses alone."""


@lru_cache(maxsize=4)
def problem_of(sensor: str) -> CalibrationProblem:
    return CalibrationProblem.of(load_sensor(sensor), Circle(1.0))


def errors(answer: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Root-mean-square errors of the position, mm, and of the force, %."""
    squares = ((answer[:, :2] - truth[:, :2]) ** 2).sum(axis=1)
    return float(np.sqrt(squares.mean())), float(100.0 * np.sqrt(np.mean((answer[:, 2] / truth[:, 2] - 1.0) ** 2)))


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
    left = ContactSensitivity.at(problem, truth).left(np.linalg.inv(information))
    return left.position_mm, left.force_percent


def gains_only(problem: CalibrationProblem, presses: MeasuredPresses) -> np.ndarray:
    """The described film with the gains that fit the presses best."""
    parameters = problem.before.parameters.copy()
    expected = problem.charges.charges(parameters, presses.contact)
    ratio = np.maximum(presses.charge_pC, 1.0) / np.maximum(expected, 1.0)
    parameters[-expected.shape[1] :] += np.median(np.log(ratio), axis=0)
    return parameters


def fine_tuned(problem: CalibrationProblem, presses: MeasuredPresses, charge: np.ndarray, seed: int) -> np.ndarray:
    """Contacts by the network of the described film, all of its weights tuned on the presses alone."""
    network = problem.films.fold(problem.before.parameters)
    layers = network.layers
    weights = [torch.tensor(part) for layer in (*layers.hidden, layers.last) for part in layer]
    weights.append(torch.tensor(layers.skip))
    for weight in weights:
        weight.requires_grad_(True)

    def answers(charges: torch.Tensor) -> torch.Tensor:
        logs = torch.log(charges.clamp(1.0, 1e6) / torch.tensor(network.typical))
        value = logs
        for number in range(len(layers.hidden)):
            value = torch.tanh(value @ weights[2 * number] + weights[2 * number + 1])
        return (value @ weights[-3] + weights[-2] + logs @ weights[-1])[:, :3]

    random = torch.Generator().manual_seed(seed)
    measured, contact = torch.tensor(presses.charge_pC), torch.tensor(presses.contact)
    target = torch.stack([contact[:, 0], contact[:, 1], torch.log(contact[:, 2])], dim=1)
    optimiser, scale = torch.optim.Adam(weights, lr=1e-3), torch.tensor(problem.domain.scale)
    for _ in range(TUNING_STEPS):
        noise = torch.hypot(torch.tensor(1.0).double(), 0.002 * measured)
        noisy = measured + noise * torch.randn(measured.shape, generator=random, dtype=torch.float64)
        loss = (((answers(noisy) - target) / scale) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        tuned = answers(torch.tensor(charge)).numpy()
    return np.column_stack([tuned[:, :2], np.exp(tuned[:, 2])])


def without_context(sensor: str) -> InverseNetwork:
    """One network for all films that is not told the film: the mean over the films, by maximum likelihood."""
    problem, rng = problem_of(sensor), np.random.default_rng(3)
    parts = []
    for parameters in problem.prior.draw(rng, POOLED_FILMS):
        at = draw_contacts(rng, problem.domain, POOLED_PRESSES)
        parts.append((at, problem.films.forward_map(parameters).charges(at)))
    contact, charge = (np.concatenate(part) for part in zip(*parts, strict=True))
    torch.manual_seed(0)
    network = InverseNetwork(problem.domain, Features.fit(charge), (96, 96, 96), (8,))
    charges, unit = torch.tensor(charge).float(), torch.tensor(problem.domain.to_unit(contact)).float()
    held, warm_up = len(charges) // 10, POOLED_STEPS // 7

    def loss_of(rows: torch.Tensor, step: int, random: torch.Generator) -> torch.Tensor:
        answer = network.posterior(with_fresh_noise(charges[rows], problem.noise, random))
        return (start_loss if step < warm_up else likelihood_loss)(*answer, unit[rows])

    def loss(step: int, random: torch.Generator) -> torch.Tensor:
        return loss_of(held + torch.randint(len(charges) - held, (1024,), generator=random), step, random)

    def score() -> tuple[float, str]:
        with torch.no_grad():
            return loss_of(torch.arange(held), POOLED_STEPS, torch.Generator().manual_seed(5)).item(), ""

    stage = TrainingStage("contact", network.contact, loss, score, POOLED_STEPS, warm_up)
    Descent(stage, 0.005, POOLED_STEPS, 0).run()
    return network.eval()


def pooled_errors(job: tuple[str, int, int]) -> list[tuple[float, float]]:
    """Errors of that network on the fresh contacts of every film."""
    torch.set_num_threads(1)
    sensor, first, count = job
    problem, network = problem_of(sensor), without_context(sensor)
    rows = []
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, 13])
        at = draw_contacts(rng, problem.domain, CONTACTS)
        film = problem.films.forward_map(problem.prior.draw(np.random.default_rng([seed, 7]), 1)[0])
        with torch.no_grad():
            answer = network(torch.tensor(problem.noise.add(film.charges(at), rng)).float())[0].double().numpy()
        rows.append(errors(answer, at))
    return rows


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
        answer = films.fold(result.posterior.parameters).predict(test)[0]
        row = {
            "left": errors(answer, at_truth),
            "limit": limit(problem, truth, real[:count]),
            "error": errors(answer, fresh),
            "gains_only": errors(films.fold(gains_only(problem, presses[:count])).predict(test)[0], fresh),
            "bad": int(result.posterior.bad.sum()),
            "seconds": seconds,
        }
        if fine:
            row["fine_tuned"] = errors(fine_tuned(problem, presses[:count], test, seed), fresh)
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
    """Medians over films, and the largest ratio to the limit."""
    table: dict[str, Any] = {
        "films": len(records),
        "noise_mm": _rms(record["noise"][0] for record in records),
        "uncalibrated": [_rms(record["uncalibrated"][axis] for record in records) for axis in (0, 1)],
    }
    for count in COUNTS:
        rows = [record["by_count"][count] for record in records]
        ratio = np.array([row["left"][0] / row["limit"][0] for row in rows])
        force = np.array([row["left"][1] / row["limit"][1] for row in rows])
        entry = {
            "left_mm": _rms(row["left"][0] for row in rows),
            "left_percent": _rms(row["left"][1] for row in rows),
            "limit_mm": _rms(row["limit"][0] for row in rows),
            "limit_percent": _rms(row["limit"][1] for row in rows),
            "ratio_median": float(np.median(ratio)),
            "ratio_max": float(ratio.max()),
            "force_ratio_median": float(np.median(force)),
            "force_ratio_max": float(force.max()),
            "error_mm": _rms(row["error"][0] for row in rows),
            "error_percent": _rms(row["error"][1] for row in rows),
            "bad": sum(row["bad"] for row in rows),
            "seconds_median": float(np.median([row["seconds"] for row in rows])),
        }
        for method in ("gains_only", "fine_tuned", "gauss_newton"):
            values = [row[method] for row in rows if method in row]
            entry[method] = [_rms(value[axis] for value in values) for axis in (0, 1)] if values else None
        table[str(count)] = entry
    return table


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def picture(tables: dict[str, dict[str, Any]], path: Path) -> None:
    """Position error and force error against the number of presses, a column for each sensor."""
    figure = new_figure(4.6 * len(tables), 7.6)
    rows = figure.subplots(2, len(tables), sharex=True, squeeze=False)
    styles = {
        "gains only": ("gains_only", "#c07a2c", "s"),
        "network tuned on the presses alone, some films": ("fine_tuned", "#8a5aa8", "^"),
        "Gauss-Newton on the calibrated map, some films": ("gauss_newton", "#5a9a5a", "x"),
    }
    for column, (sensor, table) in enumerate(tables.items()):
        for axis, (axes, unit) in enumerate(zip(rows[:, column], ("mm", "percent"), strict=True)):
            axes.axhline(table["uncalibrated"][axis], color="#b03a3a", ls="--", label="no calibration")
            axes.axhline(
                table["without_context"][axis], color="#7a7a7a", ls="-.", label="one network, not told the film"
            )
            for label, (key, colour, marker) in styles.items():
                values = [table[str(n)][key][axis] if table[str(n)][key] else np.nan for n in COUNTS]
                axes.plot(COUNTS, values, marker=marker, color=colour, lw=1.0, label=label)
            values = [table[str(n)][f"error_{unit}"] for n in COUNTS]
            axes.plot(COUNTS, values, "o-", color="#24476b", lw=2.0, label="calibrated network")
            values = [table[str(n)][f"left_{unit}"] for n in COUNTS]
            axes.plot(COUNTS, values, "o", mfc="white", color="#24476b", label="of it by not knowing the film")
            axes.plot(COUNTS, [table[str(n)][f"limit_{unit}"] for n in COUNTS], "k:", label="its linearised limit")
            axes.set(xscale="log", yscale="log", xticks=COUNTS)
            axes.xaxis.set_major_formatter(ScalarFormatter())
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axes.grid(alpha=0.3)
        rows[0, column].set(title=sensor)
        rows[1, column].set(xlabel="presses")
    rows[0, 0].set(ylabel="position error (rms), mm")
    rows[1, 0].set(ylabel="force error (rms), %")
    handles, labels = rows[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(tables), fontsize=8)
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", action="append")
    parser.add_argument("--films", type=int, default=40)
    parser.add_argument("--fine", type=int, default=8)
    parser.add_argument("--coverage", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, default=Path("build/calibration"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    tables: dict[str, dict[str, Any]] = {}
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        for sensor in options.sensor or SENSORS:
            seeds = range(1000 * options.seed, 1000 * options.seed + options.films)
            jobs = [(sensor, seed, number < options.fine) for number, seed in enumerate(seeds)]
            tables[sensor] = summary(list(pool.map(study, jobs)))
            pooled = pool.submit(pooled_errors, (sensor, seeds[0], options.films)).result()
            tables[sensor]["without_context"] = [_rms(row[axis] for row in pooled) for axis in (0, 1)]
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
