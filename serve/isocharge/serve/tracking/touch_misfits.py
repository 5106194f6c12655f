"""Misfit vectors of a touch on a film with any pretension.

The misfit vector of a touch is the part of its charges, in units of the noise, that no contact explains. There are two
ways to compute it.

- `SeriesMisfits` searches for the contact whose charges are nearest to the measured charges. The charges of the film
  are Chebyshev series (`FilmChargeSeries`).
- `NetworkMisfits` uses the outputs of the network. These outputs are less accurate, but models that were calibrated by
  an earlier version of isocharge have no series.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.film_charges import FilmChargeSeries, read_film_charges
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.model.pretension_nodes import neighbour_weights
from isocharge.serve.model.pretensions import Pretensions
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.tracking.pretension_grid import evenly_spaced, pretension_grid

NODE_STEP_MPa = 0.1
"""Distance between the pretensions at which misfit vectors are computed, MPa.

The misfit vectors at other pretensions are interpolated.
"""

FIRST_ROW_STEPS = 4
"""Number of Gauss-Newton steps of the search for the nearest contact, which begins at the contact of the network.

A last step, which is linear, follows in the computation of the misfit vector.
"""

OTHER_ROWS_STEPS = 2
"""Number of Gauss-Newton steps for further rows of charges, whose search begins at the contact of the first row."""

TYPICAL_MISFIT = 1.15
"""Root mean square misfit of single frames of good touches, in standard deviations of the noise.

The misfit is computed from the series. It exceeds 1, because a calibration does not describe the imperfections of a
film completely.
"""

CONSTANT_MISFIT_VARIANCE = 1.0
"""Variance of the part of the misfit that is equal in all frames of a touch, in units of the noise of a single frame.

