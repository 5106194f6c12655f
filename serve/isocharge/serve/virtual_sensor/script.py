"""What is pressed, when: the scripts that a virtual sensor plays."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from isocharge.arrays import Array, Booleans
from isocharge.errors import SceneError

REST_S = 1.0
"""Nothing touches for so long at the start: time to tare."""

PRESS_S = (1.0, 3.0)

PAUSE_S = (0.6, 1.2)
"""Long enough to tare in, for a reader that comes late."""

RAMP_S = 0.15
"""In which the force rises from the smallest to that of the press, and falls back."""


@dataclass(frozen=True)
class Script:
    """A press, or none, for each frame.

    Attributes:
        x_mm, y_mm: Position, shape (n,), mm; not a number where nothing touches.
        force_N: Force, shape (n,), N; 0 where nothing touches.
        rate_Hz: Frames per second.
    """

    x_mm: Array
    y_mm: Array
    force_N: Array
    rate_Hz: float

    def __post_init__(self) -> None:
        shapes = {self.x_mm.shape, self.y_mm.shape, self.force_N.shape}
        if len(shapes) != 1 or self.force_N.ndim != 1 or not self.force_N.size:
            raise SceneError(f"script: expected three arrays of one length above 0, got the shapes {sorted(shapes)}")
        if not self.rate_Hz > 0.0:
            raise SceneError(f"script: expected a positive rate, got {self.rate_Hz} Hz")

    def __len__(self) -> int:
        return len(self.force_N)

    @property
    def touching(self) -> Booleans:
        """Where something touches, shape (n,)."""
        return self.force_N > 0.0


def read_script(lines: Iterable[str], rate_Hz: float, where: str) -> Script:
    """Presses from a CSV with the columns seconds, x_mm, y_mm, force_N; between rows all go along straight lines.

    Nothing touches where the force is 0; a row's position counts where it or its neighbour has a force.

    Args:
        lines: Lines of the file.
        rate_Hz: Frames per second.
        where: The file, for messages.

    Raises:
        SceneError: If a column is missing, a cell is no number, a force is negative or time does not go on.
    """
    names = ("seconds", "x_mm", "y_mm", "force_N")
    try:
        rows = [[float(row[name]) for name in names] for row in csv.DictReader(lines)]
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{where}: expected numbers in the columns {', '.join(names)} ({error})") from error
    seconds, x_mm, y_mm, force_N = np.array(rows).reshape(-1, 4).T
    if not (len(rows) > 1 and np.isfinite(rows).all() and (np.diff(seconds) > 0).all() and force_N.min() >= 0):
        raise SceneError(f"{where}: expected two rows or more, growing seconds and forces from 0, got {rows!r:.200}")
    t = np.arange(seconds[0], seconds[-1], 1.0 / rate_Hz)
    x, y, force = (np.interp(t, seconds, values) for values in (x_mm, y_mm, force_N))
    return Script(np.where(force > 0, x, np.nan), np.where(force > 0, y, np.nan), force, rate_Hz)


def wander(
    *,
    seed: int,
    seconds: float = 60.0,
    rate_Hz: float = 200.0,
    radius_mm: float = 8.0,
    force_range_N: tuple[float, float] = (0.05, 2.0),
) -> Script:
    """Presses that wander over the film: a second of rest, then presses of 1 to 3 s with pauses between.

    Position and the logarithm of the force vary smoothly within a press; a force never leaves its range, because what
    lies below it is outside what a forward map knows.

    Args:
        seed: Of all random choices.
        seconds: Length of the script, s.
        rate_Hz: Frames per second.
        radius_mm: Presses stay inside this radius, mm.
        force_range_N: Smallest and largest force, N.

    Raises:
        SceneError: If a number is out of its range.
    """
    low, high = force_range_N
    if not (0.0 < low <= high and radius_mm > 0.0 and rate_Hz > 0.0 and seconds * rate_Hz >= 1.0):
        raise SceneError(
            "wander: expected 0 < smallest <= largest force, a positive radius and at least one frame, got "
            f"{force_range_N} N, {radius_mm} mm, {seconds} s at {rate_Hz} Hz"
        )
    rng, t = np.random.default_rng(seed), np.arange(round(seconds * rate_Hz)) / rate_Hz
    position, force_N = np.full(t.size, complex(np.nan, np.nan)), np.zeros(t.size)
    start = REST_S
    while start < seconds:
        end = start + rng.uniform(*PRESS_S)
        inside = (t >= start) & (t < end)
        position[inside] = radius_mm * _wandering(rng, t[inside] - start)
        force_N[inside] = low * (high / low) ** _pressing(rng, t[inside] - start, end - start)
        start = end + rng.uniform(*PAUSE_S)
    return Script(position.real, position.imag, force_N, rate_Hz)


def _wandering(rng: np.random.Generator, t: Array) -> NDArray[np.complex128]:
    """A smooth path inside the unit disk from a random start, shape (n,), at times t from 0, s."""
    start = np.sqrt(rng.uniform()) * np.exp(2j * np.pi * rng.uniform())
    turns_per_s = rng.uniform(-0.5, 0.5, size=(3, 1))
    sway = 0.25 * (np.exp(2j * np.pi * turns_per_s * t) - 1.0)
    path = start + (np.exp(2j * np.pi * rng.uniform(size=(3, 1))) * sway).sum(axis=0)
    squashed: NDArray[np.complex128] = path / (1.0 + np.abs(path) ** 8) ** (1 / 8)  # hardly moves what is well inside
    return squashed


def _pressing(rng: np.random.Generator, t: Array, duration: float) -> Array:
    """How hard, from 0 (smallest force) to 1 (largest), shape (n,), at times t from 0 to the duration, s."""
    level = rng.uniform() + 0.15 * np.sin(2.0 * np.pi * (rng.uniform(0.3, 1.0) * t + rng.uniform()))
    return np.clip(level, 0.0, 1.0) * _smooth_step(t / RAMP_S) * _smooth_step((duration - t) / RAMP_S)


def _smooth_step(s: Array) -> Array:
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)
