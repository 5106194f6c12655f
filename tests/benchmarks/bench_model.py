"""Released models against the Bayes limit, and their intervals: the table of train/docs/accuracy.md.

    python tests/benchmarks/bench_model.py [--models NAME,...] [--presses 6000] [--draws 40000] [--seed 1] [--json]

The presses of a circle of 1 mm are simulated separately and were not in the training data. They have `reference` noise
and the forces of the model. Computing the Bayes limit takes half a minute
for a thousand presses.
"""

from typing import Any

import numpy as np
from bayes.posterior import Posterior
from scipy.stats import norm
from shared import arguments, errors_over_limit, inner_radius_mm, model_film, print_results

from isocharge.serve import Predictor
from isocharge.simulate import ChargeSpline, Sweep, noise_model

RELEASED = "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial"
MARGIN_mm = 0.01
"""Distance beyond the working area up to which charges are computed, so that rounding leaves no press out, mm."""

MAX_PRESSES = 40_000
"""Largest number of presses."""

NOISE = noise_model("reference")
LEVELS = (0.68, 0.95)
"""Levels of the intervals whose coverage is measured."""


class ModelCase:
    """A model, the forward map of its sensor, and presses over its working area.

    Attributes:
        predictor: The model.
        radius: Radius of the working area, mm.
        film: Forward map of the sensor.
        presses: Contacts (x, y, F), shape (MAX_PRESSES, 3), mm and N.
        rng: Random number generator of the noise.
    """

    def __init__(self, model: str, seed: int) -> None:
        self.predictor = Predictor(model)
        self.rng = np.random.default_rng([seed, 1])
        self.radius = inner_radius_mm(self.predictor)
        self.film = model_film(self.predictor, self.radius + MARGIN_mm)
        self.presses = Sweep(self.radius, self.film.domain.force_range, MAX_PRESSES, seed).contacts()

    def noisy_charge(self, contact: np.ndarray) -> np.ndarray:
        """Return the charges of contacts with noise, shape (n, n_electrode), pC."""
        return NOISE.add(self.film.charges(contact), self.rng)

    def estimate(self, charge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return contacts, shape (n, 3), and their standard deviations, shape (n, 3)."""
        outputs = np.stack(self.predictor.predict_batch(charge), axis=1).astype(float)
        contact, std, _ = np.split(outputs, [3, 6], axis=1)
        return contact, std


def measure_errors(case: ModelCase, count: int) -> dict[str, Any]:
    """Compare the errors of the model with those of the posterior mean on the same charges."""
    truth = case.presses[:count]
    charge = case.noisy_charge(truth)
    bayes_contact, _ = Posterior(ChargeSpline.of(case.film), NOISE, case.radius).mean_and_std(charge)
    contact, _ = case.estimate(charge)
    return {"presses": count, **errors_over_limit(contact, bayes_contact, truth)}


def coverage(case: ModelCase, count: int) -> dict[str, Any]:
    """Measure how often the central 68 and 95 % intervals of normal distributions contain the true coordinates.

    Returns:
        Smallest and largest coverage of x, y and the force: over all presses, and over thirds of the presses by radius
        and by force.
    """
    truth = case.presses[:count]
    contact, std = case.estimate(case.noisy_charge(truth))
    standardised_error = np.abs(contact - truth) / std
    by_radius = np.argsort(np.hypot(truth[:, 0], truth[:, 1]))
    by_force = np.argsort(truth[:, 2])
    groups = {"all": [by_force], "a third": [*np.array_split(by_radius, 3), *np.array_split(by_force, 3)]}
    results: dict[str, Any] = {"draws": count}
    for level in LEVELS:
        is_inside = standardised_error <= norm.ppf(0.5 + 0.5 * level)
        for name, row_groups in groups.items():
            shares = [is_inside[rows].mean(axis=0) for rows in row_groups]
            results[f"{level:.0%} of {name}"] = [float(np.min(shares)), float(np.max(shares))]
    return results


def main() -> None:
    asked = arguments(__doc__, models=RELEASED, presses=6000, draws=MAX_PRESSES, seed=1)
    results = {}
    for model in asked.models.split(","):
        case = ModelCase(model, asked.seed)
        results[f"{model}, within {case.radius:.2f} mm"] = measure_errors(case, asked.presses) | coverage(
            case, asked.draws
        )
    print_results("model", asked, results)


if __name__ == "__main__":
    main()
