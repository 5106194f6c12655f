"""The stages of the signal chain. Each stage stores its settings and its state.

The computations of the stages are pure functions in the modules `hum`, `tare`, `leak`, `memory`, `contact` and
`thermal`. The classes of this module store the state between frames, and write the results that other stages need into
the frame.
"""

import math

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import BLIND, NEGATIVE, SATURATED, TARE, THERMAL
from isocharge.serve.signal_chain.contact import NO_TOUCH, Touch, TouchRule, update_contact
from isocharge.serve.signal_chain.hum import Hum, HumRule, remove_hum
from isocharge.serve.signal_chain.leak import Leak, LeakRule, undo_leak
from isocharge.serve.signal_chain.memory import (
    Memory,
    MemoryRule,
    add_warmth,
    begin_touch,
    charge_scale_std,
    undo_memory,
)
from isocharge.serve.signal_chain.stage import ChainFrame, OffsetStage, Stage, WarmingChange
from isocharge.serve.signal_chain.tare import Tare, TareRule, follow_drift, look_for_tare
from isocharge.serve.signal_chain.thermal import NO_DRIFT, Misfit, ThermalRule, track_thermal_drift


class Gain(Stage):
    """Converts values of the device to charges in pC, with the offset, the sign and the gain of each channel."""

    def __init__(self, gain_pC: Array | None, zero: Array | None) -> None:
        """Set the conversion.

        Args:
            gain_pC: Charge per unit of the device, with sign, shape (electrodes,), pC; None if the unit is pC.
            zero: Values of the device without charge, shape (electrodes,), in the unit of the device; None for zeros.
        """
        self._gain_pC = gain_pC
        self._zero = zero

    def convert(self, values: Array) -> Array:
        """Convert values of the device, shape (electrodes,), to charges, pC."""
        charges = values if self._zero is None else values - self._zero
        return charges if self._gain_pC is None else charges * self._gain_pC

    def revert(self, charge_pC: Array) -> Array:
        """Convert charges, shape (electrodes,), pC, to values of the device. This is the inverse of `convert`.

        The values are infinite if the charge per unit is nearly 0.
        """
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            values = charge_pC if self._gain_pC is None else charge_pC / self._gain_pC
        return values if self._zero is None else values + self._zero

    def step(self, frame: ChainFrame) -> None:
        """Convert the values of a frame to charges."""
        frame.raw_pC = self.convert(frame.values)
        frame.charge_pC = frame.raw_pC


class Limit(Stage):
    """Marks frames with a charge at the limit of the converter."""

    def __init__(self, limit_pC: float) -> None:
        """Set the largest charge that the converter can represent, pC."""
        self._limit_pC = limit_pC

    def step(self, frame: ChainFrame) -> None:
        """Mark the frame if the magnitude of one of its charges reaches or exceeds the limit of the converter."""
        if bool((np.abs(frame.raw_pC) >= self._limit_pC).any()):
            frame.is_at_limit = True


class HumStage(Stage):
    """Subtracts mains hum."""

    def __init__(self, rule: HumRule, n_electrode: int) -> None:
        """Store the settings, and begin with an estimate of zero hum.

        Args:
            rule: Settings of the estimate of hum.
            n_electrode: Number of electrodes.
        """
        self._rule = rule
        self._hum = Hum.start(n_electrode)

    def step(self, frame: ChainFrame) -> None:
        """Subtract the hum from a frame, and update the estimate of the hum."""
        self._hum, frame.charge_pC = remove_hum(self._rule, self._hum, frame.charge_pC, frame.t_s, frame.dt_s)

    def reset(self) -> None:
        """Keep the estimate of the hum, but do not compare the next frame with the latest frame."""
        self._hum = self._hum._replace(raw_pC=None)


