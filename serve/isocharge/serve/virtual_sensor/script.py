"""Scripts of a virtual sensor: position and force of the press in each frame, and the faults on the way to a reader."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError
from isocharge.common.structs import Finite, NotNegative, Settings, WrongKey, read_toml

REST_S = 1.0
"""Rest at the start of a script, s: time for a tare."""

PRESS_S = (1.0, 3.0)
"""Shortest and longest press, s."""

PAUSE_S = (0.6, 1.2)
"""Shortest and longest pause between presses, s: long enough for the tare of a reader that comes late."""

RAMP_S = 0.15
"""Time in which the force rises from the smallest to that of the press, or falls back, s."""


Share = Annotated[float, Meta(ge=0.0, le=1.0)]

ROW = "[seconds, x_mm, y_mm, force_N] with a force from 0"

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


class Faults(Settings, frozen=True, kw_only=True):
    """Faults between board and reader; by default there is none.

    Attributes:
        lose_share: Share of frames that are not sent, dimensionless.
        corrupt_share: Share of bytes that are flipped, dropped or followed by a random one, dimensionless.
        gap_every_s, gap_s: Interval and length of the gaps in which nothing is sent, s; interval 0 for no gaps.
        unplug_every_s, unplug_s: Interval and length of the outages of the port, s; interval 0 for no outages.
        clock_ppm: Excess of the device's clock rate over the true one, parts per million.
    """

    lose_share: Share = 0.0
    corrupt_share: Share = 0.0
    gap_every_s: NotNegative = 0.0
    gap_s: NotNegative = 0.1
    unplug_every_s: NotNegative = 0.0
    unplug_s: NotNegative = 0.5
    clock_ppm: Annotated[float, Meta(gt=-1e6, lt=1e6)] = 0.0

    def is_silent(self, t_s: float) -> bool:
        """Whether nothing is sent at this time, s from the start: a gap, or the port is away."""
        return _is_in(t_s, self.gap_every_s, self.gap_s) or self.is_unplugged(t_s)

    def is_unplugged(self, t_s: float) -> bool:
        """Whether the port is away at this time, s from the start."""
        return _is_in(t_s, self.unplug_every_s, self.unplug_s)


def _is_in(t_s: float, every_s: float, length_s: float) -> bool:
    """Whether a time lies in one of the intervals that recur, the first after one period; a period of 0 has none."""
    return every_s > 0.0 and t_s >= every_s and t_s % every_s < length_s


class VirtualScript(Settings, frozen=True):
    """The file of `isocharge serve virtual --script`.

    Attributes:
        presses: Rows (seconds, x_mm, y_mm, force_N), interpolated linearly; nothing touches where the force is 0.
            Without rows, presses are random.
        faults: Between board and reader.
        temperature_step_K: Temperature step of the air after 10 s, K; None leaves it to the amplifier.
        drift_pC_per_s: Drift from the bias current, pC/s; likewise.
        limit_pC: Largest charge that the converter reads, pC; likewise.
    """

    presses: tuple[Annotated[tuple[Finite, Finite, Finite, NotNegative], Meta(description=ROW)], ...] = ()
    faults: Faults = Faults()
    temperature_step_K: Finite | None = None
    drift_pC_per_s: NotNegative | None = None
    limit_pC: Annotated[float, Meta(ge=1.0)] | None = None

    def __post_init__(self) -> None:
        seconds = [row[0] for row in self.presses]
        if self.presses and (len(seconds) < 2 or any(a >= b for a, b in pairwise(seconds))):
            raise WrongKey("presses", "two rows or more with growing seconds", self.presses)

    def script(self, rate_Hz: float) -> Script | None:
        """The presses at a rate, Hz; None if they are random.

        Raises:
            SceneError: If there are too many frames.
        """
        if not self.presses:
            return None
        seconds, x_mm, y_mm, force_N = np.array(self.presses).T
        if not (seconds[-1] - seconds[0]) * rate_Hz <= MOST_FRAMES:
            raise SceneError(
                f"script: expected at most {MOST_FRAMES} frames, got {seconds[-1] - seconds[0]:g} s at {rate_Hz:g} Hz"
            )
        times = np.arange(seconds[0], seconds[-1], 1.0 / rate_Hz)
        x, y, force = (np.interp(times, seconds, values) for values in (x_mm, y_mm, force_N))
        return Script(np.where(force > 0, x, np.nan), np.where(force > 0, y, np.nan), force, rate_Hz)


def load_script(path: Path) -> VirtualScript:
    """Read a script, TOML.

    Raises:
        SceneError: If it cannot be read, or a key is unknown or wrong.
    """
    return read_toml(path, "a script of a virtual sensor", SceneError, VirtualScript)


def wander(
    *,
    seed: int,
    seconds: float = 60.0,
    rate_Hz: float = 200.0,
    radius_mm: float = DEFAULT_RADIUS,
    force_range_N: tuple[float, float] = DEFAULT_PLAYED_FORCE_RANGE,
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


def _random_path(rng: np.random.Generator, t: Array) -> Complexes:
    """Points of a smooth random path inside the unit disk at times t from 0 on, s, shape (n,)."""
    start = np.sqrt(rng.uniform()) * np.exp(2j * np.pi * rng.uniform())
    turns_per_s = rng.uniform(-0.5, 0.5, size=(3, 1))
    sway = 0.25 * (np.exp(2j * np.pi * turns_per_s * t) - 1.0)
    path = start + (np.exp(2j * np.pi * rng.uniform(size=(3, 1))) * sway).sum(axis=0)
    return np.asarray(path / (1.0 + np.abs(path) ** 8) ** (1 / 8))  # points well inside hardly move


def _force_level(rng: np.random.Generator, t: Array, duration: float) -> Array:
    """Level of the force, from 0 (smallest) to 1 (largest), at times t from 0 to the duration, s, shape (n,)."""
    level = rng.uniform() + 0.15 * np.sin(2.0 * np.pi * (rng.uniform(0.3, 1.0) * t + rng.uniform()))
    ramp = np.clip(np.minimum(t, duration - t) / RAMP_S, 0.0, 1.0)
    return np.clip(level, 0.0, 1.0) * ramp * ramp * (3.0 - 2.0 * ramp)


def corrupt(data: bytes, share: float, rng: np.random.Generator) -> bytes:
    """Damage a share of bytes: a third each is flipped in one bit, dropped, or followed by a random byte."""
    damaged = [bytes([byte]) for byte in data]
    for position in np.flatnonzero(rng.random(len(data)) < share).tolist():
        kind, extra = int(rng.integers(3)), int(rng.integers(256))
        flipped = bytes([data[position] ^ 1 << extra % 8])
        damaged[position] = (flipped, b"", bytes([data[position], extra]))[kind]
    return b"".join(damaged)
