"""Triangulation, the method of Mirbagheri et al. (2007), as one more estimator; its home is simulate.

The paper knows the force; a sensor does not. So there are two entries, and the one that is given the force says so.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.contours.triangulation import Triangulation
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.train.baselines.estimator import Fitted, FittingTask


@dataclass(frozen=True)
class Triangulate:
    """The method.

    Attributes:
        forward_map: Where its contours come from: the simulator's forward map.
    """

    forward_map: ForwardMap
    name: str = "triangulation"

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Table the forward map's contours within the domain; with the force unknown, and given."""
        contours = Triangulation.from_map(self.forward_map, radius=1e-3 * task.domain.radius_mm)
        choice = f"contours from {self.forward_map.solves} solves"
        unknown = ContourFix(contours, choice, self.name)
        given = ContourFix(contours, choice, f"{self.name}, force given", given_force=True)
        return unknown, given


@dataclass(frozen=True)
class ContourFix(Fitted):
    """Where the contours meet; NaN where they do not, or twice."""

    contours: Triangulation
    choice: str
    name: str
    form: str = "NumPy"
    given_force: bool = False
    force_N: Array | None = None

    def with_known_force(self, force_N: Array) -> "ContourFix":
        """See `Fitted.with_known_force`."""
        return replace(self, force_N=force_N) if self.given_force else self

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`; with the force given, `with_known_force` comes first."""
        charge = 1e-12 * charge_pC
        if self.given_force:
            if self.force_N is None:
                raise ValueError("triangulation with the force given: call with_known_force(force_N) before predict")
            low, high = self.contours.table.force_range
            fix = self.contours.locate(charge, np.clip(self.force_N, low, high))
        else:
            fix = self.contours.locate_with_force(charge)
        return np.stack([1e3 * fix.x, 1e3 * fix.y, fix.force], axis=1)