class TareStage(OffsetStage):
    """Measures the charge at rest in quiet frames, and subtracts this charge from all later frames."""

    def __init__(self, rule: TareRule | None, n_electrode: int, *, follows_drift: bool) -> None:
        """Begin without a tare.

        Args:
            rule: Conditions of a tare; None to subtract nothing.
            n_electrode: Number of electrodes.
            follows_drift: Whether the tare follows a slow drift out of contact. False if a later stage integrates the
                charge and estimates the drift itself.
        """
        self._rule = rule
        self._follows_drift = follows_drift
        self._tare: Tare | None = None
        self._previous_frame: tuple[Array, float] | None = None  # charges, pC, and time since the frame before it, s
        self._latest_pC = np.empty((0, n_electrode))  # charges of the latest frames, from which the tare is measured
        self._searched_frames = 0  # number of frames since the beginning of the search
        self._is_search_limited = True  # whether the search ends with an error after too many frames

    @property
    def tare(self) -> Tare | None:
        """The tare that is subtracted from each frame, or None if no tare has been measured yet."""
        return self._tare

    def step(self, frame: ChainFrame) -> None:
        """Subtract the tare, which is the charge at rest. While there is no tare, search for a tare.

        While nothing touches the film, the tare follows a slow drift. It follows each frame only after the later stages
        have found that the frame has no contact. The first frame of a touch therefore does not change the tare.

        The later stages skip a frame without a tare.

        Args:
            frame: The frame, which is changed in place.

        Raises:
            TareError: If the film is touched during the whole search for a tare.
        """
        if self._tare is not None:
            if self._follows_drift and self._rule is not None:
                if self._previous_frame is not None and not frame.was_contact:
                    self._tare = follow_drift(self._rule, self._tare, *self._previous_frame)
                self._previous_frame = (frame.charge_pC, frame.dt_s)
                # The charge out of contact decays, but the charge of a finger that is leaving the film does not.
                frame.base_relax_s = self._rule.relax_s
                frame.is_base_held = True
            frame.tare = self._tare
            frame.charge_pC = frame.charge_pC - self._tare.charge_pC
            return
        self._search(frame.charge_pC)
        frame.is_finished = True
        frame.flags.append(TARE)
        if frame.is_at_limit:  # the later stage that sets this flag is skipped
            frame.flags.append(SATURATED)

    def reset(self) -> None:
        """Measure the tare again from the next quiet frames.

        Unlike the first search for a tare, the new search does not end with an error.
        """
        self._tare = None
        self._previous_frame = None
        self._latest_pC = self._latest_pC[:0]  # without any frame
        self._searched_frames = 0
        self._is_search_limited = False

    def add_warming(self, change: WarmingChange) -> None:
        """Add the warming to the tare."""
        assert self._tare is not None
        self._tare = self._tare._replace(charge_pC=self._tare.charge_pC + change.charge_pC)

    def _search(self, charge_pC: Array) -> None:
        """Add a frame to the stored latest frames, and measure the tare if these frames are enough and quiet.

        The tare is the charge at rest, which is subtracted from all later frames. If the settings contain no conditions
        for a tare, the tare is 0.

        Args:
            charge_pC: Charges of this frame, shape (electrodes,), pC.

        Raises:
            TareError: If the film is touched during the whole search for a tare.
        """
        if self._rule is None:
            zero_pC = np.zeros_like(charge_pC)
            self._tare = Tare(charge_pC=zero_pC, noise_pC=zero_pC, frames=0)
            return
        stored_pC = np.vstack([self._latest_pC, charge_pC])
        self._latest_pC = stored_pC[-self._rule.frames :]  # at most as many frames as a tare needs
        if self._is_search_limited:  # otherwise the count remains 0, and the search never ends with an error
            self._searched_frames += 1
        self._tare = look_for_tare(self._rule, self._latest_pC, self._searched_frames)
        if self._tare is not None:
            self._latest_pC = self._latest_pC[:0]  # the frames are not needed any more


class LeakStage(OffsetStage):
    """Corrects the leak of the charge amplifiers, and estimates their inflow."""

    def __init__(self, rule: LeakRule, tau_s: Array) -> None:
        """Store the settings. The state begins at the first frame after the tare.

        Args:
            rule: Settings of the estimate of the inflow.
            tau_s: Time constant of each amplifier, shape (electrodes,), s.
        """
        self._rule = rule
        self._tau_s = tau_s
        self._leak: Leak | None = None

    def step(self, frame: ChainFrame) -> None:
        """Replace the output of the amplifiers by the touch charge, in which the leak of the amplifiers is corrected.

        Args:
            frame: The frame, which is changed in place. Its charges are the output above the tare.
        """
        output_pC = frame.charge_pC
        if self._leak is None:  # the first frame after the tare
            self._leak = Leak.start(output_pC)
        else:
            self._leak = undo_leak(
                self._rule,
                self._tau_s,
                self._leak,
                output_pC,
                frame.noise_pC,
                frame.dt_s,
                contact=frame.was_contact,
            )
        frame.charge_pC = self._leak.charge_pC
        frame.base_relax_s = self._rule.relax_s  # out of contact, the charge decays to zero with this time constant

    def reset(self) -> None:
        """Discard the state. A new state begins at the first frame after the next tare."""
        self._leak = None

    def add_warming(self, change: WarmingChange) -> None:
        """Subtract the warming from the touch charge that the stage integrates."""
        assert self._leak is not None
        self._leak = self._leak._replace(charge_pC=self._leak.charge_pC - change.charge_pC)


