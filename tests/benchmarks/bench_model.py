"""Released models against the Bayes limit, their intervals and their misfit: the tables of train/docs/accuracy.md.

    python tests/benchmarks/bench_model.py [--models NAME,...] [--presses 6000] [--draws 40000] [--seed 1] [--json]

Presses of a circle of 1 mm from solves of their own, none of them in the training data; `reference` noise, forces of
the model. A minute for a thousand presses against the limit, kept in the cache folder afterwards.
"""

from typing import Any

import numpy as np
from shared import arguments, print_results

from isocharge.common.contact_errors import ContactErrorStatistics
from isocharge.serve import Predictor
from isocharge.simulate import Circle, ForwardMap, Sweep, noise_model
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from isocharge.train.bayes.limit import BayesProblem, bayes_estimate
from isocharge.train.model_release.evaluate import alarm_threshold
from isocharge.train.report.measures import interval_coverage

RELEASED = "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial"
MARGIN_mm = 0.01
"""Distance beyond the working area up to which charges are computed, so that rounding leaves no press out, mm."""
APART = 8.0
"""Distance of two presses at once, mm."""
NOISE = noise_model("reference")
LEVELS = np.array([0.68, 0.95])


class Bench:
    """One model, the simulator's charges over its working area, and a seed."""

    def __init__(self, model: str, seed: int) -> None:
        self.model, self.rng = Predictor(model), np.random.default_rng([seed, 1])
        about = self.model.metadata
        corners = np.array(about.working_area_mm) @ [1.0, 1j]
        self.radius = float(np.abs(0.5 * (corners + np.roll(corners, 1))).min())
        self.presses = Sweep(self.radius, about.force_range_N, 40_000, seed, sampling="random").contacts()
        reach = self.radius + MARGIN_mm
        self.film = ForwardMap.build(sensor_from_dict(about.sensor), Circle(1.0), reach, about.force_range_N)

    def ring(self, count: int, force: float, least: float, most: float) -> np.ndarray:
        """Contacts uniform between two radii, shape (count, 3)."""
        z = np.sqrt(self.rng.uniform(least**2, most**2, count)) * np.exp(2j * np.pi * self.rng.random(count))
        return np.stack([z.real, z.imag, np.full(count, force)], axis=1)

    def answers(self, charge: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Contacts, their standard deviations, and misfits of the model, for charges with noise."""
        found = np.stack(self.model.predict_batch(charge), axis=1).astype(float)
        return found[:, :3], found[:, 3:6], found[:, 6]


def against_limit(bench: Bench, count: int) -> dict[str, Any]:
    """Errors of model and posterior mean on the same noisy charges."""
    truth = bench.presses[:count]
    charge = NOISE.add(bench.film.charges(truth), bench.rng)
    problem = BayesProblem(bench.film.sensor, bench.film.probe, bench.radius, bench.film.domain.force_range, NOISE)
    least = ContactErrorStatistics.of(bayes_estimate(problem, charge, charge_map=bench.film)[0], truth)
    mine = ContactErrorStatistics.of(bench.answers(charge)[0], truth)
    return {
        "presses": count,
        "position_rms_mm": mine.position_rms_mm,
        "position_over_bayes": mine.position_rms_mm / least.position_rms_mm,
        "force_rms_percent": mine.force_rms_percent,
        "force_over_bayes": mine.force_rms_percent / least.force_rms_percent,
    }


def intervals(bench: Bench, count: int) -> dict[str, Any]:
    """Least and largest share of presses in the 68 and 95 % intervals: of all, and of thirds by radius and force."""
    truth = bench.presses[:count]
    contact, std, _ = bench.answers(NOISE.add(bench.film.charges(truth), bench.rng))
    orders = (np.argsort(np.hypot(truth[:, 0], truth[:, 1])), np.argsort(truth[:, 2]))
    thirds = [rows for order in orders for rows in np.array_split(order, 3)]
    shares = np.stack([interval_coverage(contact[rows], std[rows], truth[rows], LEVELS) for rows in thirds])
    of_all = interval_coverage(contact, std, truth, LEVELS)
    found: dict[str, Any] = {"draws": count}
    for k, level in enumerate(LEVELS):
        found[f"{level:.0%} of all"] = [float(of_all[k].min()), float(of_all[k].max())]
        found[f"{level:.0%} of a third"] = [float(shares[:, k].min()), float(shares[:, k].max())]
    return found


def faults(bench: Bench, count: int) -> dict[str, Any]:
    """Shares of presses flagged, with the limit that one good press in a hundred exceeds."""

    def misfits(charge: np.ndarray) -> np.ndarray:
        return bench.answers(NOISE.add(charge, bench.rng))[2]

    limit = alarm_threshold(misfits(bench.film.charges(bench.presses[:count])))

    def flagged(charge: np.ndarray) -> float:
        return float(np.mean(misfits(charge) > limit))

    inside = bench.ring(count, 1.0, 0.0, bench.radius)
    one = bench.film.charges(inside)
    found = {"limit": limit, "good presses of 1 N": flagged(one)}
    channels = np.eye(one.shape[1])
    for name, gain in (("one gain 20 % low", 0.8), ("one gain 20 % high", 1.2), ("one electrode dead", 0.0)):
        found[name] = min(flagged(one * (1.0 + (gain - 1.0) * channel)) for channel in channels)
    beside = inside + bench.ring(count, 0.0, APART, APART)
    both = np.hypot(beside[:, 0], beside[:, 1]) <= bench.radius
    for force in (0.5, 1.0):
        pair = sum(bench.film.charges(contact[both] * [1.0, 1.0, force]) for contact in (inside, beside))
        found[f"two presses of {force:g} N, {APART:g} mm apart"] = flagged(pair)
    return found


def main() -> None:
    asked, results = arguments(__doc__, models=RELEASED, presses=6000, draws=40000, seed=1, json=False), {}
    for model in asked.models.split(","):
        bench = Bench(model, asked.seed)
        results[f"{model}, within {bench.radius:.2f} mm"] = (
            against_limit(bench, asked.presses) | intervals(bench, asked.draws) | faults(bench, asked.draws)
        )
    print_results("model", asked, results)


if __name__ == "__main__":
    main()
