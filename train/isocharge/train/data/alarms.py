"""When a misfit is an alarm, and on which presses alarms are judged: for cards, the report and benchmarks alike."""

import numpy as np

from isocharge.common.arrays import Array, Booleans

FALSE_ALARMS = 0.01
"""Share of good presses whose misfit is above the alarm's threshold, dimensionless."""

ABOUT_1_N = (0.8, 1.25)
"""Smallest and largest force that counts as 1 N where faults are looked for, N."""


def alarm_threshold(good_misfits: Array) -> float:
    """The misfit that the share `FALSE_ALARMS` of good presses exceeds; `good_misfits` has shape (n,)."""
    return float(np.percentile(good_misfits, 100.0 * (1.0 - FALSE_ALARMS)))


def about_1_N(force_N: Array) -> Booleans:
    """Which forces count as 1 N, the same shape."""
    low, high = ABOUT_1_N
    about: Booleans = (force_N >= low) & (force_N <= high)
    return about
