"""Scripts of a virtual sensor: position and force of the press in each frame."""

import csv
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Array, Booleans
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError
from isocharge.common.number_text import number_of

REST_S = 1.0
"""Rest at the start of a script, s: time for a tare."""

PRESS_S = (1.0, 3.0)
"""Shortest and longest press, s."""

PAUSE_S = (0.6, 1.2)
"""Shortest and longest pause between presses, s: long enough for the tare of a reader that comes late."""

RAMP_S = 0.15
"""Time in which the force rises from the smallest to that of the press, or falls back, s."""


MOST_FRAMES = 2_000_000
"""Longest script from a file, frames: nearly three hours at 200 Hz."""


@dataclass(frozen=True)
class Script:
    """Position and force for each frame.

    Attributes:
        x_mm, y_mm: Position, shape (n,), mm; NaN where nothing touches.
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
    """A script from a CSV with the columns seconds, x_mm, y_mm, force_N; values between rows are interpolated linearly.

    Nothing touches where the force is 0; the position of a row without force matters only next to a row with one.

    Args:
        lines: Lines of the file.
        rate_Hz: Frames per second.
        where: The file, for messages.

    Raises:
        SceneError: If a column is missing, a cell is no number, a force is negative or the seconds do not grow.
    """
    names = ("seconds", "x_mm", "y_mm", "force_N")
    try:
        rows = [[number_of(row[name]) for name in names] for row in csv.DictReader(lines)]
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{where}: expected numbers in the columns {', '.join(names)} ({error})") from error
    seconds, x_mm, y_mm, force_N = np.array(rows).reshape(-1, 4).T
    if not (len(rows) > 1 and np.isfinite(rows).all() and (np.diff(seconds) > 0).all() and force_N.min() >= 0):
        raise SceneError(f"{where}: expected two rows or more, growing seconds and forces from 0, got {rows!r:.200}")
    if not (seconds[-1] - seconds[0]) * rate_Hz <= MOST_FRAMES:
        raise SceneError(
            f"{where}: expected at most {MOST_FRAMES} frames, got {seconds[-1] - seconds[0]:g} s at {rate_Hz:g} Hz; "
            "shorten the script, it is repeated"
        )
    t = np.arange(seconds[0], seconds[-1], 1.0 / rate_Hz)
    x, y, force = (np.interp(t, seconds, values) for values in (x_mm, y_mm, force_N))
    return Script(np.where(force > 0, x, np.nan), np.where(force > 0, y, np.nan), force, rate_Hz)


def wander(
    *,
    seed: int,
    seconds: float = 60.0,
    rate_Hz: float = 200.0,
    radius_mm: float = 1e3 * DEFAULT_RADIUS,
    force_range_N: tuple[float, float] = DEFAULT_FORCE_RANGE,
) -> Script:
    """A script of random presses that wander over the film: a second of rest, then presses of 1 to 3 s with pauses.

    Position and the logarithm of the force vary smoothly within a press. A force never leaves its range, because
    forward maps hold in a range of forces only.

    Args:
        seed: Seed of all random choices.
        seconds: Length of the script, s.
        rate_Hz: Frames per second.
        radius_mm: Radius of the disk that holds all presses, mm.
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
        position[inside] = radius_mm * _random_path(rng, t[inside] - start)
        force_N[inside] = low * (high / low) ** _force_level(rng, t[inside] - start, end - start)
        start = end + rng.uniform(*PAUSE_S)
    return Script(position.real, position.imag, force_N, rate_Hz)


def _random_path(rng: np.random.Generator, t: Array) -> NDArray[np.complex128]:
    """Points of a smooth random path inside the unit disk at times t from 0 on, s, shape (n,)."""
    start = np.sqrt(rng.uniform()) * np.exp(2j * np.pi * rng.uniform())
    turns_per_s = rng.uniform(-0.5, 0.5, size=(3, 1))
    sway = 0.25 * (np.exp(2j * np.pi * turns_per_s * t) - 1.0)
    path = start + (np.exp(2j * np.pi * rng.uniform(size=(3, 1))) * sway).sum(axis=0)
    squashed: NDArray[np.complex128] = path / (1.0 + np.abs(path) ** 8) ** (1 / 8)  # points well inside hardly move
    return squashed


def _force_level(rng: np.random.Generator, t: Array, duration: float) -> Array:
    """Level of the force, from 0 (smallest) to 1 (largest), at times t from 0 to the duration, s, shape (n,)."""
    level = rng.uniform() + 0.15 * np.sin(2.0 * np.pi * (rng.uniform(0.3, 1.0) * t + rng.uniform()))
    return np.clip(level, 0.0, 1.0) * _smooth_step(t / RAMP_S) * _smooth_step((duration - t) / RAMP_S)


def _smooth_step(s: Array) -> Array:
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)
