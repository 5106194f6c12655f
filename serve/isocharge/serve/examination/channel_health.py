"""Health of one channel of a board while the film is at rest: offset, noise, drift and hum."""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.gain import LARGEST_PC

MAINS_HZ = (50.0, 60.0)
"""Frequencies at which hum is searched for, Hz."""


@dataclass(frozen=True)
class ChannelHealth:
    """Health of one channel.

    The results are in pC if the gain of the channel is known, and otherwise in the unit of the board. Offset, noise,
    drift, hum and span are None if no value of the channel is usable.

    Attributes:
        name: Name that the device uses, or the number of the channel, counted from 1.
        offset_pC: Mean charge.
        noise_pC: Standard deviation of the charge without drift and hum.
        drift_pC_per_s: Slope of the charge.
        hum_pC: Amplitudes of the hum at 50 and at 60 Hz. An amplitude is None if the frame rate is too low or the time
            is too short to estimate it.
        span_pC: Difference between the largest and the smallest value.
        unusable: Number of values that are not finite, or whose magnitude is larger than any charge of a film.
        unusable_value: The first of these values as a text, such as "nan"; empty if all values are usable.
    """

    name: str
    offset_pC: float | None = None
    noise_pC: float | None = None
    drift_pC_per_s: float | None = None
    hum_pC: tuple[float | None, float | None] = (None, None)
    span_pC: float | None = None
    unusable: int = 0
    unusable_value: str = ""


def measure_channel_health(
    name: str,
    charge_pC: Array,
    times_s: Array,
    rate_Hz: float,
    min_samples_per_period: float = 2.2,
    min_hum_time_s: float = 0.5,
) -> ChannelHealth:
    """Measure the offset, the noise, the drift and the hum of a channel while the film is at rest.

    A constant, a slope (the drift) and the hum at each mains frequency are fitted to the values by least squares. The
    hum is left out if the time is too short or the frame rate too low. The noise is the standard deviation of the
    residuals. The function ignores NaN and values whose magnitude is larger than `LARGEST_PC`.

    Args:
        name: Name of the channel.
        charge_pC: Values, shape (n,), pC, or in the unit of the board if the gain is not known.
        times_s: Times since the first frame, shape (n,), s.
        rate_Hz: Frames per second, Hz.
        min_samples_per_period: Smallest frame rate at which a hum is estimated. The default is 10 % above the Nyquist
            rate.
        min_hum_time_s: Shortest time from which hum is estimated, s. The resolution of the default is 2 Hz, which
            separates 50 from 60 Hz.

    Returns:
        The number of unusable values, and the other results, which are None if the channel has no usable value.
    """
    is_usable = np.abs(charge_pC) <= LARGEST_PC  # false for NaN
    unusable_count = int(np.count_nonzero(~is_usable))
    unusable_value = f"{charge_pC[~is_usable][0]:g}" if unusable_count else ""
    if unusable_count == is_usable.size:
        return ChannelHealth(name, unusable=unusable_count, unusable_value=unusable_value)
    usable_pC = charge_pC[is_usable]
    usable_times_s = times_s[is_usable]

    # The columns of the design matrix are a constant, the time, and the cosine and the sine of each hum. In a short
    # time, a hum cannot be distinguished from a drift. At a low frame rate, it cannot be sampled.
    columns = [np.ones_like(usable_times_s), usable_times_s]
    hum_columns: dict[float, int] = {}  # first column of each hum
    for hum_Hz in MAINS_HZ:
        if usable_times_s[-1] > min_hum_time_s and rate_Hz > min_samples_per_period * hum_Hz:
            hum_columns[hum_Hz] = len(columns)
            phase = 2.0 * np.pi * hum_Hz * usable_times_s
            columns += [np.cos(phase), np.sin(phase)]
    design_matrix = np.column_stack(columns)
    coefficients = np.linalg.lstsq(design_matrix, usable_pC, rcond=None)[0]
    hum_pC = {hum_Hz: math.hypot(*coefficients[column : column + 2]) for hum_Hz, column in hum_columns.items()}
    return ChannelHealth(
        name,
        offset_pC=float(usable_pC.mean()),
        noise_pC=float((usable_pC - design_matrix @ coefficients).std()),
        drift_pC_per_s=float(coefficients[1]),
        hum_pC=(hum_pC.get(50.0), hum_pC.get(60.0)),  # None if the hum was not fitted
        span_pC=float(np.ptp(usable_pC)),  # largest minus smallest value
        unusable=unusable_count,
        unusable_value=unusable_value,
    )
