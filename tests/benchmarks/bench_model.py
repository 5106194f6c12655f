"""Released models against the Bayes limit, their intervals and their misfit: the tables of train/docs/accuracy.md.

    python tests/benchmarks/bench_model.py [MODEL ...] [--presses 6000] [--draws 40000] [--seed 1] [--json]

Presses of a circle of 1 mm from solves of their own, none of them in the training data; `reference` noise, forces of
the model. A minute for a thousand presses against the limit, kept in the cache folder afterwards.
"""

import argparse
import json
from typing import Any

import numpy as np
from bench_predictor import machine

from isocharge.serve import Predictor
from isocharge.simulate import Circle, ForwardMap, Sweep, noise_model
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from isocharge.train.bayes.limit import BayesLimit, Scene, bayes_estimate
from isocharge.train.data.alarms import alarm_threshold
from isocharge.train.data.domain import inner_radius
from isocharge.train.report.measures import coverage

RELEASED = ("three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial")
BEYOND_MM = ((0.5, 1.0), (1.0, 2.0))
APART_MM = 8.0
NOISE = noise_model("reference")


class Bench:
    """One model, the simulator's charges some way beyond its working area, and a seed."""

    def __init__(self, model: str, seed: int) -> None:
        self.model, self.seed = Predictor(model), seed
        about = self.model.metadata
        self.radius_mm = inner_radius(about.working_area_mm)
        self.forces_N = about.force_range_N
        self.film = ForwardMap.build(
            sensor_from_dict(about.sensor), Circle(1e-3), 1e-3 * (self.radius_mm + BEYOND_MM[-1][1]), self.forces_N
        )
        self.rng = np.random.default_rng([seed, 1])

    def presses(self, count: int) -> np.ndarray:
        """(x_mm, y_mm, force_N) spread like the prior, shape (count, 3)."""
        sweep = Sweep(1e-3 * self.radius_mm, self.forces_N, count, self.seed, sampling="random")
        x, y, force, _ = sweep.presses()
        return np.stack([1e3 * x, 1e3 * y, force], axis=1)

    def ring(self, count: int, least_mm: float = 0.0, most_mm: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Places uniform between two radii (least, most), mm; within the working area by default."""
        most_mm = self.radius_mm if most_mm is None else most_mm
        r = np.sqrt(self.rng.uniform(least_mm**2, most_mm**2, count))
        angle = self.rng.uniform(0.0, 2.0 * np.pi, count)
        return r * np.cos(angle), r * np.sin(angle)

    def charge(self, x_mm: np.ndarray, y_mm: np.ndarray, force_N: np.ndarray | float) -> np.ndarray:
        """Clean charges, C."""
        return self.film.forward(1e-3 * x_mm, 1e-3 * y_mm, np.broadcast_to(force_N, x_mm.shape))

    def answers(self, charge: np.ndarray) -> Any:
        """The model's, to charges with noise."""
        return self.model.predict_batch(1e12 * NOISE.add(charge, self.rng))


def against_limit(bench: Bench, count: int) -> dict[str, Any]:
    """Errors of model and posterior mean on the same noisy charges."""
    truth = bench.presses(count)
    charge_pC = 1e12 * NOISE.add(bench.charge(*truth.T), bench.rng)
    scene = Scene(bench.film.sensor, bench.film.probe, bench.radius_mm, bench.forces_N, NOISE)
    least = BayesLimit.of(*bayes_estimate(scene, charge_pC, forward_map=bench.film), truth)
    answers = np.stack(bench.model.predict_batch(charge_pC), axis=1).astype(float)
    mine = BayesLimit.of(answers[:, :3], answers[:, 3:6], truth)
    return {
        "presses": count,
        "position_rms_mm": mine.position_rms_mm,
        "position_over_bayes": mine.position_rms_mm / least.position_rms_mm,
        "force_rms_percent": mine.force_rms_percent,
        "force_over_bayes": mine.force_rms_percent / least.force_rms_percent,
    }


def intervals(bench: Bench, count: int) -> dict[str, Any]:
    """Least and largest share of presses in the 68 and 95 % intervals: of all, and of thirds by radius and force."""
    truth, levels = bench.presses(count), np.array([0.68, 0.95])
    answers = np.stack(bench.answers(bench.charge(*truth.T)), axis=1).astype(float)
    contact, std = answers[:, :3], answers[:, 3:6]
    orders = (np.argsort(np.hypot(truth[:, 0], truth[:, 1])), np.argsort(truth[:, 2]))
    thirds = [rows for order in orders for rows in np.array_split(order, 3)]
    of_all = coverage(contact, std, truth, levels)
    of_thirds = np.stack([coverage(contact[rows], std[rows], truth[rows], levels) for rows in thirds])
    return {
        "presses": count,
        **{f"{level:.0%} of all": _ends(of_all[k]) for k, level in enumerate(levels)},
        **{f"{level:.0%} of a third": _ends(of_thirds[:, k]) for k, level in enumerate(levels)},
    }


def _ends(shares: np.ndarray) -> list[float]:
    return [float(shares.min()), float(shares.max())]


def faults(bench: Bench, count: int) -> dict[str, Any]:
    """Shares of presses flagged, with the limit that one good press in a hundred exceeds."""
    good = bench.answers(bench.charge(*bench.presses(count).T)).misfit
    limit = alarm_threshold(good)

    def flagged(charge: np.ndarray) -> float:
        return float(np.mean(bench.answers(charge).misfit > limit))

    x, y = bench.ring(count)
    one, electrodes = bench.charge(x, y, 1.0), range(len(bench.film.sensor.electrodes))
    found = {"good presses of 1 N": flagged(one)}
    for name, gain in (("one gain 20 % low", 0.8), ("one gain 20 % high", 1.2), ("one electrode dead", 0.0)):
        found[name] = min(flagged(one * np.where(np.arange(len(electrodes)) == k, gain, 1.0)) for k in electrodes)
    angle = bench.rng.uniform(0.0, 2.0 * np.pi, count)
    beside = x + APART_MM * np.cos(angle), y + APART_MM * np.sin(angle)
    both = np.hypot(*beside) <= bench.radius_mm
    for force_N in (0.5, 1.0):
        pair = [bench.charge(a[both], b[both], force_N) for a, b in ((x, y), beside)]
        found[f"two presses of {force_N:g} N, {APART_MM:g} mm apart"] = flagged(pair[0] + pair[1])
    for least, most in BEYOND_MM:
        outside = bench.ring(count, bench.radius_mm + least, bench.radius_mm + most)
        found[f"outside by {least:g} to {most:g} mm"] = flagged(bench.charge(*outside, 1.0))
    return {"limit": limit, **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="*", default=RELEASED, metavar="MODEL")
    parser.add_argument("--presses", type=int, default=6000, help="against the limit")
    parser.add_argument("--draws", type=int, default=40000, help="for intervals and faults")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results: dict[str, Any] = {"machine": machine(), "seed": options.seed, "models": {}}
    for model in options.models:
        bench = Bench(model, options.seed)
        results["models"][model] = {
            "radius_mm": bench.radius_mm,
            "limit": against_limit(bench, options.presses),
            "intervals": intervals(bench, options.draws),
            "faults": faults(bench, options.draws),
        }
        if not options.json:
            print(f"{model}, within {bench.radius_mm:.2f} mm")
            for part in ("limit", "intervals", "faults"):
                for name, value in results["models"][model][part].items():
                    print(f"  {name:<42} {np.array2string(np.asarray(value), precision=4)}")
    if options.json:
        print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
