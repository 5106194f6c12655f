"""Scripts of a virtual sensor.

A script file contains presses and faults of the transmission. A `Script` contains the contact of each frame.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from isocharge.common.arrays import Array, Booleans
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError
from isocharge.common.structs import Finite, NotNegative, Settings, WrongKey, read_toml

PRESS_DURATION_S = (1.0, 3.0)
"""Shortest and longest duration of a random press, s."""

PAUSE_DURATION_S = (0.6, 1.2)
"""Shortest and longest pause between random presses, s. A reader that starts late can measure its tare in a pause."""

RAMP_S = 0.15
"""Time in which the force of a random press rises or falls, s."""

Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]

Seconds = Annotated[float, Meta(ge=-86_400.0, le=86_400.0)]

ROW_DESCRIPTION = "[seconds, x_mm, y_mm, force_N] with a force from 0"
"""Description of a row of presses in a script file, for error messages."""


@dataclass(frozen=True)
class Script:
    """Presses of a virtual sensor.

    Attributes:
        contact: Contact (x, y, F) in each frame, shape (n, 3), mm and N. While nothing touches the film, the force is 0
            and the position is NaN.
        rate_Hz: Number of frames per second, Hz.
    """

    contact: Array
    rate_Hz: float

    @property
    def touching(self) -> Booleans:
        """Whether something touches the film in each frame, shape (n,)."""
        return self.contact[:, 2] > 0.0


class Faults(Settings, frozen=True, kw_only=True):
    """Faults between the board and the reader. By default there are no faults.

    Attributes:
        lose_share: Fraction of the frames that are not sent, dimensionless.
        corrupt_share: Fraction of the bytes in which a bit is flipped, dimensionless.
    """

    lose_share: Fraction = 0.0
    corrupt_share: Fraction = 0.0


class VirtualScript(Settings, frozen=True):
    """Content of a script file for the command `isocharge serve virtual`.

    Attributes:
        presses: Rows (seconds, x_mm, y_mm, force_N), which are interpolated linearly. Nothing touches the film while
            the force is 0. Without rows, the presses are random.
        faults: Faults between the board and the reader.
    """

    presses: tuple[Annotated[tuple[Seconds, Finite, Finite, NotNegative], Meta(description=ROW_DESCRIPTION)], ...] = ()
    faults: Faults = Faults()

    def __post_init__(self) -> None:
        """Check the number and the times of the rows of `presses`, between which the presses are interpolated.

        Raises:
            WrongKey: If there is only one row, or the times do not increase.
        """
        times_s = [row[0] for row in self.presses]
        if len(times_s) == 1 or not (np.diff(times_s) > 0.0).all():
            raise WrongKey("presses", "two rows or more with growing seconds", self.presses)

    def script(self, rate_Hz: float) -> Script | None:
        """Return the presses at the time of each frame, or None if the file has no rows and the presses are random.

        The rows of `presses` are moments of the presses. Between them, the contact is interpolated linearly.

        Args:
            rate_Hz: Number of frames per second, Hz.
        """
        if not self.presses:
            return None
        rows = np.array(self.presses)  # (seconds, x_mm, y_mm, force_N)
        duration_s = np.ptp(rows[:, 0])
        return _interpolate(rows, np.arange(0.0, duration_s, 1.0 / rate_Hz), rate_Hz)


def _interpolate(rows: Array, t_s: Array, rate_Hz: float, min_force_N: float = 0.0) -> Script:
    """Return a script whose contacts are interpolated linearly between rows.

    A force above 0 is raised to `min_force_N` if it is smaller.

    Args:
        rows: Rows (seconds, x_mm, y_mm, force_N), shape (n, 4), with increasing times.
        t_s: Time of each frame since the first row, shape (frames,), s.
        rate_Hz: Number of frames per second, Hz.
        min_force_N: Smallest force while something touches the film, N.
    """
    row_time_s, *columns = rows.T
    contact = np.column_stack([np.interp(t_s, row_time_s - row_time_s[0], column) for column in columns])
    is_touch = contact[:, 2] > 0.0
    contact[~is_touch, :2] = np.nan  # a position is only defined while something touches
    contact[is_touch, 2] = contact[is_touch, 2].clip(min=min_force_N)
    return Script(contact, rate_Hz)


def load_script(path: Path) -> VirtualScript:
    """Read a script from a TOML file.

    Raises:
        SceneError: If the file cannot be read, or a key is unknown or wrong.
    """
    return read_toml(path, "a script of a virtual sensor", SceneError, VirtualScript)


def wander(
    *,
    seed: int,
    seconds: float = 60.0,
    rest_s: float = 1.0,
    rate_Hz: float = 200.0,
    radius_mm: float = DEFAULT_RADIUS,
    force_range_N: tuple[float, float] = DEFAULT_PLAYED_FORCE_RANGE,
) -> Script:
    """Create a script of random presses that wander over the film, with a pause after each press.

    Each press moves from one random point to another, while its force changes from one random force to another. The
    forces stay within the given range, because a forward map is only valid in a range of forces. The script begins with
    `rest_s` without a press.

    Args:
        seed: Seed of all random choices.
        seconds: Length of the script, s.
        rest_s: Time without a press at the start of the script, s. A reader measures its tare in this time.
        rate_Hz: Number of frames per second, Hz.
        radius_mm: Radius of the disk that contains all presses, mm.
        force_range_N: Smallest and largest force, N.
    """
    min_force_N, max_force_N = force_range_N
    rng = np.random.default_rng(seed)
    rows = [np.zeros((1, 4))]  # (seconds, x_mm, y_mm, force_N); the script begins without a force
    start_s = rest_s
    while start_s < seconds:
        # A press has four rows. The force rises at the first point, changes on the way to the last point, and falls.
        end_s = start_s + rng.uniform(*PRESS_DURATION_S)
        time_s = [start_s, start_s + RAMP_S, end_s - RAMP_S, end_s]
        distance_mm = radius_mm * np.sqrt(rng.uniform(size=2))  # distributes the two points evenly over the disk
        points = distance_mm * np.exp(2j * np.pi * rng.uniform(size=2))  # x + iy
        position = np.repeat(points, 2)  # x + iy of the four rows: first, first, last, last
        first_force_N, last_force_N = min_force_N * (max_force_N / min_force_N) ** rng.uniform(size=2)  # even in ln F
        force_N = [0.0, first_force_N, last_force_N, 0.0]
        rows.append(np.column_stack([time_s, position.real, position.imag, force_N]))  # one array for each press
        start_s = end_s + rng.uniform(*PAUSE_DURATION_S)
    frame_time_s = np.arange(round(seconds * rate_Hz)) / rate_Hz
    return _interpolate(np.concatenate(rows), frame_time_s, rate_Hz, min_force_N)


def corrupt(data: bytes, fraction: float, rng: np.random.Generator) -> bytes:
    """Flip one bit in each byte of a random fraction of the bytes, to imitate a faulty cable.

    Args:
        data: The bytes before the damage.
        fraction: Mean fraction of the bytes that are damaged, dimensionless.
        rng: Source of the random numbers.

    Returns:
        The bytes after the damage.
    """
    is_damaged = rng.random(len(data)) < fraction
    flipped_bit = np.uint8(1) << rng.integers(8, size=len(data), dtype=np.uint8)
    return bytes(np.frombuffer(data, np.uint8) ^ (is_damaged * flipped_bit))
