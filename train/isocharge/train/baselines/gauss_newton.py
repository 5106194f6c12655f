"""Maximum a posteriori estimate of a contact by the Gauss-Newton method on a charge map.

The residuals are (Q - Q(c)) / sigma(Q). Here Q are the measured charges, Q(c) are the charges of a contact c, and sigma
is the standard deviation of the noise. The prior is uniform over the disk and over the logarithm of the force, so it
only constrains the contact. The search starts at the press with the nearest charges. If the residuals of the solution
are too large, it starts again at the press with the next nearest charges.
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

N_STARTS = 600
"""Number of presses among which the start of a search is chosen."""

MAX_ATTEMPTS = 3
"""Largest number of searches for one press."""

RESTART_THRESHOLD = 12.0
"""Sum of squared residuals above which another start is tried.

With three or four charges, noise alone rarely causes a larger sum.
"""

BATCH = 512
"""Number of presses that are searched at once. The polynomials of a batch fit into the processor's cache."""

VALIDATION_FRACTION = 0.1
"""Fraction of the positions by which the degree of the charge series is chosen."""


class GaussNewton(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Regressor that searches for the contact whose charges agree best with the measured charges.

    Args:
        domain: Contacts that can occur.
        noise: Noise whose standard deviation is the unit of the residuals.
        charge_map: Map from contacts to charges; None to fit a `ChargeField` to the presses.
        seed: Seed of the starts.
    """

    def __init__(self, domain: Domain, noise: NoiseModel, charge_map: ChargeMap | None = None, seed: int = 0) -> None:
        self.domain = domain
        self.noise = noise
        self.charge_map = charge_map
        self.seed = seed

    def fit(self, charge: Array, contact: Array) -> "GaussNewton":
        """Fit the charge map unless one is given, and choose the starts of the searches.

        Args:
            charge: Charges without noise, shape (n, n_electrode), pC.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            This estimator.
        """
        presses = LabelledPresses(contact, charge)
        if self.charge_map is not None:
            self.map_ = self.charge_map
        else:
            n_electrode = charge.shape[1]
            names = tuple(str(electrode_index) for electrode_index in range(n_electrode))
            train, validation = split_by_position(presses, VALIDATION_FRACTION, self.seed)
            self.map_ = ChargeField.fit(self.domain, names, train, validation)

        # A search begins at the chosen press whose charges are most similar, which the tree finds.
        shuffled_rows = np.random.default_rng(self.seed).permutation(len(presses))
        start_rows = shuffled_rows[:N_STARTS]
        self.features_ = whitening().fit(charge)
        self.starts_ = contact[start_rows]
        self.tree_ = cKDTree(self.features_.transform(charge[start_rows]))
        return self

    def predict(self, charge: Array) -> Array:
        """Estimate contacts, shape (n, 3), mm and N, from charges of shape (n, n_electrode), pC."""
        batches = [self._search(charge[first : first + BATCH]) for first in range(0, len(charge), BATCH)]
        return np.concatenate(batches)

    def _search(self, charge: Array) -> Array:
        """Estimate the contacts of one batch.

        The search is repeated from the next start for presses whose sum of squared residuals is still too large.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Each is the best result of the searches from several starts.
        """
        sigma = self.noise.sigma(charge)
        features = self.features_.transform(charge)
        contact = np.empty((len(charge), 3))
        square_sum = np.full(len(charge), np.inf)
        for attempt in range(1, MAX_ATTEMPTS + 1):
            remaining = np.flatnonzero(square_sum > RESTART_THRESHOLD)
            if not remaining.size:
                break
            # The first attempt begins at the nearest start, the second at the next nearest start, and so on. The query
            # for the neighbour with the rank `attempt` returns indices of shape (n, 1).
            _, nearest = self.tree_.query(features[remaining], [attempt])
            start = self.starts_[nearest[:, 0]]
            solution, residual = explain(self.map_, charge[remaining], sigma[remaining], start)
            solution_square_sum = (residual**2).sum(axis=1)
            is_better = solution_square_sum < square_sum[remaining]
            improved_rows = remaining[is_better]
            contact[improved_rows] = solution[is_better]
            square_sum[improved_rows] = solution_square_sum[is_better]
        return contact
