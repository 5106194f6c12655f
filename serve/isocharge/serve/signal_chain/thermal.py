"""Estimation of the warming of the film during a press. The estimate uses the misfit of the model.

A change of temperature adds a charge to every electrode (pyroelectricity). The charges of all electrodes are equal, or
have known ratios. During a touch, the charge at rest cannot be measured. A contact has three unknowns, so four
electrodes have one charge more than the contact needs.

A trial value of the common charge p is subtracted from all charges. The estimate is the trial value with which the
remaining charges fit a single contact best. The squared misfit is a parabola in p, and its curvature gives the variance
of the estimate. A Kalman filter describes p as a random walk that begins at 0 with every touch. If the memory of the
film predicts the warmth, the slope of p is the random walk.

At positions where a press increases all charges equally, warming cannot be distinguished from force, and the curvature
vanishes. With three electrodes, this is the case at every position. With four electrodes, this is the case near the
centre of a biaxial film. If warming cannot be distinguished from force, p is not changed, and the record has the flag
`blind`.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.signal_chain.rule import Rule, Setting

TRIED_PC = np.array([-20.0, -10.0, 0.0, 10.0, 20.0])
"""Changes of the common charge at which the misfit is evaluated, pC. A parabola is fitted to the squared misfits."""

# Pseudo-inverse for a least-squares fit: the product with the squared misfits gives the coefficients of the parabola.
_PARABOLA_FIT = np.linalg.pinv(np.column_stack([np.ones(5), TRIED_PC, TRIED_PC**2]))

Misfit = Callable[[Array], Reals]
"""Function that returns misfits of shape (n,), in standard deviations, for charges of shape (n, electrodes), pC."""


class ThermalRule(Rule, frozen=True, kw_only=True):
    """Settings for estimating the warming. These settings are a part of the section `[common_mode]` of a device file.

    Attributes:
        every_s: Time between two estimates, s.
        wander_pC: Standard deviation of the change of p in one second, pC. The default of 50 pC is a change of 0.19 K
            on 9 mm^2. A film of 25 um in air follows a step of half a kelvin within 2.7 s, about as fast.
        noise: Factor by which the errors of the model increase the standard deviation of an estimate.
        blind_pC: Standard deviation of an estimate above which temperature cannot be distinguished from force, pC.
        tell_pC: Smallest absolute value of p with which a record has the flag `thermal`, pC.
    """

    every_s: Setting = 0.05
    wander_pC: Setting = 50.0
    noise: Setting = 3.0
    blind_pC: Setting = 60.0
    tell_pC: Setting = 10.0


class ThermalDrift(NamedTuple):
    """State of the estimate in this touch.

    Attributes:
        charge_pC: Common charge p, pC.
        variance_pC2: Variance of p, pC^2.
        waited_s: Time since the last estimate, s.
        blind: Whether temperature could not be distinguished from force at the last estimate.
        rate_pC_per_s: Change of the slope of p with this estimate, if the slope is predicted, pC/s.
        covariance: Covariance of p and its slope, pC^2/s.
        rate_variance: Variance of the slope, pC^2/s^2.
    """

    charge_pC: float = 0.0
    variance_pC2: float = 0.0
    waited_s: float = 0.0
    blind: bool = False
    rate_pC_per_s: float = 0.0
    covariance: float = 0.0
    rate_variance: float = 0.0


NO_DRIFT = ThermalDrift()
"""State at the beginning of a touch."""


def track_thermal_drift(
    rule: ThermalRule,
    state: ThermalDrift,
    charge_pC: Array,
    misfit: Misfit,
    dt_s: float,
    ratios: Array | float = 1.0,
    warmth_s: float | None = None,
) -> ThermalDrift:
    """Return the state after the next frame in contact.

    Every `every_s`, the common charge p is estimated. A parabola is fitted to the squared misfits at several trial
    values of p, and its minimum is the estimate. A Kalman filter combines the estimate with the prediction.

    Args:
        rule: Settings of the estimate of warming.
        state: State after the previous frame.
        charge_pC: Touch charges without the warming so far, shape (electrodes,), pC.
        misfit: Misfit of the current model.
        dt_s: Time since the previous frame, s.
        ratios: Charge that warming adds to each electrode, relative to p, shape (electrodes,), dimensionless.
        warmth_s: Time constant with which the slope of p decays, s; None if the slope is not predicted.
    """
    waited_s = state.waited_s + dt_s
    if waited_s < rule.every_s:
        return state._replace(waited_s=waited_s, rate_pC_per_s=0.0)
    predicted_pC2, predicted_covariance, predicted_rate_variance = _predicted_variances(rule, state, waited_s, warmth_s)

    # Fit: squared misfit = constant + slope * p + curvature * p^2, where p is the trial value that is subtracted.
    trial_charges_pC = charge_pC - TRIED_PC[:, np.newaxis] * ratios  # shape (trials, electrodes)
    squared_misfits = np.square(misfit(trial_charges_pC), dtype=float)
    _constant, slope, curvature = (_PARABOLA_FIT @ squared_misfits).tolist()
    estimate_pC2 = rule.noise**2 / curvature if curvature > 0.0 else math.inf  # variance of the estimate
    if estimate_pC2 > rule.blind_pC**2:
        return state._replace(waited_s=0.0, blind=True, rate_pC_per_s=0.0)

    # The estimate is the minimum of the parabola, limited to the range of the trial values.
    minimum_pC = -slope / (2.0 * curvature)
    change_pC = min(max(minimum_pC, float(TRIED_PC[0])), float(TRIED_PC[-1]))

    # Kalman update of p and of its rate of change
    innovation_pC2 = predicted_pC2 + estimate_pC2
    charge_gain = predicted_pC2 / innovation_pC2
    rate_gain = predicted_covariance / innovation_pC2
    return ThermalDrift(
        charge_pC=state.charge_pC + charge_gain * change_pC,
        variance_pC2=(1.0 - charge_gain) * predicted_pC2,
        rate_pC_per_s=rate_gain * change_pC,
        covariance=(1.0 - charge_gain) * predicted_covariance,
        rate_variance=predicted_rate_variance - rate_gain * predicted_covariance,
    )


def _predicted_variances(
    rule: ThermalRule, state: ThermalDrift, waited_s: float, warmth_s: float | None
) -> tuple[float, float, float]:
    """Predict the uncertainty of the common charge p and of its rate of change.

    The rate decays with the time constant `warmth_s` and has a white process noise. If this time constant is not known,
    p is a random walk without a rate.

    Args:
        rule: Settings of the estimate of warming.
        state: State at the last estimate.
        waited_s: Time since the last estimate, s.
        warmth_s: Time constant with which the rate of p decays, s; None if the rate is not predicted.

    Returns:
        Variance of p, covariance of p and its rate, and variance of the rate.
    """
    if warmth_s is None:
        random_walk_pC2 = state.variance_pC2 + rule.wander_pC**2 * waited_s
        return random_walk_pC2, 0.0, 0.0

    # The process noise of the rate adds the variance rate_noise * waited_s^2 / 3 to p. With the factor of 3, p changes
    # by `wander_pC` in one second.
    rate_noise = 3.0 * rule.wander_pC**2 * waited_s
    decay = math.exp(-waited_s / warmth_s)
    rate_effect_s = warmth_s * (1.0 - decay)  # change of p for a rate of 1
    covariance = state.covariance
    rate_variance = state.rate_variance
    variance_pC2 = (
        state.variance_pC2
        + rate_effect_s * (2.0 * covariance + rate_effect_s * rate_variance)
        + rate_noise * waited_s**2 / 3.0
    )
    predicted_covariance = decay * (covariance + rate_effect_s * rate_variance) + 0.5 * rate_noise * waited_s
    predicted_rate_variance = decay * decay * rate_variance + rate_noise
    return variance_pC2, predicted_covariance, predicted_rate_variance
