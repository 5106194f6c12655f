"""Health of one channel of a board while the film is at rest: offset, noise, drift and hum."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.gain import LARGEST_PC

MAINS_HZ = (50.0, 60.0)
"""Frequencies at which hum is searched for, Hz."""

MIN_SAMPLES_PER_PERIOD = 2.2
"""Smallest frame rate at which a hum is estimated, in samples per period: 10 % above the Nyquist rate."""

MIN_HUM_TIME_S = 0.5
"""Shortest time from which hum is estimated, s. Its resolution of 2 Hz separates 50 from 60 Hz."""


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


def measure_channel_health(name: str, charge_pC: Array, times_s: Array, rate_Hz: float) -> ChannelHealth:
    """Measure the offset, the noise, the drift and the hum of a channel while the film is at rest.

    A constant, a slope (the drift) and the hum at each mains frequency are fitted to the values by least squares. The
    hum is left out if the time is too short or the frame rate too low. The noise is the standard deviation of the
    residuals. The function ignores NaN and values whose magnitude is larger than `LARGEST_PC`.

    Args:
        name: Name of the channel.
        charge_pC: Values, shape (n,), pC, or in the unit of the board if the gain is not known.
        times_s: Times since the first frame, shape (n,), s.
        rate_Hz: Frames per second, Hz.

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

    # In a short time, a hum cannot be distinguished from a drift. At a low frame rate, it cannot be sampled.
    hum_frequencies_Hz: list[float] = []
    if usable_times_s[-1] > MIN_HUM_TIME_S:
        hum_frequencies_Hz = [hum_Hz for hum_Hz in MAINS_HZ if rate_Hz > MIN_SAMPLES_PER_PERIOD * hum_Hz]
    fit = _fit_drift_and_hum(usable_pC, usable_times_s, hum_frequencies_Hz)
    hum_50_Hz_pC = fit.hum_amplitudes_pC.get(50.0)  # None if the hum of this frequency was not fitted
    hum_60_Hz_pC = fit.hum_amplitudes_pC.get(60.0)
    return ChannelHealth(
        name,
        offset_pC=float(usable_pC.mean()),
        noise_pC=float(fit.residual_pC.std()),
        drift_pC_per_s=fit.slope_pC_per_s,
        hum_pC=(hum_50_Hz_pC, hum_60_Hz_pC),
        span_pC=float(np.ptp(usable_pC)),  # largest minus smallest value
        unusable=unusable_count,
        unusable_value=unusable_value,
    )


class _DriftAndHum(NamedTuple):
    """Straight line and sinusoidal hum that were fitted to the values of a channel.

    Attributes:
        slope_pC_per_s: Slope of the line.
        hum_amplitudes_pC: Amplitude of the hum at each frequency, Hz.
        residual_pC: Values minus the fit, shape (n,).
    """

    slope_pC_per_s: float
    hum_amplitudes_pC: dict[float, float]
    residual_pC: Array


def _fit_drift_and_hum(charge_pC: Array, times_s: Array, hum_frequencies_Hz: Sequence[float]) -> _DriftAndHum:
    """Fit a straight line and a hum at each frequency to the values of a channel, by linear least squares.

    The fitted function of the time t is

        constant + slope * t + sum over the frequencies f of (cosine * cos(2 pi f t) + sine * sin(2 pi f t)).

    The amplitude of the hum at a frequency is sqrt(cosine^2 + sine^2).

    Args:
        charge_pC: Values, shape (n,), pC.
        times_s: Times of the values, shape (n,), s.
        hum_frequencies_Hz: Frequencies of the hum, Hz; empty if only the line is fitted.

    Returns:
        Slope of the line, amplitude of the hum at each frequency, and residuals.
    """
    # Each column contains the values of one function of time, which is multiplied by its coefficient.
    columns = [np.ones_like(times_s), times_s]
    for hum_Hz in hum_frequencies_Hz:
        phase = 2.0 * np.pi * hum_Hz * times_s
        columns += [np.cos(phase), np.sin(phase)]
    design_matrix = np.column_stack(columns)
    coefficients = np.linalg.lstsq(design_matrix, charge_pC, rcond=None)[0]

    # The coefficients have the order of the columns, so those of the hum alternate between cosine and sine.
    _constant, slope_pC_per_s, *hum_coefficients = coefficients.tolist()
    cosines_pC = hum_coefficients[0::2]
    sines_pC = hum_coefficients[1::2]
    amplitudes_pC = {}
    for hum_Hz, cosine_pC, sine_pC in zip(hum_frequencies_Hz, cosines_pC, sines_pC, strict=True):
        amplitudes_pC[hum_Hz] = math.hypot(cosine_pC, sine_pC)
    residual_pC = charge_pC - design_matrix @ coefficients
    return _DriftAndHum(slope_pC_per_s, amplitudes_pC, residual_pC)
