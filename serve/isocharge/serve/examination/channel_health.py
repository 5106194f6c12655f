"""One channel at rest: offset, noise, drift and hum, by least squares."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.chain import LARGEST_PC

MAINS_HZ = (50.0, 60.0)
"""Frequencies at which hum is looked for, Hz."""

SAMPLES_PER_PERIOD = 2.2
"""Smallest rate for a hum, in samples per period, dimensionless: 10 % above the Nyquist rate."""

SHORTEST_S = 0.5
"""Shortest time from which hum is estimated, s: 5 Hz resolution separates 50 from 60 Hz."""


@dataclass(frozen=True)
class ChannelHealth:
    """One channel at rest, in pC after the gain; None where no value is a charge.

    Attributes:
        name: As the device calls it, or its number from 1.
        offset_pC: Mean.
        noise_pC: Standard deviation without drift and hum.
        drift_pC_per_s: Slope.
        hum_pC: Amplitude at 50 and at 60 Hz; None where the rate is too low, or the time too short, to tell.
        span_pC: Difference of the largest and the smallest value.
        unusable: Number of values that are no charges: not finite, or larger than any film's.
    """

    name: str
    offset_pC: float | None = None
    noise_pC: float | None = None
    drift_pC_per_s: float | None = None
    hum_pC: tuple[float | None, float | None] = (None, None)
    span_pC: float | None = None
    unusable: int = 0


def channel_health(name: str, charge_pC: Array, t_s: Array, rate_Hz: float) -> ChannelHealth:
    """Fit a constant, a slope and the hum to a channel.

    Args:
        name: The channel's name.
        charge_pC: Its values, shape (n,), pC.
        t_s: Their times from the first frame on, shape (n,), s.
        rate_Hz: Frames per second, Hz.
    """
    usable = np.abs(charge_pC) <= LARGEST_PC
    unusable = int(np.count_nonzero(~usable))
    if unusable == usable.size:
        return ChannelHealth(name, unusable=unusable)
    charge_pC, t_s = charge_pC[usable], t_s[usable]
    mains_Hz = [hum for hum in MAINS_HZ if rate_Hz > SAMPLES_PER_PERIOD * hum and t_s[-1] > SHORTEST_S]
    phases = [2.0 * np.pi * hum * t_s for hum in mains_Hz]
    columns = [np.ones_like(t_s), t_s, *(wave(phase) for phase in phases for wave in (np.cos, np.sin))]
    design = np.column_stack(columns)
    fit = np.linalg.lstsq(design, charge_pC, rcond=None)[0]
    amplitudes = {hum: float(np.hypot(*fit[2 + 2 * k : 4 + 2 * k])) for k, hum in enumerate(mains_Hz)}
    return ChannelHealth(
        name,
        offset_pC=float(charge_pC.mean()),
        noise_pC=float((charge_pC - design @ fit).std()),
        drift_pC_per_s=float(fit[1]),
        hum_pC=(amplitudes.get(50.0), amplitudes.get(60.0)),
        span_pC=float(np.ptp(charge_pC)),
        unusable=unusable,
    )
