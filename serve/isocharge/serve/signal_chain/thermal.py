"""Warming of the film during a press, separated from force by the model where that is possible.

A change of temperature gives every electrode a charge (pyroelectricity), the same one or in ratios that are known, and
during a touch the charge at rest cannot be measured. A contact has three unknowns, so four electrodes leave one charge
over: the common charge p is estimated as the one without which the charges fit a single contact best. The squared
misfit is a parabola in p, and its curvature gives the variance of that estimate. A Kalman filter follows p as a random
walk from 0 at the start of every touch; where the film's memory predicts its warmth, the walk is that of p's slope.

Where a press raises all charges alike, warming looks like force and the curvature vanishes: everywhere with three
electrodes, and near the centre of a biaxial film. There p stays as it is, and the record is flagged `blind`.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.signal_chain.rule import Rule, Setting

TRIED_PC = np.array([-20.0, -10.0, 0.0, 10.0, 20.0])
"""Changes of the common charge at which the misfit is evaluated, pC."""

_PARABOLA_FIT = np.linalg.pinv(np.column_stack([np.ones(5), TRIED_PC, TRIED_PC**2]))

Misfit = Callable[[Array], Reals]
"""Charges of shape (n, electrodes), pC, to misfits of shape (n,), in standard deviations."""


class ThermalRule(Rule, frozen=True, kw_only=True):
    """How warming is followed.

    Attributes:
        every_s: Time between two estimates, s.
        wander_pC: Standard deviation of the change of p in one second, pC; 50 pC are 0.19 K on 9 mm^2: half a kelvin,
            which 25 um of PVDF in air follow within 2.7 s.
        noise: Factor by which the model's own errors widen the standard deviation of an estimate.
        blind_pC: Standard deviation of an estimate above which temperature counts as inseparable from force, pC.
        tell_pC: Smallest |p| that is flagged `thermal`, pC.
    """

    every_s: Setting = 0.05
    wander_pC: Setting = 50.0
    noise: Setting = 3.0
    blind_pC: Setting = 60.0
    tell_pC: Setting = 10.0


class ThermalDrift(NamedTuple):
    """Warming in this touch.

    Attributes:
        charge_pC: The common charge p, pC.
        variance_pC2: Its variance, pC^2.
        waited_s: Time since the last estimate, s.
        blind: Whether temperature was inseparable from force at the last estimate.
        rate_pC_per_s: By how much p's slope, if it is predicted, has to change with this estimate, pC/s.
        covariance, rate_variance: Of p and its slope, pC^2/s, and of the slope, pC^2/s^2.
    """

    charge_pC: float = 0.0
    variance_pC2: float = 0.0
    waited_s: float = 0.0
    blind: bool = False
    rate_pC_per_s: float = 0.0
    covariance: float = 0.0
    rate_variance: float = 0.0


NO_DRIFT = ThermalDrift()


def track_thermal_drift(
    rule: ThermalRule,
    state: ThermalDrift,
    charge_pC: Array,
    misfit: Misfit,
    dt_s: float,
    ratios: Array | float = 1.0,
    warmth_s: float | None = None,
) -> ThermalDrift:
    """The warming after the next frame in contact.

    Args:
        rule: How to follow it.
        state: After the frame before.
        charge_pC: Touch charges without the warming so far, shape (electrodes,), pC.
        misfit: Of the model.
        dt_s: Since the frame before, s.
        ratios: Charge of each electrode over p, shape (electrodes,), dimensionless.
        warmth_s: Time in which the slope of p decays, s, if it is predicted.
    """
    waited_s = state.waited_s + dt_s
    if waited_s < rule.every_s:
        return state._replace(waited_s=waited_s, rate_pC_per_s=0.0)
    predicted_pC2, covariance, rate_variance = _predicted(rule, state, waited_s, warmth_s)
    tried_pC = charge_pC - TRIED_PC[:, np.newaxis] * ratios
    _, slope, curvature = (_PARABOLA_FIT @ np.square(misfit(tried_pC), dtype=float)).tolist()
    estimate_pC2 = rule.noise**2 / curvature if curvature > 0.0 else math.inf
    if estimate_pC2 > rule.blind_pC**2:
        return state._replace(waited_s=0.0, blind=True, rate_pC_per_s=0.0)
    change_pC = min(max(-slope / (2.0 * curvature), float(TRIED_PC[0])), float(TRIED_PC[-1]))
    gain = predicted_pC2 / (predicted_pC2 + estimate_pC2)
    turn = covariance / (predicted_pC2 + estimate_pC2)
    return ThermalDrift(
        state.charge_pC + gain * change_pC,
        (1.0 - gain) * predicted_pC2,
        rate_pC_per_s=turn * change_pC,
        covariance=(1.0 - gain) * covariance,
        rate_variance=rate_variance - turn * covariance,
    )


def _predicted(
    rule: ThermalRule, state: ThermalDrift, waited_s: float, warmth_s: float | None
) -> tuple[float, float, float]:
    """Variance of p, its covariance with its slope, and that one's variance, after a while."""
    if warmth_s is None:
        return state.variance_pC2 + rule.wander_pC**2 * waited_s, 0.0, 0.0
    walk = 3.0 * rule.wander_pC**2 * waited_s  # of the slope: p's is as large after a second
    left = math.exp(-waited_s / warmth_s)
    reach_s, both, rate = warmth_s * (1.0 - left), state.covariance, state.rate_variance
    variance_pC2 = state.variance_pC2 + reach_s * (2.0 * both + reach_s * rate) + walk * waited_s**2 / 3.0
    return variance_pC2, left * (both + reach_s * rate) + 0.5 * walk * waited_s, left * left * rate + walk
