"""One field or column over many frames: whether it counts frames, is a clock, and how many bits its values need."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Series = NDArray[Any]

FEWEST = 5
"""Smallest number of values of which anything is said."""

COUNTING_SHARE = 0.9
"""Share of steps by which a counter or a clock goes on, dimensionless: frames may be lost, and counters start anew."""

CLOCK_SPREAD = (0.3, 1.7)
"""Smallest and largest usual step of a clock, in its median step."""

UNITS_HZ = {"t_s": 1.0, "t_ms": 1e3, "t_us": 1e6}
"""Ticks per second of a clock by the name of its field, Hz."""

USUAL_HZ = (100.0, 1e4, 1e5, 1024.0, 32768.0, 31250.0, 500e3, 2e6, 4e6, 8e6, 16e6)
"""Other rates at which clocks of boards tick, Hz."""

TOLERANCE = 0.06
"""Largest relative difference of a clock's rate from a usual one, dimensionless: frames arrive in bursts."""

BITS_OF_SIGN = 1.5
"""What a value that varies needs besides the size of its steps, bits: sign and fraction."""

PLAUSIBLE = (1e-7, 1e8)
"""Smallest and largest magnitude of a plausible floating-point value other than 0."""

PLAUSIBLE_SHARE = 0.95
"""Share of values that are plausible, dimensionless: some may be damaged."""

LEAST_NOISE = 1e-5
"""Smallest step of a floating-point value that varies, in its magnitude, dimensionless: converters have 20 bits."""


def steps(values: Series, bits: int) -> Series:
    """Steps of an unsigned counter of some bits, taken over its wraps, shape (n - 1,), int64; up to half its range."""
    half = 1 << (bits - 1)
    difference: Series = np.diff(values.astype(np.int64))
    return (difference + half) % (2 * half) - half


def is_counter(step: Series) -> bool:
    """Whether values go on by one."""
    return len(step) >= FEWEST - 1 and float(np.mean(step == 1)) >= COUNTING_SHARE


def clock_step(step: Series) -> float | None:
    """The mean step of a clock, without those over lost frames; None if values do not go on by steps of one size."""
    if len(step) < FEWEST - 1 or not (median := float(np.median(step))) > 0:
        return None
    low, high = CLOCK_SPREAD
    usual = (step >= low * median) & (step <= high * median)
    return float(step[usual].mean()) if float(np.mean(usual)) >= COUNTING_SHARE else None


def clock_of(step: Series, rate_Hz: float) -> tuple[str, float] | None:
    """The name of a clock's field, and the value of one tick in the unit that the name says; None if it is no clock.

    Args:
        step: From frame to frame, shape (n,).
        rate_Hz: Frames per second, Hz.
    """
    if (ticks := clock_step(step)) is None:
        return None
    for name, unit_Hz in UNITS_HZ.items():
        if abs(ticks * rate_Hz / unit_Hz - 1.0) < TOLERANCE:
            return name, 1.0
    usual = (usual_Hz for usual_Hz in USUAL_HZ if abs(ticks * rate_Hz / usual_Hz - 1.0) < TOLERANCE)
    return next((("t_us", UNITS_HZ["t_us"] / usual_Hz) for usual_Hz in usual), None)


def bits_of_steps(step: Series) -> float:
    """Mean number of bits that steps need; 0 for a constant."""
    if not step.any():
        return 0.0
    return float(np.log2(1.0 + np.abs(step.astype(float))).mean()) + BITS_OF_SIGN


def bits_of_floats(values: Series, integers: Series, mantissa: int) -> float | None:
    """Mean number of bits that floating-point values need; None if too many are not plausible.

    Args:
        values: The values, shape (n,).
        integers: Their bytes as integers, shape (n,).
        mantissa: Bits of their fraction, the first one too.
    """
    low, high = PLAUSIBLE
    with np.errstate(invalid="ignore"):
        magnitude = np.abs(values.astype(float))
    plausible = (magnitude == 0) | ((magnitude > low) & (magnitude < high))
    if float(np.mean(plausible)) < PLAUSIBLE_SHARE:
        return None
    values, integers, magnitude = values[plausible], integers[plausible], magnitude[plausible]
    used = int(np.bitwise_or.reduce(integers)) & ((1 << mantissa) - 1)
    zeros = min(mantissa - 1, (used & -used).bit_length() - 1 if used else mantissa)  # values that came from few bits
    typical = float(np.median(magnitude)) or float(magnitude.max())
    quantum = typical * 2.0 ** (zeros - mantissa) or 1.0
    step = np.diff(values.astype(float))
    if step.any() and float(np.median(np.abs(step))) < LEAST_NOISE * typical:
        return None
    return bits_of_steps(step / quantum)


def rest_of(values: Series) -> float:
    """The level at which a channel rests: the median of its values; 0 without a finite one."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def noise_of(values: Series) -> float:
    """Standard deviation of a channel, from the median size of its steps, which presses hardly change.

    Coarse counts that stand still most of the time have a median step of 0; their mean step decides.
    """
    step = np.abs(np.diff(values[np.isfinite(values)].astype(float)))
    if not len(step):
        return 0.0
    return float(np.median(step) / (0.6745 * np.sqrt(2.0)) or step.mean() * np.sqrt(np.pi) / 2.0)
