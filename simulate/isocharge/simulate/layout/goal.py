"""What is made small: the worst error, its root mean square, or a mean weighted with a map of what matters."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.files import read_whole
from isocharge.common.number_text import number_of

HEADER = ["x_mm", "y_mm", "weight"]
"""Columns of a map of what matters."""


@dataclass(frozen=True)
class Goal:
    """A goal.

    Attributes:
        name: "worst", "rms", or the name of a map's file.
        places: Places of a map, shape (n, 2), m; empty without a map.
        weights: Weights at these places, shape (n,).
    """

    name: str
    places: Array
    weights: Array

    @classmethod
    def of(cls, text: str) -> "Goal":
        """From `--goal`.

        Raises:
            InputError: If it is no goal, or the map cannot be read.
        """
        if text in ("worst", "rms"):
            return cls(text, np.empty((0, 2)), np.empty(0))
        if not Path(text).is_file():
            raise InputError(
                f"goal {text!r}: expected 'worst', 'rms' or a CSV file with the columns {', '.join(HEADER)}"
            )
        table = _read_map(Path(text))
        return cls(Path(text).name, table[:, :2] * 1e-3, table[:, 2])

    @property
    def kind(self) -> str:
        """ "worst", or "rms" of errors that may be weighted."""
        return "worst" if self.name == "worst" and not len(self.places) else "rms"

    def weigh(self, presses: Array) -> Array:
        """Weights of presses, shape (n, 2), m: linear between the places of a map, beyond them those of the nearest.

        Raises:
            InputError: If no press has a weight above zero.
        """
        if not len(self.places):
            return np.ones(len(presses))
        weights = NearestNDInterpolator(self.places, self.weights)(presses)
        if np.linalg.matrix_rank(self.places - self.places[0]) == 2:
            between = LinearNDInterpolator(self.places, self.weights)(presses)
            weights = np.where(np.isnan(between), weights, between)
        if not weights.max() > 0.0:
            raise InputError(f"goal {self.name}: no place within the radius has a weight above 0")
        return np.asarray(weights)


def _read_map(path: Path) -> Array:
    try:
        rows = list(csv.reader(io.StringIO(read_whole(path).decode("utf-8-sig"))))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"goal {path}: cannot be read: {error}") from error
    if not rows or [cell.strip() for cell in rows[0]] != HEADER:
        raise InputError(f"goal {path}: expected the columns {', '.join(HEADER)}, got {rows[0] if rows else 'nothing'}")
    values = []
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            x, y, weight = (number_of(cell.strip()) for cell in row)
        except ValueError as error:
            raise InputError(f"goal {path}, row {number}: expected three numbers, got {row}") from error
        if not (np.isfinite([x, y, weight]).all() and weight >= 0.0):
            raise InputError(f"goal {path}, row {number}: expected finite numbers and a weight from 0, got {row}")
        values.append((x, y, weight))
    if not values:
        raise InputError(f"goal {path}: expected at least one place, got none")
    return np.array(values)
