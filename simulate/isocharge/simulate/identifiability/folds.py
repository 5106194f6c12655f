"""Search for the folds of a charge map.

Charges Q determine a contact only where the map from (x, y, ln F) to the charges is one to one. Near a fold, different
contacts have the same charges. At a fold, the derivative J = d(Q)/d(x, y, ln F) is singular, so that the Cramer-Rao
limit of the position is infinite, and the map reverses its orientation across the fold. With three electrodes, folds
are lines at which det J changes its sign. With more electrodes, J is not square and is singular only at isolated points
(Whitney 1944).

The search refines the maxima of the position error on a grid. A maximum is a fold if the orientation of the map is
reversed across it. The orientation is reversed between two contacts a and b if det(J(a)' W J(b)) < 0, where the
diagonal matrix W contains the inverse variances of the charges. For more than three electrodes, the criterion is
reliable only for contacts that are close to each other: beside an electrode, the directions of the derivatives change
by more than a right angle within 0.1 mm without a fold.

If all electrodes of an isotropic film lie on one circle, a press and its mirror image in this circle cause nearly the
same charges. The map therefore has a fold near the circle for any number of electrodes.

Even without folds, two distant contacts may have the same charges. The module `ambiguous_pairs` finds such contacts.
"""

import numpy as np
import scipy  # loads each of its subpackages on first use

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import INNER_RADIUS, Rings, onto_disk

FOLD_WIDTH = 0.02
"""Distance between two contacts on both sides of a fold, mm.

Beside an electrode, the orientation may be reversed within 0.1 mm without a fold. At a true fold, such as that on a
circle of four electrodes, the orientation is reversed within about 0.01 mm.
"""


def has_reversed_orientation(first: Array, second: Array) -> Booleans:
    """Return whether the charge map reverses its orientation between the two contacts of each pair.

    Args:
        first: Derivatives of the charges with respect to (x, y, ln F) at the first contact of each pair, divided by the
            standard deviations of the charges, shape (..., n_electrode, 3).
        second: Scaled derivatives at the second contact of each pair, shape (..., n_electrode, 3).

    Returns:
        Whether the orientation is reversed, shape (...).
    """
    # Rounding errors could change the sign of the determinant if the columns did not have unit lengths.
    directions = [
        jacobian / np.maximum(np.linalg.norm(jacobian, axis=-2, keepdims=True), np.finfo(float).tiny)
        for jacobian in (first, second)
    ]
    products = np.einsum("...ei,...ej->...ij", *directions)  # sums over the electrodes (e)
    return np.asarray(np.linalg.det(products) < 0.0)


def scaled_derivatives(charge_map: ChargeMap, contact: Array, noise: NoiseModel) -> Array:
    """Compute derivatives of charges, and divide the derivatives by the standard deviations of the charges.

    Args:
        charge_map: Map that computes the charges of contacts.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        noise: Noise of the readings.

    Returns:
        Scaled derivatives with respect to x (1/mm), y (1/mm) and ln F (dimensionless), shape (n, n_electrode, 3).
    """
    charge, jacobian = linearised(charge_map, contact)
    return np.asarray(jacobian / noise.sigma(charge)[..., None])


def find_folds(charge_map: ChargeMap, rings: Rings, force: float, noise: NoiseModel) -> Array:
    """Find the folds of a charge map for contacts that all have the same force.

    Args:
        charge_map: Map that computes the charges of contacts.
        rings: Positions at which the search starts.
        force: Force of the contacts, N.
        noise: Noise of the readings.

    Returns:
        Positions (x, y) on folds, ordered by the distance from the centre, shape (n, 2), mm. With three electrodes, the
        positions lie on fold lines. With more electrodes, they are points.
    """
    radius = INNER_RADIUS * charge_map.domain.radius

    def contacts(position: Array) -> Array:
        """Return contacts at positions of shape (..., 2), moved onto the disk of the map, shape (n, 3)."""
        inside = onto_disk(position.reshape(-1, 2), radius)
        return np.column_stack([inside, np.full(len(inside), force)])

    def precision(position: Array) -> Array:
        """Return the inverse of the position error, which is zero at a fold, shape of the positions without (2,)."""
        return np.asarray(1.0 / limits_at(charge_map, contacts(position), noise).position).reshape(position.shape[:-1])

    # Refine the minima of the precision. In each round, the step is halved, and each position moves to the best of the
    # 25 neighbours that are up to two steps away along x and y.
    position, step = _starting_points(rings, precision(rings.position))
    neighbours = np.stack(np.meshgrid(range(-2, 3), range(-2, 3)), axis=-1).reshape(-1, 2)
    while len(position) and step.max() > 0.05 * FOLD_WIDTH:
        step *= 0.5
        trial = position[:, None] + step[:, None, None] * neighbours
        trial = onto_disk(trial.reshape(-1, 2), radius).reshape(trial.shape)
        position = trial[np.arange(len(trial)), precision(trial).argmin(axis=1)]

    # Compare the orientations at opposite points of a circle around each position.
    angle = np.pi * np.arange(4) / 4.0
    half_width = 0.5 * FOLD_WIDTH * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    sides = np.stack([position[:, None] + half_width, position[:, None] - half_width])
    jacobian = scaled_derivatives(charge_map, contacts(sides), noise)
    is_fold = has_reversed_orientation(*jacobian.reshape(*sides.shape[:3], -1, 3)).any(axis=1)
    folds = position[is_fold]
    return np.asarray(folds[np.argsort(np.hypot(*folds.T), kind="stable")])


def _starting_points(rings: Rings, precision: Array) -> tuple[Array, Array]:
    """Choose the positions on rings near which a fold may lie.

    Args:
        rings: Positions, of which the angles are periodic.
        precision: Inverse of the position error at each position, shape (n_ring, n_angle).

    Returns:
        Positions (x, y), shape (n, 2), and the distance to the farthest neighbour of each, shape (n,), mm.
    """
    # A position is chosen if none of its eight neighbours has a smaller precision. It is also chosen if a line of
    # neighbours has a kink, as at a fold line: the precision then decreases to zero and increases again.
    is_chosen = precision == scipy.ndimage.minimum_filter(precision, 3, mode=("nearest", "wrap"))
    along_ring = np.roll(precision, 1, axis=1) + np.roll(precision, -1, axis=1)
    is_chosen |= 3.0 * precision <= along_ring
    is_chosen[1:-1] |= 3.0 * precision[1:-1] <= precision[:-2] + precision[2:]
    ring, _ = np.nonzero(is_chosen)
    spacing_on_ring = rings.distance * 2.0 * np.pi / precision.shape[1]
    return rings.position[is_chosen], np.maximum(rings.distance[0], spacing_on_ring)[ring]
