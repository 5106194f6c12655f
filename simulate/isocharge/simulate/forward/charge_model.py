"""Charges and their derivatives by the contact: all that identifiability needs to know of a sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isocharge.common.arrays import Array

STEPS = (5e-5, 5e-5, 1e-3)
"""Steps of the central differences in x and y (m) and in ln F (dimensionless)."""


class ChargeModel(Protocol):
    """Charges as a function of the contact (x, y, F), m and N, within a disk and a range of forces.

    `ChargeSpline` is one; `ChargeFunction` turns any function into one.
    """

    @property
    def radius(self) -> float:
        """Radius of the disk, m."""

    @property
    def force_range(self) -> tuple[float, float]:
        """Smallest and largest force, N."""

    def charge(self, contact: Array) -> Array:
        """Charges, shape (n, n_electrode), C, of contacts (x, y, F), shape (n, 3), m and N."""

    def jacobian(self, contact: Array) -> Array:
        """Derivatives d(Q)/d(x, y, ln F) of contacts, shape (n, 3): (n, n_electrode, 3), C/m, C/m and C."""


@dataclass(frozen=True)
class ChargeFunction:
    """Any function of contacts as a charge model, with derivatives by central differences.

    Attributes:
        function: Contacts (x, y, F), shape (n, 3), m and N, to charges (n, n_electrode), C.
        radius: Largest distance from the centre at which the function holds, m.
        force_range: Smallest and largest force at which it holds, N.
        steps: Steps of the differences in x, y (m) and ln F. At the edge of the domain the function is called this far
            outside; give a slightly smaller `radius` and `force_range` if it does not hold there.
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


@dataclass(frozen=True)
class _WithinRadius:
    """A charge model over a smaller disk; see `ChargeModel`."""

    model: ChargeModel
    radius: float

    @property
    def force_range(self) -> tuple[float, float]:
        return self.model.force_range

    def charge(self, contact: Array) -> Array:
        return self.model.charge(contact)

    def jacobian(self, contact: Array) -> Array:
        return self.model.jacobian(contact)


def within_radius(model: ChargeModel, radius: float) -> ChargeModel:
    """The same charges over a smaller disk, radius in m."""
    return _WithinRadius(model, radius)


def electrode_count(model: ChargeModel) -> int:
    """Number of charges."""
    return int(model.charge(np.array([[0.0, 0.0, model.force_range[0]]])).shape[1])