class MemoryStage(OffsetStage):
    """Corrects creep, the thermoelastic step and the leak of the amplifiers together."""

    def __init__(self, rule: MemoryRule, leak_rule: LeakRule, tau_s: Array | None) -> None:
        """Store the settings. The state begins at the first frame after the tare.

        Args:
            rule: Memory of the film.
            leak_rule: Settings of the estimate of the amplifiers' inflow.
            tau_s: Time constant of each amplifier, shape (electrodes,), s; None if charges do not leak.
        """
        self._rule = rule
        self._leak_rule = leak_rule
        self._tau_s = tau_s
        self._memory: Memory | None = None

    def step(self, frame: ChainFrame) -> None:
        """Replace the output of the amplifiers by the touch charge.

        The leak of the amplifiers and the memory of the film (creep and the thermoelastic step) are corrected. The
        values that the detection of touches needs are also written into the frame.

        Args:
            frame: The frame, which is changed in place. Its charges are the output above the tare.
        """
        output_pC = frame.charge_pC
        previous_memory = self._memory
        if previous_memory is None:  # the first frame after the tare
            self._memory = Memory.start(self._rule, output_pC)
        else:
            frame.is_base_held = previous_memory.is_recently_touched  # a finger may still be leaving the film
            self._memory = undo_memory(
                self._rule,
                self._leak_rule,
                self._tau_s,
                previous_memory,
                output_pC,
                frame.noise_pC,
                frame.dt_s,
                contact=frame.was_contact,
            )
        # Out of contact, the estimate of the warmth absorbs the charge. A frame leaves the share exp(-2 dt / settle_s)
        # of the charge, so the time constant is half of `settle_s`.
        frame.base_relax_s = 0.5 * self._rule.settle_s
        self._report(frame)

    def begin_touch(self, frame: ChainFrame) -> None:
        """Replace the warmth in this frame by a prediction from its values before the touch.

        The warmth is the charge due to a change of temperature. Its latest estimate is wrong, because the touch began
        before it was detected.

        Args:
            frame: The first frame of the touch. Its touch charge is computed again.
        """
        assert self._memory is not None
        self._memory = begin_touch(self._rule, self._memory)
        self._report(frame)

    def reset(self) -> None:
        """Discard the state. A new state begins at the first frame after the next tare."""
        self._memory = None

    def add_warming(self, change: WarmingChange) -> None:
        """Add the warming to the predicted warmth."""
        assert self._memory is not None
        self._memory = add_warmth(self._memory, change.charge_pC, change.rate_pC_per_s, is_learned=change.is_learned)

    def _report(self, frame: ChainFrame) -> None:
        """Write the touch charge, and the relative standard deviation that all touch charges share, into a frame."""
        assert self._memory is not None
        frame.charge_pC = self._memory.leak.charge_pC
        frame.charge_scale_std = charge_scale_std(self._memory)


class TouchStage(Stage):
    """Determines whether something touches the film."""

    def __init__(self, rule: TouchRule | None, earlier_stages: list[Stage]) -> None:
        """Begin without a touch.

        Args:
            rule: The thresholds; None if every frame with a tare is in contact.
            earlier_stages: Stages that are notified when a touch begins.
        """
        self._rule = rule
        self._earlier_stages = earlier_stages
        self._touch = NO_TOUCH

    @property
    def is_contact(self) -> bool:
        """Whether something touched the film in the latest frame."""
        return self._touch.contact

    def step(self, frame: ChainFrame) -> None:
        """Determine whether something touches the film in this frame, and notify the earlier stages if a touch begins.

        The notified stages may change the charges of the frame, because the touch began before it was detected.

        Args:
            frame: The frame, after the earlier stages.
        """
        previous_touch = self._touch
        self._touch = self._next_touch(previous_touch, frame)
        frame.touch = self._touch
        is_beginning = self._touch.contact and not previous_touch.contact
        if is_beginning:
            for stage in self._earlier_stages:
                stage.begin_touch(frame)

    def reset(self) -> None:
        """Discard the touch."""
        self._touch = NO_TOUCH

    def _next_touch(self, previous_touch: Touch, frame: ChainFrame) -> Touch:
        """Return the state of the touch detection after a frame. Without thresholds, every frame is in contact.

        The base is the smallest total charge since the last release. The base decays exponentially with time.

        Args:
            previous_touch: State after the previous frame.
            frame: The frame, after the earlier stages.
        """
        if self._rule is None:
            return Touch(contact=True)
        # While a finger leaves the film, a positive base must not decay, because this charge still belongs to the
        # finger. An infinite time constant makes the decay factor 1.
        base_relax_s = frame.base_relax_s
        if frame.is_base_held and previous_touch.base_pC > 0.0:
            base_relax_s = math.inf
        base_decay = math.exp(-frame.dt_s / base_relax_s)
        total_pC = float(frame.charge_pC.sum())
        return update_contact(self._rule, previous_touch, total_pC, frame.noise_pC, base_decay, frame.charge_scale_std)


