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
from isocharge.simulate.numerics.disk_least_squares import minimise
from isocharge.simulate.plots.figure import new_figure
from isocharge.train import SensorFilms, calibrate, films_for
from isocharge.train.calibration.contact_error import ContactSensitivity
from isocharge.train.calibration.film_charges import charges_of
from isocharge.train.calibration.next_press import information_of
from isocharge.train.data.noise import sigma_pC, with_noise
from isocharge.train.training.checkpoint import Checkpoint
from isocharge.train.training.descent import Descent, TrainingStage
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
def films_of(sensor: str) -> SensorFilms:
    return films_for(load_sensor(sensor), Circle(1e-3))


def contacts(rng: np.random.Generator, films: Any, count: int) -> np.ndarray:
    """(x_mm, y_mm, force_N) even over the working area and the logarithm of the force."""
    radius, angle = films.domain.radius_mm * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    low, high = np.log(films.domain.force_range_N)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.exp(rng.uniform(low, high, count))])


def errors(answer: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Root-mean-square errors of the position, mm, and of the force, %."""
    squares = ((answer[:, :2] - truth[:, :2]) ** 2).sum(axis=1)
    return float(np.sqrt(squares.mean())), float(100.0 * np.sqrt(np.mean((answer[:, 2] / truth[:, 2] - 1.0) ** 2)))


def limit(chosen: SensorFilms, truth: np.ndarray, contact: np.ndarray) -> tuple[float, float]:
    """The linearised limit of what not knowing the film leaves after presses at `contact`, at the true film."""
    scene = chosen.scene
    information = np.eye(truth.size)
    if len(contact):
        told = information_of(scene.charges, truth, contact, scene.noise, POSITION_MM, FORCE)
        information = information + told.sum(axis=0)
    left = ContactSensitivity.at(scene.charges, truth, scene.domain, scene.noise).left(np.linalg.inv(information))
    return left.position_mm, left.force_percent


def gains_only(chosen: SensorFilms, presses: MeasuredPresses) -> np.ndarray:
    """The described film with the gains that fit the presses best."""
    parameters = chosen.described.parameters.copy()
    expected = chosen.scene.charges.charge_pC(parameters, presses.contact)
    ratio = np.maximum(presses.charge_pC, 1.0) / np.maximum(expected, 1.0)
    parameters[-expected.shape[1] :] += np.median(np.log(ratio), axis=0)
    return parameters


def fine_tuned(chosen: SensorFilms, presses: MeasuredPresses, charge_pC: np.ndarray, seed: int) -> np.ndarray:
    """Contacts by the network of the described film, all of its weights tuned on the presses alone."""
    films = chosen.films
    network = films.fold(chosen.described.parameters)
    layers = network.layers
    weights = [torch.tensor(part) for layer in (*layers.hidden, layers.last) for part in layer]
    weights.append(torch.tensor(layers.skip))
    for weight in weights:
        weight.requires_grad_(True)
    scale = torch.tensor(films.domain.scale)

    def answers(charge: torch.Tensor) -> torch.Tensor:
        logs = torch.log(charge.clamp(1.0, 1e6) / torch.tensor(network.typical))
        value = logs
        for number in range(len(layers.hidden)):
            value = torch.tanh(value @ weights[2 * number] + weights[2 * number + 1])
        return (value @ weights[-3] + weights[-2] + logs @ weights[-1])[:, :3]

    random = torch.Generator().manual_seed(seed)
    charge, contact = torch.tensor(presses.charge_pC), torch.tensor(presses.contact)
    target = torch.stack([contact[:, 0], contact[:, 1], torch.log(contact[:, 2])], dim=1)
    optimiser = torch.optim.Adam(weights, lr=1e-3)
    for _ in range(TUNING_STEPS):
        noise = torch.hypot(torch.tensor(1.0).double(), 0.002 * charge)
        noisy = charge + noise * torch.randn(charge.shape, generator=random, dtype=torch.float64)
        loss = (((answers(noisy) - target) / scale) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        tuned = answers(torch.tensor(charge_pC)).numpy()
    return np.column_stack([tuned[:, :2], np.exp(tuned[:, 2])])


def without_context(sensor: str) -> InverseNetwork:
    """One network for all films that is not told the film: the mean over the films, by maximum likelihood."""
    films, rng = films_of(sensor).films, np.random.default_rng(3)
    parts = []
    for parameters in films.prior.draw(rng, POOLED_FILMS):
        at = contacts(rng, films, POOLED_PRESSES)
        parts.append((at, charges_of(films.family.forward_map(*films.prior.film(parameters)), at)))
    contact, charge_pC = (np.concatenate(part) for part in zip(*parts, strict=True))
    torch.manual_seed(0)
    network = InverseNetwork(films.domain, Features.fit(charge_pC), (96, 96, 96), (8,))
    charge, unit = torch.tensor(charge_pC).float(), torch.tensor(films.domain.to_unit(contact)).float()
    held = len(charge) // 10

    def loss_of(rows: torch.Tensor, step: int, random: torch.Generator) -> torch.Tensor:
        sigma = torch.hypot(torch.tensor(1.0), 0.002 * charge[rows])
        noisy = charge[rows] + sigma * torch.randn(sigma.shape, generator=random)
        mean, log_std = network.posterior(noisy)
        miss = mean - unit[rows]
        if step < POOLED_STEPS // 7:
            return (
                (30.0 * miss**2 + 0.1 * (log_std + 0.5 * miss.detach() ** 2 * torch.exp(-2.0 * log_std))).sum(1).mean()
            )
        return (log_std + 0.5 * (miss * torch.exp(-log_std)) ** 2).sum(dim=1).mean()

    def loss(step: int, random: torch.Generator) -> torch.Tensor:
        return loss_of(held + torch.randint(len(charge) - held, (1024,), generator=random), step, random)

    def score() -> tuple[float, str]:
        with torch.no_grad():
            return loss_of(torch.arange(held), POOLED_STEPS, torch.Generator().manual_seed(5)).item(), ""

    stage = TrainingStage("contact", network.contact, loss, score, POOLED_STEPS, POOLED_STEPS // 7)
    Descent(stage, 0.005, POOLED_STEPS, 0).run(Checkpoint(), lambda _step, _text: None)
    return network.eval()


def pooled_errors(job: tuple[str, int, int]) -> list[tuple[float, float]]:
    """Errors of that network on the fresh contacts of every film."""
    torch.set_num_threads(1)
    sensor, first, count = job
    films, network = films_of(sensor).films, without_context(sensor)
    rows = []
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, 13])
        at = contacts(rng, films, CONTACTS)
        film = films.family.forward_map(*films.prior.film(films.prior.draw(np.random.default_rng([seed, 7]), 1)[0]))
        charge_pC = with_noise(charges_of(film, at), films.noise, rng)
        with torch.no_grad():
            answer = network(torch.tensor(charge_pC).float())[0].double().numpy()
        rows.append(errors(answer, at))
    return rows


def gauss_newton(chosen: SensorFilms, parameters: np.ndarray, charge_pC: np.ndarray) -> np.ndarray:
    """Contacts by least squares on the calibrated film's forward map, started from its network's."""
    films, charges = chosen.films, chosen.scene.charges
    domain, forward_map = films.domain, charges.forward_map(parameters)
    sigma = sigma_pC(films.noise, charge_pC)

    def residuals(rows: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = charges.into_domain(domain.to_contact(unit))
        slopes = charges.by_contact(forward_map, at) * domain.scale
        miss = (charge_pC[rows] - charges_of(forward_map, at)) / sigma[rows]
        return miss, -(slopes / sigma[rows][:, :, None]).transpose(0, 2, 1)

    start = domain.to_unit(films.fold(parameters).predict(charge_pC)[0])
    unit, _ = minimise(residuals, start, steps=8)
    return domain.to_contact(unit)


def study(job: tuple[str, int, bool]) -> dict[str, Any]:
    """One film: errors of every method by number of presses."""
    torch.set_num_threads(1)
    sensor, seed, fine = job
    chosen = films_of(sensor)
    films, charges = chosen.films, chosen.scene.charges
    rng = np.random.default_rng([seed, 7])
    truth = films.prior.draw(rng, 1)[0]
    film = charges.forward_map(truth)
    if fine:  # solved for this film, independently of the family
        film = ForwardMap.build(*films.prior.film(truth), 1.02e-3 * films.domain.radius_mm)
    real, fresh = contacts(rng, films, max(COUNTS)), contacts(rng, films, CONTACTS)
    charge = with_noise(charges_of(film, real), films.noise, rng)
    test = with_noise(charges_of(film, fresh), films.noise, rng)
    read = real.copy()
    read[:, :2] += POSITION_MM * rng.standard_normal((len(real), 2))
    read[:, 2] *= np.exp(FORCE * rng.standard_normal(len(real)))
    at_truth = films.fold(truth).predict(test)[0]
    record: dict[str, Any] = {
        "sensor": sensor,
        "seed": seed,
        "noise": errors(at_truth, fresh),
        "uncalibrated": errors(films.fold(chosen.described.parameters).predict(test)[0], fresh),
        "by_count": {},
    }
    for count in COUNTS:
        std = np.full(count, POSITION_MM), np.full(count, FORCE)
        names = films.prior.sensor.electrode_names
        presses = MeasuredPresses(read[:count], charge[:count], *std, names, tuple(range(count)))
        began = time.perf_counter()
        calibration = calibrate(presses, chosen.scene, chosen.described, warn=lambda _: None)
        seconds = time.perf_counter() - began
        answer = films.fold(calibration.posterior.parameters).predict(test)[0]
        row = {
            "left": errors(answer, at_truth),
            "limit": limit(chosen, truth, real[:count]),
            "error": errors(answer, fresh),
            "gains_only": errors(films.fold(gains_only(chosen, presses)).predict(test)[0], fresh),
            "bad": int(calibration.posterior.bad.sum()),
            "seconds": seconds,
        }
        if fine:
            row["fine_tuned"] = errors(fine_tuned(chosen, presses, test, seed), fresh)
            row["gauss_newton"] = errors(gauss_newton(chosen, calibration.posterior.parameters, test), fresh)
        record["by_count"][count] = row
    return record


def covered(job: tuple[str, int]) -> tuple[int, int]:
    """How many of the identified quantities of a film lie in their 95 % intervals, and how many there are."""
    sensor, seed = job
    chosen = films_of(sensor)
    charges, prior = chosen.scene.charges, chosen.films.prior
    rng = np.random.default_rng([seed, 11])
    truth, count = prior.draw(rng, 1)[0], 10
    real = contacts(rng, chosen.films, count)
    charge = with_noise(charges.charge_pC(truth, real), chosen.films.noise, rng)
    read = real.copy()
    read[:, :2] += POSITION_MM * rng.standard_normal((count, 2))
    read[:, 2] *= np.exp(FORCE * rng.standard_normal(count))
    std = np.full(count, POSITION_MM), np.full(count, FORCE)
    presses = MeasuredPresses(read, charge, *std, prior.sensor.electrode_names, tuple(range(count)))
    calibration = calibrate(presses, chosen.scene, chosen.described, warn=lambda _: None)
    inside = total = 0
    for quantity in calibration.quantities.values():
        if quantity.identified:
            off = float(quantity.weights @ ((calibration.posterior.parameters - truth) / prior.std))
            inside, total = inside + (abs(off) <= 1.96 * quantity.std), total + 1
    return inside, total


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
