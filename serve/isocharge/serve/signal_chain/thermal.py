"""Estimation of the warming of the film during a press. The estimate uses the misfit that the model computes.

A change of the temperature adds a charge to every electrode (pyroelectricity). The pyroelectric charges are equal on
all electrodes, or the ratios of these charges are known. During a touch, the charge at rest cannot be measured. A
contact has three unknowns, so four electrodes provide one charge more than is needed to compute the contact.

A trial value of the common charge p is subtracted from all charges. The estimate is the trial value with which the
remaining charges fit a single contact best. As a function of the trial value, the squared misfit is a parabola. The
curvature of the parabola gives the variance of the estimate. A Kalman filter describes the common charge p as a random
walk that begins at 0 with every touch. If the memory of the film predicts the warmth, the filter describes the slope of
p as a random walk instead.

If warming cannot be distinguished from a change of the force, the curvature vanishes. With three electrodes, the
curvature vanishes at every position. With four electrodes, the curvature vanishes where a press increases all charges
equally, for example near the centre of a biaxial film. If the curvature vanishes, the common charge p is not changed,
and the record has the flag `blind`.
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
    """Settings for the estimate of the warming, from the section `[common_mode]` of a device file.

    Attributes:
        every_s: Time between two estimates, s.
        wander_pC: Standard deviation of the change of p in one second, pC. The default of 50 pC is the charge of an
            electrode of 9 mm^2 for a change of 0.19 K. A film of 25 um changes its temperature about as fast after a
            step of the air temperature by half a kelvin.
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
        rate_pC_per_s: Change of the slope of p by this estimate, pC/s; 0 if the slope is not predicted.
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
    """Use a frame in contact to update the estimated charge p that the warming of the film adds to the electrodes.

    After each time interval `every_s`, a change of the charge p is estimated. Several trial values of the change are
    subtracted from the charges. The misfit of a trial value is the distance of the remaining charges from the nearest
    single contact. A parabola is fitted to the squared misfits. The minimum of the parabola is the estimate. A Kalman
    filter weights this estimate by its variance and by the predicted variance of p. If the parabola is too flat, p is
    not changed, its predicted variance is kept, and the state is marked as `blind`.

    Args:
        rule: Settings of the estimate of warming.
        state: State after the previous frame.
        charge_pC: Touch charges from which the present p has been subtracted, shape (electrodes,), pC.
        misfit: Function from charges, shape (n, electrodes), pC, to misfits, shape (n,), in standard deviations of the
            noise.
        dt_s: Time since the previous frame, s.
        ratios: Charge that warming adds to each electrode, relative to p, shape (electrodes,), dimensionless.
        warmth_s: Time constant with which the slope of p decays, s; None if the slope is not predicted.

    Returns:
        The state after this frame. Its rate is the correction of the slope of p in this frame.
    """
    waited_s = state.waited_s + dt_s
    if waited_s < rule.every_s:  # no estimate in this frame, so the slope is not corrected
        return state._replace(waited_s=waited_s, rate_pC_per_s=0.0)
    predicted_variance_pC2, predicted_covariance, predicted_rate_variance = _predicted_variances(
        rule, state, waited_s, warmth_s
    )

    # Fit: squared misfit = constant + slope * c + curvature * c^2, where c is the trial value of the change.
    trial_charges_pC = charge_pC - TRIED_PC[:, np.newaxis] * ratios  # shape (trials, electrodes)
    squared_misfits = np.square(misfit(trial_charges_pC), dtype=float)
    _constant, slope, curvature = (_PARABOLA_FIT @ squared_misfits).tolist()

    # The variance of the estimate is the inverse of the curvature, because the misfit is in standard deviations. Errors
    # of the model increase it by `noise` squared. If the parabola is flat, warming cannot be distinguished from force.
    estimate_variance_pC2 = rule.noise**2 / curvature if curvature > 0.0 else math.inf
    if estimate_variance_pC2 > rule.blind_pC**2:  # p is not changed
        return ThermalDrift(
            charge_pC=state.charge_pC,
            variance_pC2=predicted_variance_pC2,
            blind=True,
            covariance=predicted_covariance,
            rate_variance=predicted_rate_variance,
        )

    # The estimate is the minimum of the parabola, limited to the range of the trial values.
    minimum_pC = -slope / (2.0 * curvature)
    change_pC = min(max(minimum_pC, float(TRIED_PC[0])), float(TRIED_PC[-1]))

    # Kalman update of p and of its slope, with their variances and their covariance
    innovation_variance_pC2 = predicted_variance_pC2 + estimate_variance_pC2
    charge_gain = predicted_variance_pC2 / innovation_variance_pC2
    rate_gain = predicted_covariance / innovation_variance_pC2
    return ThermalDrift(
        charge_pC=state.charge_pC + charge_gain * change_pC,
        variance_pC2=(1.0 - charge_gain) * predicted_variance_pC2,
        rate_pC_per_s=rate_gain * change_pC,  # correction of the slope in this frame
        covariance=(1.0 - charge_gain) * predicted_covariance,
        rate_variance=predicted_rate_variance - rate_gain * predicted_covariance,
    )


def _predicted_variances(
    rule: ThermalRule, state: ThermalDrift, waited_s: float, warmth_s: float | None
) -> tuple[float, float, float]:
    """After a time without an estimate, predict the uncertainty of the common charge p and of its rate of change.

    The rate decays with the time constant `warmth_s`, and random changes are added to the rate (white process noise).
    If this time constant is not known, p is a random walk without a rate.

    Let t be the time since the last estimate. The rate decays by the factor e = exp(-t / warmth_s). A rate of 1 changes
    p by g = warmth_s (1 - e). Let r be the variance that the process noise adds to the rate. The prediction is

        var(p)       <- var(p) + 2 g cov(p, rate) + g^2 var(rate) + r t^2 / 3,
        cov(p, rate) <- e (cov(p, rate) + g var(rate)) + r t / 2,
        var(rate)    <- e^2 var(rate) + r.

    Args:
        rule: Settings of the estimate of warming.
        state: State at the last estimate.
        waited_s: Time since the last estimate, s.
        warmth_s: Time constant with which the rate of p decays, s; None if the rate is not predicted.

    Returns:
        Variance of p, pC^2; covariance of p and its rate, pC^2/s; and variance of the rate, pC^2/s^2.
    """
    if warmth_s is None:
        random_walk_variance_pC2 = state.variance_pC2 + rule.wander_pC**2 * waited_s
        return random_walk_variance_pC2, 0.0, 0.0

    # The variance r is proportional to t. After one second, the variance r t^2 / 3 that is added to p is the square of
    # `wander_pC`, which is by definition the standard deviation of the change of p in one second.
    added_rate_variance = 3.0 * rule.wander_pC**2 * waited_s
    decay = math.exp(-waited_s / warmth_s)
    rate_effect_s = warmth_s * (1.0 - decay)
    covariance = state.covariance
    rate_variance = state.rate_variance
    predicted_variance_pC2 = (
        state.variance_pC2
        + rate_effect_s * (2.0 * covariance + rate_effect_s * rate_variance)
        + added_rate_variance * waited_s**2 / 3.0
    )
    predicted_covariance = decay * (covariance + rate_effect_s * rate_variance) + 0.5 * added_rate_variance * waited_s
    predicted_rate_variance = decay * decay * rate_variance + added_rate_variance
    return predicted_variance_pC2, predicted_covariance, predicted_rate_variance
