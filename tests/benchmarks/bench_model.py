"""Released models against the Bayes limit, and their intervals: the table of train/docs/accuracy.md.

    python tests/benchmarks/bench_model.py [--models NAME,...] [--presses 6000] [--draws 40000] [--seed 1]

The presses of a circle of 1 mm are simulated separately and were not in the training data. They have `reference` noise
and the forces of the model. Computing the Bayes limit takes half a minute for a thousand presses.
"""

from itertools import product
from typing import Any

import numpy as np
from scipy.stats import chi2, norm
from shared import LimitedPresses, arguments, inner_radius_mm, model_film, print_results, whitened_errors

from isocharge.serve import Predictor
from isocharge.simulate import Sweep, noise_model

RELEASED = "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial"
MARGIN_mm = 0.01
"""Distance beyond the working area up to which charges are computed, so that rounding leaves no press out, mm."""

NOISE = noise_model("reference")
LEVELS = (0.68, 0.95)
"""Levels of the intervals whose coverage is measured."""


def coverage(truth: np.ndarray, estimate: np.ndarray) -> dict[str, list[float]]:
    """Measure how often the central 68 and 95 % intervals and ellipsoids contain the true contacts.

    Args:
        truth: Contacts (x, y, F), shape (n, 3), mm and N.
        estimate: Outputs of a model, shape (n, 10).

    Returns:
        Smallest and largest coverage by intervals of x, y and the force, and by ellipsoids: over all presses, and over
        thirds of the presses by radius and by force.
    """
    contact, std, _, correlation = np.split(estimate, [3, 6, 7], axis=1)
    squared_distance = np.sum(whitened_errors(contact, truth, std, correlation) ** 2, axis=1, keepdims=True)
    regions = {"": 2.0 * norm.cdf(np.abs(contact - truth) / std) - 1.0, "ellipsoid, ": chi2.cdf(squared_distance, 3)}
    by_radius = np.argsort(np.hypot(truth[:, 0], truth[:, 1]))
    by_force = np.argsort(truth[:, 2])
    groups = {"all": [by_force], "a third": [*np.array_split(by_radius, 3), *np.array_split(by_force, 3)]}
    results = {}
    for level, region, name in product(LEVELS, regions, groups):
        is_inside = regions[region] <= level
        shares = [is_inside[rows].mean(axis=0) for rows in groups[name]]
        results[f"{region}{level:.0%} of {name}"] = [float(np.min(shares)), float(np.max(shares))]
    return results


def measure(model: str, presses: int, draws: int, seed: int) -> dict[str, Any]:
    """Measure a model.

    Args:
        model: Name or path of the model.
        presses: Number of presses whose errors are compared with the limit.
        draws: Number of presses on which the coverage is measured.
        seed: Seed of the presses and of the noise.
    """
    predictor = Predictor(model)
    radius = inner_radius_mm(predictor)
    film = model_film(predictor, radius + MARGIN_mm)

    def estimate(charge: np.ndarray) -> np.ndarray:
        """Return the outputs of the model, shape (n, 10)."""
        return np.stack(predictor.predict_batch(charge), axis=1).astype(float)

    limited = LimitedPresses.draw(film, radius, presses, NOISE, seed)
    truth = Sweep(radius, film.domain.force_range, draws, seed).contacts()
    charge = NOISE.add(film.charges(truth), np.random.default_rng([seed, 2]))
    errors = limited.errors(estimate(limited.charge)[:, :3])
    return {"radius_mm": radius, **errors, **coverage(truth, estimate(charge))}


def main() -> None:
    asked = arguments(__doc__, models=RELEASED, presses=6000, draws=40_000, seed=1)
    models = asked.models.split(",")
    print_results("model", asked, {model: measure(model, asked.presses, asked.draws, asked.seed) for model in models})


if __name__ == "__main__":
    main()
