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

BITS_OF_SIGN = 1.5
"""What a value that varies needs besides the size of its steps, bits: sign and fraction."""

PLAUSIBLE = (1e-7, 1e8)
"""Smallest and largest magnitude of a plausible floating-point value other than 0."""


LEAST_NOISE = 1e-5
"""Smallest step of a floating-point value that varies, in its magnitude, dimensionless: converters have 20 bits."""


def steps(values: Series, bits: int) -> Series:
    """Steps of an unsigned counter of some bits, taken over its wraps, shape (n - 1,), int64; up to half its range."""
    modulus = 1 << bits
    if bits == 64:
        return np.diff(values.astype(np.uint64)).astype(np.int64)
    difference: Series = np.diff(values.astype(np.int64))
    wrapped = difference % modulus
    return np.where(wrapped >= modulus // 2, wrapped - modulus, wrapped)


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


def bits_of_steps(step: Series) -> float:
    """Mean number of bits that steps need; 0 for a constant."""
    if not step.any():
        return 0.0
    return float(np.log2(1.0 + np.abs(step.astype(float))).mean()) + BITS_OF_SIGN


def bits_of_floats(values: Series, integers: Series, mantissa: int) -> float | None:
    """Mean number of bits that floating-point values need; None if they are not plausible.

    Args:
        values: The values, shape (n,).
        integers: Their bytes as integers, shape (n,).
        mantissa: Bits of their fraction, the first one too.
    """
    low, high = PLAUSIBLE
    with np.errstate(invalid="ignore"):
        magnitude = np.abs(values.astype(float))
        if not np.all(np.isfinite(magnitude) & ((magnitude == 0) | ((magnitude > low) & (magnitude < high)))):
            return None
    used = int(np.bitwise_or.reduce(integers)) & ((1 << mantissa) - 1)
    zeros = min(mantissa - 1, (used & -used).bit_length() - 1 if used else mantissa)  # values that came from few bits
    typical = float(np.median(magnitude)) or float(magnitude.max())
    quantum = typical * 2.0 ** (zeros - mantissa) or 1.0
    step = np.diff(values.astype(float))
    if step.any() and float(np.abs(step).mean()) < LEAST_NOISE * typical:
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
