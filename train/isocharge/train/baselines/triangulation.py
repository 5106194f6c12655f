"""Triangulation, the method of Mirbagheri et al. (2007), as one more regressor; its home is simulate.

The paper knows the force; a sensor does not. So there are two, and the one that is given the force says so.
"""

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array
from isocharge.simulate.contours.triangulation import Triangulation
from isocharge.simulate.forward.charge_map import ChargeMap


class Triangulate(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Where the contours meet; NaN where they do not, or twice.

    Attributes:
        charge_map: Where the contours come from.
        given_force: Whether the true force, N, stands behind the charges of each press.
    """

    def __init__(self, charge_map: ChargeMap, *, given_force: bool = False) -> None:
        self.charge_map, self.given_force = charge_map, given_force

    def fit(self, charge: Array, contact: Array) -> "Triangulate":
        """Nothing is learned from presses."""
        del charge, contact
        self.contours_ = Triangulation(self.charge_map)
        return self

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3)."""
        if not self.given_force:
            return self.contours_.locate_with_force(charge).contact
        force = np.clip(charge[:, -1], *self.charge_map.domain.force_range)
        return self.contours_.locate(charge[:, :-1], force).contact