This part is caused by errors of the model of the film. On films that have not changed since the calibration, it is
about the square of `TYPICAL_MISFIT` minus 1. On changed films it is larger, because some of their changes are
linearised or omitted.
"""

DAMPING = 1e-4
"""Damping of the Gauss-Newton steps, relative to the mean of the diagonal of the normal matrix."""

LAST_DAMPING = 1e-10
"""Damping of the last, linear step. It only prevents a singular matrix."""

SMALLEST_TRACE = 1e-12
"""Number that is added to the trace of a normal matrix, so that the matrix is never singular."""


class LinearisedMisfits(NamedTuple):
    """Misfit vectors of a touch, and their changes with the charges.

    All values are relative to the root mean square misfit of good touches.

    Attributes:
        vectors: Misfit vectors of each row of charges at each pretension, shape (m, n_pretension, n_electrode).
        changes: Change of the misfit vector of the first row by each given change of the logarithms of the charges,
            shape (n_pretension, n_electrode, n_change).
    """

    vectors: Array
    changes: Array


def relative_misfit_std(relative_noise_variance: float) -> float:
    """Return the typical misfit of averages over several frames, relative to the typical misfit of single frames.

    An average reduces the part of the misfit that noise causes, but not the part that errors of the model cause.

    Args:
        relative_noise_variance: Variance of the noise of the average, relative to the variance for a single frame.
    """
    average_variance = relative_noise_variance + CONSTANT_MISFIT_VARIANCE
    single_frame_variance = 1.0 + CONSTANT_MISFIT_VARIANCE
    return math.sqrt(average_variance / single_frame_variance)


class TouchMisfits(Protocol):
    """Method that computes the misfit vectors of a touch at several pretensions."""

    def at_pretension(self, pretension_MPa: float) -> "TouchMisfits":
        """Return the same method for a single pretension, MPa."""

    def linearise(self, charge_pC: Array, contact: Array, log_changes: Array, /) -> LinearisedMisfits:
        """Compute the misfit vectors of a touch, and their changes that small changes of the charges cause.

        Args:
            charge_pC: Charges of the touch in the first row, and similar charges in further rows, shape (m,
                n_electrode), pC.
            contact: Contact (x, y, F) that the network computed for the touch, shape (3,), mm and N.
            log_changes: Changes of the logarithms of the charges, shape (n_change, n_electrode).
        """


def touch_misfits(predictor: Predictor, pretensions: Pretensions) -> TouchMisfits:
    """Return the method that computes the misfit vectors of touches at the pretensions of `pretension_grid`.

    Args:
        predictor: Model of the calibrated film.
        pretensions: Weights of its network at any pretension.

    Raises:
        ModelError: If the file with the charges of the film is damaged or belongs to another model.
    """
    # The misfit vectors are computed on a coarser grid, and interpolated to the pretensions of `pretension_grid`.
    low_MPa, high_MPa = pretensions.range_MPa
    node_MPa = evenly_spaced(low_MPa, high_MPa, NODE_STEP_MPa)
    grid_MPa = pretension_grid(pretensions)
    film_charges = read_film_charges(predictor.folder, pretensions.typical_pC.size)
    if film_charges is None:
        return NetworkMisfits(pretensions.interpolated(node_MPa), grid_MPa)
    return SeriesMisfits(film_charges, predictor.metadata.noise, node_MPa, grid_MPa)


@dataclass(frozen=True)
class NetworkMisfits:
    """Misfit vectors that the network computes.

    Attributes:
        network: Weights of the network at closely spaced pretensions.
        pretension_MPa: Pretensions to which the misfit vectors are interpolated, shape (n_pretension,), MPa.
    """

    network: Pretensions
    pretension_MPa: Array

    def at_pretension(self, pretension_MPa: float) -> "NetworkMisfits":
        """Return the same method for a single pretension, MPa."""
        return NetworkMisfits(self.network, np.array([pretension_MPa]))

    def linearise(self, charge_pC: Array, _contact: Array, log_changes: Array) -> LinearisedMisfits:
        """Compute the misfit vectors and their changes, which are finite differences; see `TouchMisfits`."""
        # One call evaluates the network for the m given rows of charges and for the changed charges of the first row.
        changed_charge_pC = charge_pC[0] * np.exp(log_changes)  # shape (n_change, n_electrode)
        all_charge_pC = np.vstack([charge_pC, changed_charge_pC])
        all_vectors = self.network.misfit_vectors(all_charge_pC, self.pretension_MPa) / self.network.misfit_rms
        vectors = all_vectors[: len(charge_pC)]
        changes = all_vectors[len(charge_pC) :] - vectors[0]  # shape (n_change, n_pretension, n_electrode)
        return LinearisedMisfits(vectors, np.moveaxis(changes, 0, 2))


@dataclass(frozen=True)
class SeriesMisfits:
    """Misfit vectors that are computed from the nearest contact.

    The misfit vectors are divided by `TYPICAL_MISFIT`, which is the root mean square misfit of good touches.

    Attributes:
        film: Charges of the film at any pretension.
        noise: Noise of the charges.
        node_MPa: Pretensions at which the nearest contacts are searched for, shape (n_node,), MPa, in ascending order.
        pretension_MPa: Pretensions to which the misfit vectors are interpolated linearly, shape (n_pretension,), MPa.
    """

    film: FilmChargeSeries
    noise: ModelNoise
    node_MPa: Array
    pretension_MPa: Array

    def at_pretension(self, pretension_MPa: float) -> "SeriesMisfits":
        """Return the same method for a single pretension, MPa."""
        only_pretension_MPa = np.array([pretension_MPa])
        return SeriesMisfits(self.film, self.noise, only_pretension_MPa, only_pretension_MPa)

    @cached_property
    def _node_film(self) -> FilmChargeSeries:
        """Charges of the film at the pretensions `node_MPa`."""
        return self.film.interpolated(self.node_MPa)

    @cached_property
    def _neighbour_weights(self) -> Array:
        """Weights for an interpolation from `node_MPa` to `pretension_MPa`, shape (n_pretension, n_node)."""
        return neighbour_weights(self.node_MPa, self.pretension_MPa)

    def linearise(self, charge_pC: Array, contact: Array, log_changes: Array) -> LinearisedMisfits:
        """Compute the misfit vectors and their changes from the nearest contacts; see `TouchMisfits`."""
        noise_std_pC = np.sqrt(self.noise.variance(charge_pC))  # shape (m, n_electrode)
        node_vectors, projections = self._misfits_and_projections(charge_pC, noise_std_pC, contact)

        # A change d of the logarithms changes the charges by Q d / sigma in units of the noise. The part that no change
        # of the contact explains is added to the misfit vector.
        scaled_changes = (log_changes * charge_pC[0] / noise_std_pC[0]).T  # shape (n_electrode, n_change)
        first_row_projections = projections[:, 0]  # shape (n_node, n_electrode, n_electrode)
        node_changes = first_row_projections @ scaled_changes  # shape (n_node, n_electrode, n_change)
        vectors = np.tensordot(self._neighbour_weights, node_vectors, axes=1)  # shape (n_pretension, m, n_electrode)
        changes = np.tensordot(self._neighbour_weights, node_changes, axes=1)
        return LinearisedMisfits(vectors.swapaxes(0, 1) / TYPICAL_MISFIT, changes / TYPICAL_MISFIT)

    def _misfits_and_projections(self, charge_pC: Array, noise_std_pC: Array, contact: Array) -> tuple[Array, Array]:
        """Compute the misfit vectors of measured charges at the pretension of each node.

        For each row of charges, the method searches for the contact whose charges are nearest to the row. The misfit
        vector is the remaining difference of the charges, in units of the noise.

        Args:
            charge_pC: Measured charges, shape (m, n_electrode), pC.
            noise_std_pC: Standard deviations of their noise, shape (m, n_electrode), pC.
            contact: Contact (x, y, F) at which the search begins, shape (3,), mm and N.

        Returns:
            Misfit vectors, shape (n_node, m, n_electrode), and the matrices that project a change of the charges, in
            units of the noise, onto the part that no contact explains, shape (n_node, m, n_electrode, n_electrode).
        """
        n_node = self.node_MPa.size
        start = np.broadcast_to(self.film.unit_contact(contact[None]), (n_node, 1, 3))
        first_contact = self._nearest_contacts(charge_pC[:1], noise_std_pC[:1], start, FIRST_ROW_STEPS)

        # The charges of the other rows are similar. Their search begins at the contact of the first row.
        others_start = np.broadcast_to(first_contact, (n_node, len(charge_pC) - 1, 3))
        other_contacts = self._nearest_contacts(charge_pC[1:], noise_std_pC[1:], others_start, OTHER_ROWS_STEPS)
        unit_contact = np.concatenate([first_contact, other_contacts], axis=1)

        # The contacts are not exactly the nearest contacts. A last linear step, which may leave the range of the
        # series, removes the part of the residuals that a change of the contact explains.
        residual, slopes = self._residuals(charge_pC, noise_std_pC, unit_contact)
        explained_projections = slopes @ _damped_solution(slopes, slopes.swapaxes(-1, -2), LAST_DAMPING)
        projections = np.eye(charge_pC.shape[1]) - explained_projections
        misfit_vectors = (projections @ residual[..., None])[..., 0]
        return misfit_vectors, projections

    def _nearest_contacts(self, charge_pC: Array, noise_std_pC: Array, unit_contact: Array, step_count: int) -> Array:
        """Search for the contacts whose charges are nearest to measured charges, by damped Gauss-Newton steps.

        Args:
            charge_pC: Measured charges, shape (m, n_electrode), pC.
            noise_std_pC: Standard deviations of their noise, shape (m, n_electrode), pC.
            unit_contact: Contacts at which the search begins, in the coordinates of the series, shape (n_node, m, 3).
            step_count: Number of steps.

        Returns:
            Contacts within the range of the series, shape (n_node, m, 3).
        """
        for _ in range(step_count):
            residual, slopes = self._residuals(charge_pC, noise_std_pC, unit_contact)
            contact_change = _damped_solution(slopes, slopes.swapaxes(-1, -2) @ residual[..., None], DAMPING)
            unit_contact = _into_unit_range(unit_contact + contact_change[..., 0])
        return unit_contact

    def _residuals(self, charge_pC: Array, noise_std_pC: Array, unit_contact: Array) -> tuple[Array, Array]:
        """Compute the differences between measured charges and the charges of contacts, in units of the noise.

        Args:
            charge_pC: Measured charges, shape (m, n_electrode), pC.
            noise_std_pC: Standard deviations of their noise, shape (m, n_electrode), pC.
            unit_contact: Contacts in the coordinates of the series, shape (n_node, m, 3).

        Returns:
            Differences, shape (n_node, m, n_electrode), and derivatives of the charges of the contacts with respect to
            the coordinates, in units of the noise, shape (n_node, m, n_electrode, 3).
        """
        film_charge_pC, film_slopes_pC = self._node_film.charges(unit_contact)
        return (charge_pC - film_charge_pC) / noise_std_pC, film_slopes_pC / noise_std_pC[:, :, None]


def _damped_solution(slopes: Array, right_side: Array, damping: float) -> Array:
    """Solve the damped normal equations of Gauss-Newton steps.

    Let J be the matrix of the derivatives. The solution is (J'J + damping * mean(diag(J'J)) * I)^-1 times the right
    side.

    Args:
        slopes: Derivatives J of the charges with respect to the three coordinates, shape (..., n_electrode, 3).
        right_side: Right side of the equations, shape (..., 3, k).
        damping: Damping relative to the mean of the diagonal of J'J.

    Returns:
        The solutions, shape (..., 3, k).
    """
    normal_matrix = slopes.swapaxes(-1, -2) @ slopes
    trace = np.trace(normal_matrix, axis1=-2, axis2=-1) + SMALLEST_TRACE
    added_to_diagonal = damping / 3.0 * trace  # the mean of the three diagonal elements is a third of the trace
    damped_matrix = normal_matrix + added_to_diagonal[..., None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(damped_matrix, right_side))


def _into_unit_range(unit_contact: Array) -> Array:
    """Move contacts outside the range of the series to the nearest contacts in the range.

    Args:
        unit_contact: Contacts in the coordinates of the series, shape (..., 3). The range of the first two coordinates
            is the unit disk, and that of the third coordinate is [-1, 1].
    """
    distance = np.hypot(unit_contact[..., 0], unit_contact[..., 1])
    position = unit_contact[..., :2] / np.maximum(distance, 1.0)[..., None]
    force = np.clip(unit_contact[..., 2:], -1.0, 1.0)
    return np.concatenate([position, force], axis=-1)
