"""Scripts of a virtual sensor.

A script file contains presses and faults of the transmission. A `Script` contains the position and the force of the
press in each frame.
"""

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

INITIAL_REST_S = 1.0
"""Time without a press at the start of a random script, s. A reader measures its tare in this time."""

PRESS_DURATION_S = (1.0, 3.0)
"""Shortest and longest duration of a random press, s."""

PAUSE_DURATION_S = (0.6, 1.2)
"""Shortest and longest pause between random presses, s. A reader that starts late can measure its tare in a pause."""

RAMP_S = 0.15
"""Time in which the force of a random press rises or falls, s."""

Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]

ROW_DESCRIPTION = "[seconds, x_mm, y_mm, force_N] with a force from 0"
"""Description of a row of presses in a script file, for error messages."""

MAX_SCRIPT_FRAMES = 2_000_000
"""Largest number of frames of a script from a file, which is nearly three hours at 200 Hz."""

BITS_PER_BYTE = 8


@dataclass(frozen=True)
class Script:
    """Position and force of the press in each frame of a virtual sensor.

    Attributes:
        x_mm: Position, shape (n,), mm; NaN while nothing touches.
        y_mm: Position, shape (n,), mm; NaN while nothing touches.
        force_N: Force, shape (n,), N; 0 while nothing touches.
        rate_Hz: Number of frames per second, Hz.
    """

    x_mm: Array
    y_mm: Array
    force_N: Array
    rate_Hz: float

    def __post_init__(self) -> None:
        """Check that the arrays have one element for each frame, and that the frame rate is positive.

        Raises:
            SceneError: If the arrays have different shapes, more than one dimension or no elements, or if the frame
                rate is not positive.
        """
        shapes = {self.x_mm.shape, self.y_mm.shape, self.force_N.shape}
        have_same_shape = len(shapes) == 1
        if not have_same_shape or self.force_N.ndim != 1 or self.force_N.size == 0:
            raise SceneError(f"script: expected three arrays of one length above 0, got the shapes {sorted(shapes)}")
        if not self.rate_Hz > 0.0:
            raise SceneError(f"script: expected a positive rate, got {self.rate_Hz} Hz")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.force_N)

    @property
    def touching(self) -> Booleans:
        """Whether something touches the film in each frame, shape (n,)."""
        return self.force_N > 0.0


class Faults(Settings, frozen=True, kw_only=True):
    """Faults between the board and the reader. By default there are no faults.

    Attributes:
        lose_share: Fraction of the frames that are not sent, dimensionless.
        corrupt_share: Fraction of the bytes that are changed, dropped or followed by a random byte, dimensionless.
        gap_every_s: Interval of the gaps in which nothing is sent, s; 0 for no gaps.
        gap_s: Length of each gap, s.
        unplug_every_s: Interval of the outages of the port, s; 0 for no outages.
        unplug_s: Length of each outage, s.
        clock_ppm: Deviation of the device's clock rate from the true rate, parts per million.
    """

    lose_share: Fraction = 0.0
    corrupt_share: Fraction = 0.0
    gap_every_s: NotNegative = 0.0
    gap_s: NotNegative = 0.1
    unplug_every_s: NotNegative = 0.0
    unplug_s: NotNegative = 0.5
    clock_ppm: Annotated[float, Meta(gt=-1e6, lt=1e6)] = 0.0

    def is_silent(self, t_s: float) -> bool:
        """Return whether the sensor sends nothing at a given time, because of a gap or an outage of the port.

        Args:
            t_s: Time since the start of the script, s.
        """
        return _is_in_interval(t_s, self.gap_every_s, self.gap_s) or self.is_unplugged(t_s)

    def is_unplugged(self, t_s: float) -> bool:
        """Return whether a given time lies in an outage of the port.

        Args:
            t_s: Time since the start of the script, s.
        """
        return _is_in_interval(t_s, self.unplug_every_s, self.unplug_s)


def _is_in_interval(t_s: float, period_s: float, length_s: float) -> bool:
    """Return whether a time lies in one of several periodic intervals.

    Args:
        t_s: The time, s.
        period_s: Time between the beginnings of two intervals, s; 0 if there are no intervals. The first interval
            begins after one period.
        length_s: Length of each interval, s.
    """
    return period_s > 0.0 and t_s >= period_s and t_s % period_s < length_s


