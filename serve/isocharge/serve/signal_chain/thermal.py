"""Estimation of the warming of the film during a press. The estimate uses the misfit that the model computes.

A change of the temperature adds a charge to every electrode (pyroelectricity). The pyroelectric charges are equal on
all electrodes, or the ratios of these charges are known. During a touch, the charge at rest cannot be measured. A
contact has three unknowns, so four electrodes provide one charge more than is needed to compute the contact.

A trial value of the common charge p is subtracted from all charges. The estimate is the trial value with which the
remaining charges fit a single contact best. As a function of the trial value, the squared misfit is a parabola. The
curvature of the parabola gives the variance of the estimate. A Kalman filter describes the common charge p as a random
walk that begins at 0 with every touch.

If warming cannot be distinguished from a change of the force, the curvature vanishes. With three electrodes, the
curvature vanishes at every position. With four electrodes, the curvature vanishes where a press increases all charges
equally, for example near the centre of a biaxial film. If the curvature vanishes, the common charge p is not changed,
and the record has the flag `blind`.
"""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DeviceError
from isocharge.common.structs import Finite
from isocharge.serve.flags import BLIND, SATURATED, THERMAL
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.stage import NOT_IN_C, Divisor, Rule, Setting, Setup, Stage, SUM_TOLERANCE_s

TRIED_PC = np.array([-20.0, -10.0, 0.0, 10.0, 20.0])
"""Changes of the common charge for which the misfit is evaluated, pC. A parabola is fitted to the squared misfits."""

# Pseudo-inverse for a least-squares fit: the product with the squared misfits gives the coefficients of the parabola.
_PARABOLA_FIT = np.linalg.pinv(np.column_stack([np.ones(5), TRIED_PC, TRIED_PC**2]))

MIN_ELECTRODES = 4
"""Smallest number of electrodes with which warming can be distinguished from force.

A contact has three unknowns, and warming is a fourth unknown.
"""


class ThermalRule(Rule, frozen=True, kw_only=True):
    """Settings for the estimate of the warming, from the section `[common_mode]` of a device file.

    Attributes:
        every_s: Time between two estimates, s.
        wander_pC: Standard deviation of the change of p in one second, pC. The default of 50 pC is the charge of an
            electrode of 9 mm^2 for a change of 0.19 K. After a step of the air temperature by half a kelvin, the
            temperature of a film of 25 um changes about as fast.
        noise: Factor by which the errors of the model increase the standard deviation of an estimate.
        blind_pC: Standard deviation of an estimate above which temperature cannot be distinguished from force, pC.
        tell_pC: Smallest absolute value of p with which a record has the flag `thermal`, pC.
        pC_per_K: Charge of each electrode if the film warms by 1 K, pC/K. Only the ratios and the signs are used. None
            if all electrodes collect the same charge.
    """

    every_s: Setting = 0.05
    wander_pC: Setting = 50.0
    noise: Divisor = 3.0
    blind_pC: Setting = 60.0
    tell_pC: Setting = 10.0
    pC_per_K: dict[str, Finite] | None = None


