"""Warming of the film, told from force by the model, where that can be done.

A change of temperature gives every electrode the same charge (pyroelectricity), and while something touches, the base
cannot be watched. Four electrodes have one charge to spare, so the common charge p is the one with which the charges
fit a single contact best: the squared misfit is a parabola in p, whose curvature says how sure that is. A Kalman filter
follows p, which wanders slowly; every touch begins with none.

Where a press raises all charges alike, warming looks like force and the curvature vanishes: everywhere with three
electrodes, and near the centre of a biaxial film. There p is left alone, and the record says so.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array, Reals

TRIED_PC = np.array([-20.0, -10.0, 0.0, 10.0, 20.0])
"""Common charges at which the misfit is looked at, about the one so far, pC."""

_SQUARES = np.linalg.pinv(np.column_stack([np.ones(5), TRIED_PC, TRIED_PC**2]))

Misfit = Callable[[Array], Reals]
"""Charges of shape (n, electrodes), pC, to misfits of shape (n,), in standard deviations."""


@dataclass(frozen=True, slots=True)
class ThermalRule:
    """How warming is followed.

    Attributes:
        every_s: The misfit is looked at so often, s.
        wander_pC: What p wanders in a second, standard deviation, pC; 30 pC are 0.1 K in a second on 9 mm^2.
        noise: The model's own errors widen each look by this factor.
        blind_pC: Where one look is not surer than this, temperature cannot be told from force, pC.
        tell_pC: Warming is told in the record from here on, pC.
    """

    every_s: float = 0.05
    wander_pC: float = 30.0
    noise: float = 3.0
    blind_pC: float = 60.0
    tell_pC: float = 10.0


@dataclass(frozen=True, slots=True)
class ThermalDrift:
    """What is known of the warming in this touch.

    Attributes:
        charge_pC: The common charge p, pC.
        variance_pC2: Of p, pC^2.
        waited_s: Since the last look, s.
        blind: Whether temperature could not be told from force at the last look.
    """

    charge_pC: float = 0.0
    variance_pC2: float = 0.0
    waited_s: float = 0.0
    blind: bool = False


NO_DRIFT = ThermalDrift()


def track_thermal_drift(
    rule: ThermalRule, state: ThermalDrift, charge_pC: Array, misfit: Misfit, dt_s: float
) -> ThermalDrift:
    """What is known after the next frame in contact.

    Args:
        rule: How to follow.
        state: After the frame before.
        charge_pC: Touch charges, from which the warming so far has been taken, shape (electrodes,), pC.
        misfit: Of the model.
        dt_s: Since the frame before, s.
    """
    waited_s = state.waited_s + dt_s
    if waited_s < rule.every_s:
        return ThermalDrift(state.charge_pC, state.variance_pC2, waited_s, state.blind)
    predicted_pC2 = state.variance_pC2 + rule.wander_pC**2 * waited_s
    tried = charge_pC - TRIED_PC[:, np.newaxis]
    _, slope, curvature = (_SQUARES @ np.square(misfit(tried), dtype=float)).tolist()
    seen_pC2 = rule.noise**2 / curvature if curvature > 0.0 else math.inf
    if seen_pC2 > rule.blind_pC**2:
        return ThermalDrift(state.charge_pC, state.variance_pC2, 0.0, blind=True)
    off_pC = min(max(-slope / (2.0 * curvature), float(TRIED_PC[0])), float(TRIED_PC[-1]))
    gain = predicted_pC2 / (predicted_pC2 + seen_pC2)
    return ThermalDrift(state.charge_pC + gain * off_pC, (1.0 - gain) * predicted_pC2)
