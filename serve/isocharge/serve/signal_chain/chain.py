"""The signal chain, which computes touch charges from the values of a board and detects touches.

`Chain` contains the settings of all stages. `SignalChain` contains the requested stages in the following order.

- `Gain` converts values of the device to charges in pC, with the offset, the sign and the gain of each channel.
- `Limit` marks frames with a charge at the limit of the converter.
- `HumStage` estimates and subtracts mains hum.
- `TareStage` measures the mean and the noise of quiet frames, and subtracts the mean from all later frames. Without the
  next stage, the mean follows a slow drift while nothing touches the film.
- `LeakStage` corrects the leak of the amplifiers, and estimates the inflow, a slow current into each amplifier. If the
  settings describe the memory of the film, `MemoryStage` replaces `LeakStage`, and also corrects creep, the
  thermoelastic step and the warmth of the film.
- `TouchStage` detects touches with hysteresis.
- `PressFlags` sets the flags for saturated presses and for charges below zero.
- `Warming` estimates the charge that a warming of the film adds to all electrodes, and subtracts this charge.

If a value of a frame cannot be a charge, the stages skip the frame. After skipped frames, the time step of the next
frame begins at the last valid frame.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import INVALID
from isocharge.serve.signal_chain.contact import TouchRule
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.memory import MemoryRule
from isocharge.serve.signal_chain.stage import ChainFrame, OffsetStage, Stage
from isocharge.serve.signal_chain.stages import (
    Gain,
    HumStage,
    LeakStage,
    Limit,
    MemoryStage,
    PressFlags,
    TareStage,
    TouchStage,
    Warming,
)
from isocharge.serve.signal_chain.tare import Tare, TareRule
from isocharge.serve.signal_chain.thermal import Misfit, ThermalRule

LARGEST_PC = 1e9
"""Largest charge of a valid reading, pC. Sums of such charges are exact to 1e-7 pC in double precision."""


@dataclass(frozen=True, slots=True)
class Chain:
    """The settings of all stages, in the order of the stages. The value None switches a stage off.

    Attributes:
        gain_pC: Charge per unit of the device, with sign, shape (electrodes,), pC.
        zero: Values of the device without charge, shape (electrodes,), in the unit of the device.
        limit_pC: Largest charge that the converter can represent, pC.
        hum: Settings of the estimate of mains hum.
        tare: Conditions of a tare.
        tau_s: Time constant of each amplifier, shape (electrodes,), s; None if charges do not leak.
        leak: Settings of the estimate of the inflow of the amplifiers.
        memory: Memory of the film, which changes the charges of a held press.
        touch: Thresholds of a touch. If None, every frame with a tare is in contact.
        thermal: Settings of the estimate of warming.
        warming_ratios: Charge that warming adds to each electrode, relative to the mean magnitude over all electrodes,
            shape (electrodes,), dimensionless; 1.0 if all electrodes are equal.
        largest: Largest magnitude of a valid value, in the unit of the device.
    """

    gain_pC: Array | None = None
    zero: Array | None = None
    limit_pC: float | None = None
    hum: HumRule | None = None
    tare: TareRule | None = field(default_factory=TareRule)
    tau_s: Array | None = None
    leak: LeakRule = field(default_factory=LeakRule)
    memory: MemoryRule | None = None
    touch: TouchRule | None = field(default_factory=TouchRule)
    thermal: ThermalRule | None = None
    warming_ratios: Array | float = 1.0
    largest: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        largest_gain_pC = 1.0 if self.gain_pC is None else float(np.abs(self.gain_pC).max())
        object.__setattr__(self, "largest", LARGEST_PC / largest_gain_pC)  # the dataclass is frozen


class Reading(NamedTuple):
    """Result of the signal chain for one frame.

    Attributes:
        raw_pC: Charges as the device sent them, shape (electrodes,), pC.
        charge_pC: Touch charges, shape (electrodes,), pC; None while there is no tare, and for an invalid frame.
        tare: The tare that was subtracted.
        contact: Whether something touches the film.
        flags: Flags that the frame had before the signal chain, followed by the flags of the signal chain.
        charge_scale_std: Relative standard deviation that all touch charges have in common, because the memory of the
            film is not known exactly.
    """

    raw_pC: Array
    charge_pC: Array | None
    tare: Tare | None
    contact: bool
    flags: tuple[str, ...] = ()
    charge_scale_std: float = 0.0


class SignalChain:
    """The stages of one sensor with their state.

    A signal chain must be used in one thread only. The same sequence of frames always gives the same readings.

    Attributes:
        stages: The stages that the settings request, in their order.
    """

    def __init__(self, settings: Chain, n_electrode: int, misfit: Misfit | None = None) -> None:
        """Build the stages in the order in which they process a frame.

        A stage without settings is left out, except for four stages that are always present: gain, tare, touch and the
        flags of a press.

        Args:
            settings: Settings of all stages.
            n_electrode: Number of electrodes.
            misfit: Function that returns how badly charges fit a single contact, according to the current model. Only
                the warming stage needs this function.

        Raises:
            ValueError: If there is a warming stage and no misfit is given.
        """
        self._settings = settings
        self._gain = Gain(settings.gain_pC, settings.zero)
        self._skipped_s = 0.0  # duration of the invalid frames since the last valid frame
        stages: list[Stage] = [self._gain]
        if settings.limit_pC is not None:
            stages.append(Limit(settings.limit_pC))
        if settings.hum is not None:
            stages.append(HumStage(settings.hum, n_electrode))
        compensation = _leak_or_memory_stage(settings)
        self._tare_stage = TareStage(settings.tare, n_electrode, follows_drift=compensation is None)
        stages.append(self._tare_stage)

        # The offset stage is the last stage that stores the charge at rest. The warming stage adds the charge of the
        # warming to this charge.
        offset_stage: OffsetStage = self._tare_stage
        if compensation is not None:
            stages.append(compensation)
            offset_stage = compensation

        # The touch stage notifies the earlier stages when a touch begins.
        earlier_stages = stages.copy()  # a copy, because further stages are appended below
        self._touch_stage = TouchStage(settings.touch, earlier_stages)
        stages += [self._touch_stage, PressFlags()]
        if settings.thermal is not None:
            if misfit is None:
                raise ValueError("the warming stage needs the misfit of a model, got None")
            warming_ratios = settings.warming_ratios
            # Time constant with which the film follows the temperature of the air, s; only known with a memory
            warmth_s = None if settings.memory is None else settings.memory.warmth_s
            stages.append(Warming(settings.thermal, misfit, offset_stage, ratios=warming_ratios, warmth_s=warmth_s))
        self.stages = stages

    def advance(
        self, values: Array, t_s: float, dt_s: float, *, limited: bool = False, flags: tuple[str, ...] = ()
    ) -> Reading:
        """Process the next frame with all stages, and return its touch charges and its flags.

        A frame with a value that cannot be a charge gets the flag `invalid`, and does not change the state of the
        stages. The reading of such a frame, and of a frame before the first tare, has no touch charges.

        Args:
            values: Values as the device sent them, in the unit of the device, shape (electrodes,).
            t_s: Time on the clock of the device, s.
            dt_s: Time since the previous frame, s.
            limited: Whether the device itself reports that an amplifier is at its limit.
            flags: Flags that the frame already has. The stages add further flags.

        Raises:
            TareError: If the film is touched during the whole search for a tare.
        """
        magnitude = math.hypot(*values.tolist())  # at least the largest absolute value; NaN if a value is NaN
        is_valid = magnitude <= self._settings.largest  # false for NaN
        if not is_valid:
            self._skipped_s += dt_s
            with np.errstate(over="ignore"):  # a value may be so large that its conversion overflows
                raw_pC = self._gain.convert(values)
            return Reading(raw_pC, charge_pC=None, tare=None, contact=False, flags=(*flags, INVALID))

        valid_dt_s = dt_s + self._skipped_s  # time since the previous valid frame
        self._skipped_s = 0.0
        frame = ChainFrame(values, t_s, valid_dt_s, limited, self._touch_stage.is_contact, list(flags))
        for stage in self.stages:
            stage.step(frame)
            if frame.is_finished:  # there is no tare yet, so there are no touch charges
                return Reading(frame.raw_pC, charge_pC=None, tare=None, contact=False, flags=tuple(frame.flags))
        return Reading(
            frame.raw_pC,
            frame.charge_pC,
            self._tare_stage.tare,
            frame.touch.contact,
            tuple(frame.flags),
            frame.charge_scale_std,
        )

    def reset_tare(self) -> None:
        """Measure the tare again from the next quiet frames. The estimate of the hum is kept."""
        for stage in self.stages:
            stage.reset()


def _leak_or_memory_stage(settings: Chain) -> LeakStage | MemoryStage | None:
    """Return the stage that corrects the leak of the amplifiers, or the leak and the memory of the film together.

    The memory of the film (creep and the thermoelastic step) is only corrected if the settings describe it.

    Args:
        settings: Settings of all stages.

    Returns:
        The stage; None if the settings describe neither a leak nor a memory.
    """
    if settings.memory is not None:  # the memory stage also corrects the leak
        return MemoryStage(settings.memory, settings.leak, settings.tau_s)
    if settings.tau_s is not None:
        return LeakStage(settings.leak, settings.tau_s)
    return None
