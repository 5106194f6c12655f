"""Gauss-Newton on a charge map: the contact whose charges fit best, maximum a posteriori.

The residuals are (Q - Q(c)) / sigma(Q); the prior, uniform over the disk and the range of log force, is a constraint.
The start is the nearest of a few presses, and the next nearest where that led to charges that do not fit.
"""

import numpy as np
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeMap, Domain, NoiseModel
from isocharge.simulate.identifiability.nearest_contact import explain
from isocharge.train.baselines.learned import whitening
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.presses import LabelledPresses, split_by_position

STARTS = 600
"""Presses that a start is chosen from."""

ATTEMPTS = 3
"""Starts at most."""

DOUBTFUL = 12.0
"""Sum of squared residuals from which another start is tried: noise alone, with a charge or none to spare, hardly
reaches it."""

BATCH = 512
"""Presses at once: their polynomials stay in the cache."""

HELD = 0.1
"""Share of the positions by which the degree of the series is chosen."""


class GaussNewton(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """The search.

    Attributes:
        domain: The contacts that can occur.
        noise: The unit of the residuals.
        charge_map: What is searched; the series of `ChargeField`, fitted to the presses, if absent.
        seed: Of the starts.
    """

    def __init__(self, domain: Domain, noise: NoiseModel, charge_map: ChargeMap | None = None, seed: int = 0) -> None:
        self.domain, self.noise, self.charge_map, self.seed = domain, noise, charge_map, seed

    def fit(self, charge: Array, contact: Array) -> "GaussNewton":
        """Map and starts from clean presses."""
        presses = LabelledPresses(contact, charge)
        names = tuple(map(str, range(charge.shape[1])))
        self.map_ = self.charge_map or ChargeField.fit(self.domain, names, *split_by_position(presses, HELD, self.seed))
        rows = np.random.default_rng(self.seed).permutation(len(presses))[:STARTS]
        self.features_, self.starts_ = whitening().fit(charge), contact[rows]
        self.tree_ = cKDTree(self.features_.transform(charge[rows]))
        return self

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3)."""
        return np.concatenate([self._search(charge[k : k + BATCH]) for k in range(0, len(charge), BATCH)])

    def _search(self, charge: Array) -> Array:
        sigma, features = self.noise.sigma(charge), self.features_.transform(charge)
        contact, square = np.empty((len(charge), 3)), np.full(len(charge), np.inf)
        for attempt in range(1, ATTEMPTS + 1):
            again = np.flatnonzero(square > DOUBTFUL)
            if not again.size:
                break
            start = self.starts_[self.tree_.query(features[again], [attempt])[1][:, 0]]
            found, residual = explain(self.map_, charge[again], sigma[again], start)
            found_square = (residual**2).sum(axis=1)
            better = found_square < square[again]
            contact[again[better]], square[again[better]] = found[better], found_square[better]
        return contact
