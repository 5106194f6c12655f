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
LEVELS = np.array([0.68, 0.95])
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


def interval_coverage(estimate: np.ndarray, std: np.ndarray, truth: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Compute the fraction of true values that lie in the central intervals of normal distributions.

    Args:
        estimate: Estimated contacts (x, y, F), shape (n, 3), mm and N: the means of the distribution.
        std: Standard deviations of the estimates, shape (n, 3), mm and N.
        truth: True contacts (x, y, F), shape (n, 3), mm and N.
        levels: Nominal probabilities of the intervals, shape (n_level,), 0 to 1.

    Returns:
        Fractions for x, y and F, shape (n_level, 3). They equal the levels if the standard deviations are correct.
    """
    standardised_error = np.abs(estimate - truth) / std
    half_width = norm.ppf(0.5 + 0.5 * levels)  # in standard deviations, shape (n_level,)
    is_inside = standardised_error[None] <= half_width[:, None, None]  # shape (n_level, n, 3)
    return np.asarray(np.mean(is_inside, axis=1))


def coverage(case: ModelCase, count: int) -> dict[str, Any]:
    """Measure how often the 68 and 95 % intervals contain the true coordinates.

    Returns:
        Smallest and largest coverage of x, y and the force: over all presses, and over thirds of the presses by radius
        and by force.
    """
    truth = case.presses[:count]
    contact, std = case.estimate(case.noisy_charge(truth))
    by_radius = np.argsort(np.hypot(truth[:, 0], truth[:, 1]))
    by_force = np.argsort(truth[:, 2])
    thirds = [*np.array_split(by_radius, 3), *np.array_split(by_force, 3)]
    total_coverage = interval_coverage(contact, std, truth, LEVELS)
    third_coverage = np.stack([interval_coverage(contact[rows], std[rows], truth[rows], LEVELS) for rows in thirds])
    results: dict[str, Any] = {"draws": count}
    for index, level in enumerate(LEVELS):
        of_all = total_coverage[index]
        of_thirds = third_coverage[:, index]
        results[f"{level:.0%} of all"] = [float(of_all.min()), float(of_all.max())]
        results[f"{level:.0%} of a third"] = [float(of_thirds.min()), float(of_thirds.max())]
    return results


def main() -> None:
    asked = arguments(__doc__, models=RELEASED, presses=6000, draws=MAX_PRESSES, seed=1, json=False)
    results = {}
    for model in asked.models.split(","):
        case = ModelCase(model, asked.seed)
        results[f"{model}, within {case.radius:.2f} mm"] = measure_errors(case, asked.presses) | coverage(
            case, asked.draws
        )
    print_results("model", asked, results)


if __name__ == "__main__":
    main()