class Warming(Stage):
    """Estimates the charge p that a warming of the film adds to all electrodes, and subtracts this charge.

    After each time interval `every_s`, the change of p is estimated. Several trial values of the change are
    subtracted from the charges. The misfit of a trial value is the distance of the remaining charges from the nearest
    single contact. A parabola is fitted to the squared misfits. The minimum of the parabola is the estimate. A Kalman
    filter weights this estimate by its variance and by the predicted variance of p.
    """

    section = "common_mode"
    rule_class = ThermalRule
    needs_model = True

    def __init__(self, setup: Setup) -> None:
        """Begin with an estimated warming of zero."""
        self._setup = setup
        self._rule = setup.device.rule(ThermalRule) or ThermalRule()
        self._ratios = warming_ratios(setup)
        self.reset()

    def reset(self) -> None:
        """Discard the warming, because a touch has ended."""
        self._charge_pC = 0.0  # p
        self._variance_pC2 = 0.0  # variance of p
        self._waited_s = 0.0  # time since the last estimate
        self._is_blind = False  # whether temperature could not be distinguished from force at the last estimate

    def step(self, frame: Frame) -> None:
        """Estimate the warming during a touch, subtract the charge that a change of the warming causes, and add flags.

        Earlier stages have already subtracted the charge of the earlier changes, and read the present change from the
        frame (`warming_pC`) when the next frame comes. While an amplifier is saturated, the warming is not estimated,
        because then the charges fit no contact for any value of the warming.
        """
        if frame.charge_pC is None:
            return
        if not frame.is_contact:
            self.reset()
            return
        if SATURATED in frame.flags:
            return
        # `_estimate` returns the change of the common charge. Each electrode has its own known ratio to this charge.
        change_pC = self._estimate(frame.charge_pC, frame.noise_pC, frame.dt_s) * self._ratios
        frame.charge_pC = frame.charge_pC - change_pC
        frame.warming_pC = change_pC
        frame.warming_error_pC = math.sqrt(self._variance_pC2) * self._ratios
        if frame.is_base_held and frame.tare_pC is not None:  # the tare follows the warming
            frame.tare_pC = frame.tare_pC + change_pC
        if abs(self._charge_pC) >= self._rule.tell_pC:  # the common charge since the beginning of the touch
            frame.flags.append(THERMAL)
        if self._is_blind:
            frame.flags.append(BLIND)

    def _estimate(self, charge_pC: Array, noise_pC: Array, dt_s: float) -> float:
        """Update the estimate of the common charge p that warming has added, and return its change, pC.

        Warming adds the charge p times `_ratios[i]` to the electrode i. A Kalman filter computes the estimate
        (`_charge_pC`) and its variance (`_variance_pC2`). A change of p is measured as follows. Trial values of the
        change are subtracted from the charges. The misfit of a trial value is the distance of the remaining charges
        from the charges of the nearest contact. A parabola is fitted to the squared misfits, and its minimum is the
        measured change. If the parabola is too flat, warming cannot be distinguished from force. The estimate is then
        not changed.

        Args:
            charge_pC: Touch charges from which the present estimate has been subtracted, shape (n_electrode,), pC.
            noise_pC: Measured noise of the charges, shape (n_electrode,), pC.
            dt_s: Time since the previous frame, s.
        """
        rule = self._rule
        self._waited_s += dt_s
        if self._waited_s < rule.every_s - SUM_TOLERANCE_s:  # no estimate in this frame
            return 0.0
        # The common charge changes like a random walk, whose variance increases in proportion to the time. In one
        # second, it changes by the standard deviation `wander_pC`.
        self._variance_pC2 += rule.wander_pC**2 * self._waited_s
        self._waited_s = 0.0

        # Fit: squared misfit = constant + slope * c + curvature * c^2, where c is the trial value of the change. The
        # trial values are `TRIED_PC`. The product with the matrix `_PARABOLA_FIT` is the least-squares fit.
        trial_charges_pC = charge_pC - TRIED_PC[:, np.newaxis] * self._ratios  # shape (trials, n_electrode)
        predictor = self._setup.model.for_measured_noise(noise_pC)
        squared_misfits = np.square(predictor.predict_batch(trial_charges_pC).misfit, dtype=float)
        _constant, slope, curvature = (_PARABOLA_FIT @ squared_misfits).tolist()

        # The variance of the minimum is the inverse of the curvature, because the misfit is in standard deviations.
        # Errors of the model multiply the standard deviation by the factor `noise`.
        estimate_variance_pC2 = rule.noise**2 / curvature if curvature > 0.0 else math.inf
        self._is_blind = estimate_variance_pC2 > rule.blind_pC**2
        if self._is_blind:
            return 0.0

        # The measured change is the minimum of the parabola, limited to the range of the trial values.
        minimum_pC = -slope / (2.0 * curvature)
        change_pC = min(max(minimum_pC, TRIED_PC[0]), TRIED_PC[-1])

        # Kalman update of the estimate and of its variance
        gain = self._variance_pC2 / (self._variance_pC2 + estimate_variance_pC2)
        self._charge_pC += gain * change_pC
        self._variance_pC2 *= 1.0 - gain
        return float(gain * change_pC)

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings of the section `[common_mode]` for the C sources, by name.

        The result is empty if the device file has no such section. The C sources assume that a warming adds the same
        charge to all electrodes.

        Args:
            setup: Device file and model for which C sources are written.

        Raises:
            DeviceError: If the section has the key `pC_per_K`, which states a charge for each electrode, or if the
                model has too few electrodes.
        """
        settings = super().c_settings(setup)
        if settings:
            warming_ratios(setup)  # only to raise its error for too few electrodes
        charge_pC_per_K = settings.pop("pC_per_K", None)  # the C sources have no such setting
        if charge_pC_per_K is not None:
            raise DeviceError(f"{setup.device.where}: common_mode.pC_per_K: {NOT_IN_C}")
        return settings


def warming_ratios(setup: Setup) -> Array:
    """Return the charge that warming adds to each electrode, relative to the mean magnitude over all electrodes.

    Warming can only be estimated with at least four electrodes, so the number of electrodes is checked first.

    Returns:
        Ratios, shape (n_electrode,), dimensionless. All ratios are 1 if the device file does not state
        `common_mode.pC_per_K`.

    Raises:
        DeviceError: If there are too few electrodes, if the charges of all electrodes are 0, or if the setting states
            numbers for other electrodes.
    """
    rule = setup.device.rule(ThermalRule) or ThermalRule()
    if len(setup.electrodes) < MIN_ELECTRODES:
        raise DeviceError(
            f"{setup.device.where}: common_mode: expected four electrodes or more, the model has {setup.electrodes}; "
            "with three every set of charges fits some contact, and warming cannot be separated from force: remove the "
            "section"
        )
    charge_pC_per_K = setup.for_each_electrode("common_mode.pC_per_K", 1.0 if rule.pC_per_K is None else rule.pC_per_K)
    mean_magnitude_pC_per_K = float(np.abs(charge_pC_per_K).mean())
    if mean_magnitude_pC_per_K == 0.0:
        raise DeviceError(
            f"{setup.device.where}: common_mode.pC_per_K: expected a number other than 0, got {rule.pC_per_K}"
        )
    return charge_pC_per_K / mean_magnitude_pC_per_K