class PressFlags(Stage):
    """Sets flags for presses in which an amplifier was at its limit, and for charges well below zero."""

    def __init__(self) -> None:
        """Begin without a press."""
        self._is_saturated = False

    def step(self, frame: ChainFrame) -> None:
        """Add the flags `saturated` and `negative` to a frame.

        The flag `saturated` means that an amplifier is or was at its limit during the press. All later frames of the
        press keep the flag `saturated`. The flag `negative` means that the total charge is well below zero.

        Args:
            frame: The frame, which is changed in place.
        """
        was_saturated_in_press = self._is_saturated and frame.touch.contact
        self._is_saturated = frame.is_at_limit or was_saturated_in_press
        frame.is_saturated = self._is_saturated
        if frame.is_saturated:
            frame.flags.append(SATURATED)
        if frame.touch.is_negative:
            frame.flags.append(NEGATIVE)

    def reset(self) -> None:
        """Discard the press."""
        self._is_saturated = False


class Warming(Stage):
    """Estimates the charge that a warming of the film adds to all electrodes, and subtracts this charge."""

    def __init__(
        self,
        rule: ThermalRule,
        misfit: Misfit,
        offset_stage: OffsetStage,
        *,
        ratios: Array | float = 1.0,
        warmth_s: float | None = None,
    ) -> None:
        """Store the settings, and begin with an estimated warming of zero.

        Args:
            rule: Settings of the estimate of warming.
            misfit: Function that returns how badly charges fit a single contact, according to the current model.
            offset_stage: Stage that stores the charge at rest. Each change of the warming is added to this charge.
            ratios: Charge that warming adds to each electrode, relative to the mean magnitude over all electrodes,
                shape (electrodes,), dimensionless.
            warmth_s: Time constant with which the film follows the air, s; None if it is not known.
        """
        self._rule = rule
        self._misfit = misfit
        self._offset_stage = offset_stage
        self._electrode_ratios = ratios
        self._warmth_time_constant_s = warmth_s
        self._drift = NO_DRIFT

    def step(self, frame: ChainFrame) -> None:
        """Estimate the warming of a frame in contact, subtract its change from the charges, and add the flags.

        The stage that stores the charge at rest has already subtracted the earlier changes of the warming. It also
        receives the present change. While an amplifier is saturated, the warming is not estimated.

        Args:
            frame: The frame, which is changed in place.
        """
        if not frame.touch.contact:
            self._drift = NO_DRIFT
            return
        if frame.is_saturated:  # for any value of the warming, the charges of a saturated amplifier fit no contact
            return
        previous_pC = self._drift.charge_pC
        drift = track_thermal_drift(
            self._rule,
            self._drift,
            frame.charge_pC,
            self._misfit,
            frame.dt_s,
            self._electrode_ratios,
            self._warmth_time_constant_s,
        )
        self._drift = drift

        # After a touch with a large warming, the stage of the film's memory must not learn the properties of the film.
        is_large = abs(drift.charge_pC) >= self._rule.tell_pC
        if drift.charge_pC != previous_pC:  # most frames do not change the estimate
            change_pC = (drift.charge_pC - previous_pC) * self._electrode_ratios
            frame.charge_pC = frame.charge_pC - change_pC
            rate_pC_per_s = drift.rate_pC_per_s * self._electrode_ratios
            self._offset_stage.add_warming(WarmingChange(change_pC, rate_pC_per_s, is_learned=not is_large))
        if is_large:
            frame.flags.append(THERMAL)
        if drift.blind:  # the warming cannot be distinguished from a change of the force
            frame.flags.append(BLIND)

    def reset(self) -> None:
        """Discard the warming."""
        self._drift = NO_DRIFT
