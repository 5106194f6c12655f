"""What a model says about presses, one or many: seven numbers each, in an order that other programs rely on."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from isocharge.common.arrays import Singles

MOST_DECIMALS = 6
"""Decimals that are shown at most: 1 nm and 1 uN."""


class Contact(NamedTuple):
    """Where and how hard one press is, and how sure that is; whether to trust it, `Predictor.flags` says.

    Attributes:
        x_mm, y_mm: Position in the sensor's frame, mm.
        force_N: Force, N, positive when pushing.
        x_std_mm, y_std_mm, force_std_N: Standard deviations.
        misfit: Distance of the charges from the nearest single contact the model knows, in standard deviations.
    """

    x_mm: float
    y_mm: float
    force_N: float
    x_std_mm: float
    y_std_mm: float
    force_std_N: float
    misfit: float

    def __repr__(self) -> str:
        """Each number with its standard deviation, to two digits of that."""
        numbers = ", ".join(f"{name}={value} +- {std}" for name, value, std in self._rounded())
        return f"Contact({numbers}, misfit={self.misfit:.2g})"

    def _rounded(self) -> Iterator[tuple[str, str, str]]:
        """Name, value and standard deviation of position and force."""
        for name, value, std in zip(self._fields[:3], self[:3], self[3:6], strict=True):
            certain = math.isfinite(std) and std > 0.0
            decimals = min(max(1 - math.floor(math.log10(std)), 0), MOST_DECIMALS) if certain else MOST_DECIMALS
            yield name, f"{value:.{decimals}f}", f"{std:.{decimals}f}"


class Contacts(NamedTuple):
    """Contacts of n presses: the fields of `Contact`, each an array of shape (n,), float32."""

    x_mm: Singles
    y_mm: Singles
    force_N: Singles
    x_std_mm: Singles
    y_std_mm: Singles
    force_std_N: Singles
    misfit: Singles