class VirtualScript(Settings, frozen=True):
    """Content of a script file for the command `isocharge serve virtual`.

    Attributes:
        presses: Rows (seconds, x_mm, y_mm, force_N), which are interpolated linearly. Nothing touches while the force
            is 0. Without rows, the presses are random.
        faults: Faults between the board and the reader.
        temperature_step_K: Step of the air temperature after 10 s, K; None for the value of the noise model.
        drift_pC_per_s: Drift of the charges caused by the bias current, pC/s; None for the value of the noise model.
        limit_pC: Largest charge that the converter measures, pC; None for the value of the noise model.
    """

    presses: tuple[Annotated[tuple[Finite, Finite, Finite, NotNegative], Meta(description=ROW_DESCRIPTION)], ...] = ()
    faults: Faults = Faults()
    temperature_step_K: Finite | None = None
    drift_pC_per_s: NotNegative | None = None
    limit_pC: Annotated[float, Meta(ge=1.0)] | None = None

    def __post_init__(self) -> None:
        """Check the times of the rows of `presses`, between which the presses are interpolated.

        Raises:
            WrongKey: If there is only one row, or the times do not increase.
        """
        if not self.presses:  # the presses are random
            return
        times_s = [row[0] for row in self.presses]
        is_rising = all(time_s < next_time_s for time_s, next_time_s in pairwise(times_s))
        if len(times_s) < 2 or not is_rising:
            raise WrongKey("presses", "two rows or more with growing seconds", self.presses)

    def script(self, rate_Hz: float) -> Script | None:
        """Create a script by linear interpolation between the rows of `presses` at the time of each frame.

        Args:
            rate_Hz: Number of frames per second, Hz.

        Returns:
            The script; None if the file has no rows, which means that the presses are random.

        Raises:
            SceneError: If there are too many frames.
        """
        if not self.presses:
            return None
        row_time_s, row_x_mm, row_y_mm, row_force_N = np.array(self.presses).T  # each of shape (rows,)
        start_s = row_time_s[0]
        end_s = row_time_s[-1]
        duration_s = end_s - start_s
        is_short_enough = duration_s * rate_Hz <= MAX_SCRIPT_FRAMES  # false for a rate of NaN
        if not is_short_enough:
            raise SceneError(
                f"script: expected at most {MAX_SCRIPT_FRAMES} frames, got {duration_s:g} s at {rate_Hz:g} Hz"
            )
        frame_time_s = np.arange(start_s, end_s, 1.0 / rate_Hz)
        force_N = np.interp(frame_time_s, row_time_s, row_force_N)

        # A position is only defined while something touches.
        is_touch = force_N > 0.0
        x_mm = np.where(is_touch, np.interp(frame_time_s, row_time_s, row_x_mm), np.nan)
        y_mm = np.where(is_touch, np.interp(frame_time_s, row_time_s, row_y_mm), np.nan)
        return Script(x_mm, y_mm, force_N, rate_Hz)


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
    rate_Hz: float = 200.0,
    radius_mm: float = DEFAULT_RADIUS,
    force_range_N: tuple[float, float] = DEFAULT_PLAYED_FORCE_RANGE,
) -> Script:
    """Create a script of random presses that move over the film, with a pause after each press.

    The position and the logarithm of the force vary smoothly within a press. The forces stay within the given range,
    because a forward map is only valid in a range of forces. The script begins with `INITIAL_REST_S` without a press.

    Args:
        seed: Seed of all random choices.
        seconds: Length of the script, s.
        rate_Hz: Number of frames per second, Hz.
        radius_mm: Radius of the disk that contains all presses, mm.
        force_range_N: Smallest and largest force, N.

    Raises:
        SceneError: If an argument is outside its range.
    """
    min_force_N, max_force_N = force_range_N
    has_valid_forces = 0.0 < min_force_N <= max_force_N
    has_frames = rate_Hz > 0.0 and seconds * rate_Hz >= 1.0
    if not (has_valid_forces and radius_mm > 0.0 and has_frames):
        raise SceneError(
            "wander: expected 0 < smallest <= largest force, a positive radius and at least one frame, got "
            f"{force_range_N} N, {radius_mm} mm, {seconds} s at {rate_Hz} Hz"
        )
    rng = np.random.default_rng(seed)
    t_s = np.arange(round(seconds * rate_Hz)) / rate_Hz
    position_mm = np.full(t_s.size, complex(np.nan, np.nan))  # x + i y; NaN while nothing touches
    force_N = np.zeros(t_s.size)

    # Each pass of the loop adds one press and the pause after this press.
    start_s = INITIAL_REST_S
    while start_s < seconds:
        end_s = start_s + rng.uniform(*PRESS_DURATION_S)
        is_in_press = (t_s >= start_s) & (t_s < end_s)
        time_in_press_s = t_s[is_in_press] - start_s
        position_mm[is_in_press] = radius_mm * _random_path(rng, time_in_press_s)

        # A level of 0 is the smallest force, and a level of 1 is the largest force. The scale is logarithmic.
        force_level = _force_level(rng, time_in_press_s, end_s - start_s)
        force_N[is_in_press] = min_force_N * (max_force_N / min_force_N) ** force_level
        start_s = end_s + rng.uniform(*PAUSE_DURATION_S)
    return Script(position_mm.real, position_mm.imag, force_N, rate_Hz)


