"""Contacts that a model computes from charges.

A contact consists of ten numbers. Other programs rely on the order of the ten numbers.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Singles


class Contact(NamedTuple):
    """Position and force of one press, with the uncertainties of the position and the force.

    `Predictor.flags` returns the reasons why a contact may be wrong.

    Attributes:
        x_mm: Coordinate x of the position in the frame of the sensor, mm.
        y_mm: Coordinate y of the position in the frame of the sensor, mm.
        force_N: Force, N, positive if the probe pushes.
        x_std_mm: Standard deviation of x, mm.
        y_std_mm: Standard deviation of y, mm.
        force_std_N: Standard deviation of the force, N.
        misfit: Distance between the measured charges and the nearest charges that a single contact can produce, in
            standard deviations of the noise.
        xy_correlation: Correlation of the errors of x and y, -1 to 1.
        xF_correlation: Correlation of the errors of x and the force, -1 to 1.
        yF_correlation: Correlation of the errors of y and the force, -1 to 1.
    """

    x_mm: float
    y_mm: float
    force_N: float
    x_std_mm: float
    y_std_mm: float
    force_std_N: float
    misfit: float
    xy_correlation: float = math.nan
    xF_correlation: float = math.nan
    yF_correlation: float = math.nan

    def with_covariance(self, covariance: Array) -> "Contact":
        """Return the contact with the covariance of an additional independent error.

        Args:
            covariance: Covariance of the additional error of x, y and the force, shape (3, 3), mm and N.
        """
        contacts = Contacts(*np.array([self], np.float32).T).with_covariance(covariance[np.newaxis])
        return Contact(*np.asarray(contacts)[0].tolist())

    def __repr__(self) -> str:
        """Return a text with x, y, the force and their standard deviations, rounded to a few significant digits."""
        return (
            f"Contact(x_mm={self.x_mm:.4g} +- {self.x_std_mm:.2g}, y_mm={self.y_mm:.4g} +- {self.y_std_mm:.2g}, "
            f"force_N={self.force_N:.4g} +- {self.force_std_N:.2g}, misfit={self.misfit:.2g})"
        )


CLOSE_DISTANCE_mm = 0.3
"""Largest difference of x or of y between two close contacts, mm."""

CLOSE_FORCE_RATIO = 0.05
"""Largest difference of the force between two close contacts, relative to the force of the reference contact."""


def is_close(contact: Contact, reference: Contact | None) -> bool:
    """Return whether a contact has nearly the same position and force as a reference contact.

    A sensitivity describes how a contact changes with a parameter of the film. The sensitivity that was computed for
    the reference may also be used for a contact that is close to the reference.

    Args:
        contact: The contact that is compared with the reference.
        reference: The reference contact. If it is None, the result is False.
    """
    if reference is None:
        return False
    is_x_close = abs(contact.x_mm - reference.x_mm) <= CLOSE_DISTANCE_mm
    is_y_close = abs(contact.y_mm - reference.y_mm) <= CLOSE_DISTANCE_mm
    is_force_close = abs(contact.force_N - reference.force_N) <= CLOSE_FORCE_RATIO * reference.force_N
    return is_x_close and is_y_close and is_force_close


class Contacts(NamedTuple):
    """Contacts of n presses, with one float32 array of shape (n,) for each field of `Contact`.

    `np.asarray` converts the fields to one array of shape (n, 10) in which each row contains one press.
    """

    x_mm: Singles
    y_mm: Singles
    force_N: Singles
    x_std_mm: Singles
    y_std_mm: Singles
    force_std_N: Singles
    misfit: Singles
    xy_correlation: Singles
    xF_correlation: Singles
    yF_correlation: Singles

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray[Any, Any]:
        """Return an array of shape (n, 10) in which each row contains one press. NumPy calls this method.

        Args:
            dtype: Requested number type; None for float32.
            copy: Ignored, because the result is always a new array.
        """
        return np.stack(tuple(self), axis=1).astype(dtype or np.float32, copy=False)

    def with_covariance(self, covariance: Array) -> "Contacts":
        """Return the contacts with the covariance of an additional independent error.

        Correlations that are NaN remain NaN.

        Args:
            covariance: Covariance of the additional error of x, y and the force, shape (n, 3, 3), mm and N.
        """
        std = np.stack([self.x_std_mm, self.y_std_mm, self.force_std_N], axis=1).astype(float)
        correlation = np.stack([self.xy_correlation, self.xF_correlation, self.yF_correlation], axis=1)
        total_std = np.sqrt(std**2 + np.diagonal(covariance, axis1=1, axis2=2))
        i, j = [0, 0, 1], [1, 2, 2]  # the pairs (x, y), (x, F) and (y, F)
        total = correlation * std[:, i] * std[:, j] + covariance[:, i, j]
        x_std_mm, y_std_mm, force_std_N = total_std.T.astype(np.float32)
        xy, xF, yF = (total / (total_std[:, i] * total_std[:, j])).T.astype(np.float32)
        return self._replace(
            x_std_mm=x_std_mm,
            y_std_mm=y_std_mm,
            force_std_N=force_std_N,
            xy_correlation=xy,
            xF_correlation=xF,
            yF_correlation=yF,
        )
