"""The Cramer-Rao limit: how well an unbiased estimator can tell a contact from noisy charges, at best.

With J = d(Q)/d(x, y, ln F, ...) the Fisher information is J' diag(i) J, i what one reading tells about its charge
(`NoiseModel.information`), and the covariance of an unbiased estimate is at least its inverse (Kay 1993, ch. 3).
An estimator that knows the prior may do better where the charges say little: that is the Bayes limit, in train.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isocharge.arrays import Array
from isocharge.simulate.noise import NoiseModel

SMALLEST = 1e-14
"""Smallest eigenvalue of a scaled information that counts as more than rounding; limits stop there, some 1e7 times
above the others, instead of becoming infinite."""

NOTHING = 1e-60
"""Information (1/m^2, or without unit) below which a parameter is not told at all."""

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


@dataclass(frozen=True)
class CramerRao:
    """Limits of some contacts.

    Attributes:
        covariance: Of (x, y, ln F, ...), shape (n, p, p): m, m, and without unit.
    """

    covariance: Array

    @property
    def position(self) -> Array:
        """Root of the mean square distance from the true position, shape (n,), m."""
        position: Array = np.sqrt(self.covariance[:, 0, 0] + self.covariance[:, 1, 1])
        return position

    @property
    def force(self) -> Array:
        """Standard deviation of the force over the force, shape (n,)."""
        return self.parameter(2)

    def parameter(self, number: int) -> Array:
        """Standard deviation of one parameter, shape (n,)."""
        deviation: Array = np.sqrt(self.covariance[:, number, number])
        return deviation


def cramer_rao(charge: Array, jacobian: Array, noise: NoiseModel) -> CramerRao:
    """Limits from charges and their derivatives.

    Args:
        charge: Shape (n, n_electrode), C.
        jacobian: d(Q)/d(parameters), shape (n, n_electrode, p); the first three are x, y, ln F.
        noise: Of the readings, not clean.
    """
    return CramerRao(_invert(np.einsum("nei,ne,nej->nij", jacobian, noise.information(charge), jacobian)))


def limits_at(model: ChargeModel, contact: Array, noise: NoiseModel) -> CramerRao:
    """Limits at contacts (x, y, F), shape (n, 3), m and N."""
    return cramer_rao(model.charge(contact), model.jacobian(contact), noise)


def _invert(information: Array) -> Array:
    """Of symmetric matrices, shape (n, p, p), of any scale in each parameter, hardly singular or wholly so."""
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), NOTHING))
    both = size[:, :, None] * size[:, None, :]
    values, vectors = np.linalg.eigh(information / both)
    inverse: Array = np.einsum("nik,nk,njk->nij", vectors, 1.0 / np.maximum(values, SMALLEST), vectors) / both
    return inverse