def _random_path(rng: np.random.Generator, t_s: Array) -> Complexes:
    """Draw a smooth random path inside the unit disk.

    The path is the sum of a random starting point and three circular movements. Each movement begins at the origin and
    follows a circle through the origin. The direction of the centre of the circle and the speed are random.

    Args:
        rng: Source of the random numbers.
        t_s: Times since the start of the press, shape (n,), s.

    Returns:
        Points x + i y, shape (n,).
    """
    start_distance = np.sqrt(rng.uniform())  # the square root distributes the points evenly over the disk
    start = start_distance * np.exp(2j * np.pi * rng.uniform())

    turns_per_s = rng.uniform(-0.5, 0.5, size=(3, 1))
    circles = 0.25 * (np.exp(2j * np.pi * turns_per_s * t_s) - 1.0)  # movements on circles of radius 0.25, shape (3, n)
    rotations = np.exp(2j * np.pi * rng.uniform(size=(3, 1)))  # a factor of magnitude 1 rotates a circle
    path = start + (rotations * circles).sum(axis=0)

    # The path may leave the unit disk. The division changes a distance r from the centre into r / (1 + r^8)^(1/8),
    # which is less than 1, and nearly r if r is small.
    distance_divisor = (1.0 + np.abs(path) ** 8) ** (1 / 8)
    return np.asarray(path / distance_divisor)


def _force_level(rng: np.random.Generator, t_s: Array, duration_s: float) -> Array:
    """Draw the force of a random press as a level from 0 (smallest force) to 1 (largest force).

    The level is a slow sine around a random mean, multiplied by a smooth ramp at the beginning and at the end.

    Args:
        rng: Source of the random numbers.
        t_s: Times since the start of the press, shape (n,), s.
        duration_s: Duration of the press, s.

    Returns:
        Level at each time, shape (n,), dimensionless.
    """
    mean_level = rng.uniform()
    frequency_Hz = rng.uniform(0.3, 1.0)
    phase_turns = rng.uniform()
    unlimited_level = mean_level + 0.15 * np.sin(2.0 * np.pi * (frequency_Hz * t_s + phase_turns))

    # The ramp rises from 0 to 1 within `RAMP_S` after the beginning, and falls within `RAMP_S` before the end.
    time_to_edge_s = np.minimum(t_s, duration_s - t_s)  # time since the beginning or until the end
    ramp = np.clip(time_to_edge_s / RAMP_S, 0.0, 1.0)
    smooth_ramp = ramp * ramp * (3.0 - 2.0 * ramp)  # a cubic polynomial with the slope 0 at both ends
    return np.clip(unlimited_level, 0.0, 1.0) * smooth_ramp


def corrupt(data: bytes, fraction: float, rng: np.random.Generator) -> bytes:
    """Damage a random fraction of the bytes, as a faulty cable would damage them.

    A damaged byte has one flipped bit, is dropped, or is followed by a random byte, each with the same probability.

    Args:
        data: The bytes before the damage.
        fraction: Mean fraction of the bytes that are damaged, dimensionless.
        rng: Source of the random numbers.

    Returns:
        The bytes after the damage.
    """
    bytes_after_damage = [bytes([byte]) for byte in data]  # for each byte, the bytes that replace it
    is_damaged = rng.random(len(data)) < fraction
    for byte_index in np.flatnonzero(is_damaged).tolist():
        byte = data[byte_index]
        kind_of_damage = int(rng.integers(3))
        random_byte = int(rng.integers(256))
        if kind_of_damage == 0:  # one bit is flipped
            flipped_bit = 1 << (random_byte % BITS_PER_BYTE)
            bytes_after_damage[byte_index] = bytes([byte ^ flipped_bit])
        elif kind_of_damage == 1:  # the byte is dropped
            bytes_after_damage[byte_index] = b""
        else:  # the byte is followed by a random byte
            bytes_after_damage[byte_index] = bytes([byte, random_byte])
    return b"".join(bytes_after_damage)
