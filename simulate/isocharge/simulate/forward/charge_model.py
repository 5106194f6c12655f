"""What identifiability needs of a charge map: charges and their derivatives by the contact."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isocharge.arrays import Array

STEPS = (5e-5, 5e-5, 1e-3)
"""Steps in x and y (m) and in ln F by which charges without derivatives are differentiated."""


class ChargeModel(Protocol):
    """Charges as a function of the contact (x, y, F), m and N, within a disk and a range of forces.

    `ChargeSpline` is one; `ChargeFunction` makes one of any function.
    """

    @property
    def radius(self) -> float:
        """Of the disk, m."""

    @property
    def force_range(self) -> tuple[float, float]:
        """N."""

    def charge(self, contact: Array) -> Array:
        """(n, 3) to (n, n_electrode), C."""

    def jacobian(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F): (n, 3) to (n, n_electrode, 3), C/m, C/m and C."""


@dataclass(frozen=True)
class ChargeFunction:
    """Any function of contacts as a charge model, with derivatives by central differences.

    Attributes:
        function: Contacts (x, y, F), shape (n, 3), m and N, to charges (n, n_electrode), C.
        radius: Where it holds, m.
        force_range: Where it holds, N.
        steps: Of the differences in x, y (m) and ln F. On the edge of the domain they reach out of it by so much,
            unless `radius` and `force_range` are given a little smaller than where the function holds.
    """

    function: Callable[[Array], Array]
    radius: float
    force_range: tuple[float, float]
    steps: tuple[float, float, float] = STEPS

    def charge(self, contact: Array) -> Array:
        """See `ChargeModel`."""
        return np.asarray(self.function(contact))

    def jacobian(self, contact: Array) -> Array:
        """See `ChargeModel`."""
        columns = []
        for axis, step in enumerate(self.steps):
            ahead, behind = contact.copy(), contact.copy()
            if axis == 2:
                ahead[:, 2], behind[:, 2] = contact[:, 2] * np.exp(step), contact[:, 2] * np.exp(-step)
            else:
                ahead[:, axis], behind[:, axis] = contact[:, axis] + step, contact[:, axis] - step
            columns.append((self.charge(ahead) - self.charge(behind)) / (2.0 * step))
        return np.stack(columns, axis=2)
