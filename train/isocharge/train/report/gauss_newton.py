"""Maximum a posteriori estimate of a contact by the Gauss-Newton method on a charge map.

The residuals are (Q - Q(c)) / sigma(Q). Q are the measured charges, Q(c) are the charges of a contact c, and sigma(Q)
is the standard deviation of the noise. The prior is uniform over the disk and in the logarithm of the force. The only
effect of this prior is that the contact is restricted to the domain. A search starts at the press with the nearest
charges. If the residuals of the result are too large, the search starts again at the press with the next nearest
charges.
"""

import numpy as np
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA
from sklearn.pipeline import Pipeline

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeMap, Domain, NoiseModel
from isocharge.simulate.identifiability.nearest_contact import explain
from isocharge.train.data.channel_noise import BOTH_SIGNS, MIN_TRANSITION_RATIO, usual_size
from isocharge.train.data.charge_fit import fit_charge_series
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses, split_by_position

N_STARTS = 600
"""Number of presses among which the start of each search is chosen."""

MAX_ATTEMPTS = 3
"""Largest number of searches for one press."""

RESTART_THRESHOLD = 12.0
"""Sum of squared residuals above which a search is repeated from another start.

With three or four charges, noise alone rarely causes a larger sum.
"""

BATCH = 512
"""Number of presses whose contacts are searched for at once. The polynomials of a batch fit into the cache."""

VALIDATION_FRACTION = 0.1
"""Fraction of the positions whose presses are used to choose the degree of the charge series."""


def whitening() -> Pipeline:
    """Return a transformer that computes whitened logarithms of charges, shape (n, n_electrode), pC."""
    return Pipeline([("logarithms", Logarithms()), ("whitening", PCA(whiten=True))])


class Logarithms(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Transformer that computes ln(max(Q, 1 pC)), or asinh(2 Q / usual size) if the charges have both signs."""

    def fit(self, charge: Array, target: object = None) -> "Logarithms":
        """Determine whether the charges have both signs and, if they do, compute the scale of the transformation.

        The charges of an electrode have both signs if more than the fraction `BOTH_SIGNS` of them is not positive. A
        smaller fraction can be due to noise alone. If at least one electrode has charges of both signs, the charges of
        all electrodes are transformed to asinh(Q / scale). This function is linear for charges far below the scale and
        logarithmic for charges far above it. Otherwise, the scale is None, and the charges are transformed to
        logarithms.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            target: Not used; it is an argument of every transformer of scikit-learn.

        Returns:
            This transformer.
        """
        del target
        is_not_positive = charge <= 0.0
        not_positive_fraction = is_not_positive.mean(axis=0)  # one value for each electrode
        any_has_both_signs = (not_positive_fraction > BOTH_SIGNS).any()
        self.scale_ = None
        if any_has_both_signs:
            self.scale_ = MIN_TRANSITION_RATIO * usual_size(charge)  # shape (n_electrode,), pC
        return self

    def transform(self, charge: Array) -> Array:
        """Transform charges, shape (n, n_electrode), pC. The result has the same shape."""
        if self.scale_ is None:
            return np.asarray(np.log(np.maximum(charge, LOWEST_CHARGE)))
        return np.asarray(np.arcsinh(charge / self.scale_))


class GaussNewton:
    """Method that searches for the contact whose charges agree best with the measured charges.

    Args:
        domain: Contacts that can occur.
        noise: Noise whose standard deviation is the unit of the residuals.
        charge_map: Map from contacts to charges; None to fit a `ChargeSeries` to the presses.
        seed: Seed of the random choice of the starts.
    """

    def __init__(self, domain: Domain, noise: NoiseModel, charge_map: ChargeMap | None = None, seed: int = 0) -> None:
        self.domain = domain
        self.noise = noise
        self.charge_map = charge_map
        self.seed = seed

    def fit(self, charge: Array, contact: Array) -> "GaussNewton":
        """Choose the starts of the searches. If no charge map is given, fit a charge map to the presses first.

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
            # Fit a series of polynomials, whose degree is chosen on the validation presses.
            n_electrode = charge.shape[1]
            electrode_names = tuple(str(electrode_index) for electrode_index in range(n_electrode))
            train, validation = split_by_position(presses, VALIDATION_FRACTION, self.seed)
            self.map_ = fit_charge_series(self.domain, electrode_names, train, validation)

        # Choose some presses at random as starts of the searches. A search begins at the start whose charges are most
        # similar to the measured charges. The tree finds this start by the whitened logarithms of the charges.
        shuffled_rows = np.random.default_rng(self.seed).permutation(len(presses))
        start_rows = shuffled_rows[:N_STARTS]
        self.start_contacts_ = contact[start_rows]
        self.whitening_ = whitening().fit(charge)
        self.start_tree_ = cKDTree(self.whitening_.transform(charge[start_rows]))
        return self

    def predict(self, charge: Array) -> Array:
        """Estimate contacts, shape (n, 3), mm and N, from charges of shape (n, n_electrode), pC."""
        batches = [self._search(charge[first : first + BATCH]) for first in range(0, len(charge), BATCH)]
        return np.concatenate(batches)

    def _search(self, charge: Array) -> Array:
        """Estimate the contacts of one batch of presses.

        The residuals of a press with the charges Q are (Q - Q(c)) / sigma. Q(c) are the charges of the estimated
        contact c, and sigma are the standard deviations of the noise. If the sum of the squared residuals of a press is
        above `RESTART_THRESHOLD`, the search is repeated from another start, up to `MAX_ATTEMPTS` searches in all.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Each contact is the result with the smallest sum of squared
            residuals.
        """
        sigma = self.noise.sigma(charge)
        features = self.whitening_.transform(charge)
        best_contact = np.empty((len(charge), 3))
        smallest_square_sum = np.full(len(charge), np.inf)  # so that the first attempt searches all presses
        for attempt in range(1, MAX_ATTEMPTS + 1):
            remaining_rows = np.flatnonzero(smallest_square_sum > RESTART_THRESHOLD)
            if not remaining_rows.size:
                break
            # The first attempt begins at the nearest start, the second at the next nearest start, and so on. The query
            # for the neighbour with the rank `attempt` returns indices of shape (n, 1).
            _, start_index = self.start_tree_.query(features[remaining_rows], [attempt])
            start = self.start_contacts_[start_index[:, 0]]
            contact, residual = explain(self.map_, charge[remaining_rows], sigma[remaining_rows], start)

            # Keep the results that are better than those of the earlier attempts.
            square_sum = (residual**2).sum(axis=1)
            is_better = square_sum < smallest_square_sum[remaining_rows]
            improved_rows = remaining_rows[is_better]
            best_contact[improved_rows] = contact[is_better]
            smallest_square_sum[improved_rows] = square_sum[is_better]
        return best_contact
