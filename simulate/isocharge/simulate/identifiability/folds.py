"""Folds of a charge map.

Charges determine a contact only where the map from (x, y, ln F) to the charges is one to one. Across a fold it is not:
its derivative J = d(Q)/d(x, y, ln F) loses rank and the map turns over. With three electrodes det J changes sign across
the fold. With more, J is not square; the map turns over between neighbours a and b if det(J(a)' W J(b)) < 0, with the
weights W = 1 / sigma^2. For three electrodes this is the sign of det J(a) det J(b), so one rule serves all.

Electrodes on one circle fold a biaxial film near this circle, however many they are: their charges hardly change if the
press moves to its mirror image in the circle.

Even without folds two contacts may have the same charges, see `ambiguities`.
"""

import numpy as np

from isocharge.arrays import Array, Booleans
from isocharge.simulate.forward.charge_model import ChargeModel
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings


def turned_over(first: Array, second: Array) -> Booleans:
    """Whether the map turns over between neighbours, given J / sigma of both, shape (..., n_electrode, 3): (...)."""
    products = np.einsum("...ei,...ej->...ij", _unit_columns(first), _unit_columns(second))
    over: Booleans = np.linalg.det(products) < 0.0
    return over


def _unit_columns(jacobian: Array) -> Array:
    """Columns of unit length: the sign of a determinant is then not lost in rounding."""
    unit: Array = jacobian / np.maximum(np.linalg.norm(jacobian, axis=-2, keepdims=True), np.finfo(float).tiny)
    return unit


def scaled_jacobian(model: ChargeModel, contact: Array, noise: NoiseModel) -> Array:
    """J / sigma of contacts (x, y, F): shape (n, 3) to (n, n_electrode, 3), 1/m, 1/m and without unit."""
    scaled: Array = model.jacobian(contact) / noise.sigma(model.charge(contact))[..., None]
    return scaled


def singular_values(scaled: Array) -> Array:
    """Singular values of J / sigma for the position with unknown force: (n, n_electrode, 3) to (n, 2), 1/m.

    One over them are the smallest and the largest standard deviation of the position by direction; at a fold the second
    is zero.
    """
    toward = scaled[:, :, 2] / np.maximum(np.linalg.norm(scaled[:, :, 2], axis=1, keepdims=True), np.finfo(float).tiny)
    moved = scaled[:, :, :2]
    across = moved - toward[:, :, None] * np.einsum("ne,nei->ni", toward, moved)[:, None]
    return np.asarray(np.linalg.svd(across, compute_uv=False))


def fold_points(model: ChargeModel, rings: Rings, force: float, noise: NoiseModel) -> Array:
    """Positions between neighbouring places of the rings across which the map turns over, shape (n, 2), m."""
    scaled = rings.per_ring(scaled_jacobian(model, rings.contacts(force), noise))
    across, around = turned_over(scaled[:-1], scaled[1:]), turned_over(scaled, np.roll(scaled, -1, axis=1))
    at = rings.position
    points: Array = np.concatenate(
        [0.5 * (at[:-1] + at[1:])[across], 0.5 * (at + np.roll(at, -1, axis=1))[around]], axis=0
    )
    return points
