"""The signal chain: from what a board counts to touch charges and whether something touches.

Each stage is a rule (frozen settings) and a pure function; `advance` puts them in order and carries their state. A
stage whose rule is None is switched off.

1. gain: the device's unit to pC, offset, sign and gain of each channel;
2. saturation: a charge at the converter's limit, flagged until the press is over;
3. hum: mains hum, followed and subtracted (`isocharge.serve.signal_chain.hum`);
4. tare: mean and noise of quiet frames, subtracted from everything after (`isocharge.serve.signal_chain.tare`);
5. leak: the amplifier's decay undone, its offset learned (`isocharge.serve.signal_chain.leak`); with it, where the
   film's memory is known, creep, the thermoelastic step and warmth (`isocharge.serve.signal_chain.memory`);
6. touch: contact with hysteresis (`isocharge.serve.signal_chain.contact`);
7. thermal: the common charge of a warming film, estimated with the model and subtracted
   (`isocharge.serve.signal_chain.thermal`).

A frame with a value that cannot be a charge passes none of them; its time counts as part of the next frame's.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import BLIND, INVALID, NEGATIVE, SATURATED, TARE, THERMAL
from isocharge.serve.signal_chain.contact import Touch, TouchRule, update_contact
from isocharge.serve.signal_chain.hum import Hum, HumRule, remove_hum
from isocharge.serve.signal_chain.leak import Leak, LeakRule, undo_leak
from isocharge.serve.signal_chain.memory import Memory, MemoryRule, begin_touch, doubt, undo_memory, warmer
from isocharge.serve.signal_chain.tare import Tare, TareRule, look_for_tare
from isocharge.serve.signal_chain.thermal import NO_DRIFT, Misfit, ThermalDrift, ThermalRule, track_thermal_drift

LARGEST_PC = 1e9
"""Largest charge of a valid reading, pC: sums of such charges are exact to 1e-7 pC in double precision."""


@dataclass(frozen=True, slots=True)
class Chain:
    """The rules of all stages, in their order; None switches a stage off.

    Attributes:
        gain_pC: Charge per unit of the device, with sign, shape (electrodes,), pC.
        zero: What the device shows without charge, shape (electrodes,), in its unit.
        limit_pC: Largest charge that the converter can show, pC.
        hum: How mains hum is followed.
        tare: Which frames are quiet enough for a tare.
        tau_s: Time constant of each amplifier, shape (electrodes,), s; None where charges do not leak.
        leak: How the amplifiers' offset is learned.
        memory: What a held press does to the film's charges.
        touch: When something touches; without it, every tared frame is in contact.
        thermal: How warming of the film is followed.
        pyro: Charge of each electrode over the mean magnitude of all when the film warms, shape (electrodes,),
            dimensionless; 1.0 where all are alike.
        largest: Largest value of a valid reading, in the device's unit.
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
    pyro: Array | float = 1.0
    largest: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        steepest_pC = 1.0 if self.gain_pC is None else float(np.abs(self.gain_pC).max())
        object.__setattr__(self, "largest", LARGEST_PC / steepest_pC)

    def raw(self, values: Array) -> Array:
        """The first stage: what the device sent, shape (electrodes,), as charges, pC."""
        charges = values if self.zero is None else values - self.zero
        return charges if self.gain_pC is None else charges * self.gain_pC


class ChainState(NamedTuple):
    """What the chain remembers between frames.

    Attributes:
        waiting_pC: The latest charges while there is no tare, shape (k, electrodes), pC.
        hum: The hum that is subtracted.
        frames: Frames seen while looking for a tare.
        patient: Whether the search for a tare never gives up.
        tare: None until enough quiet frames have come.
        leak: Charge and inflow; None before the tare.
        memory: The film's memory, which has a leak of its own; None before the tare.
        touch: Contact and its thresholds.
        saturated: Whether a charge was at the limit in this press.
        drift: Warming in this press.
        invalid_s: Time covered by the invalid frames since the last valid one, s.
    """

    waiting_pC: Array
    hum: Hum
    frames: int = 0
    patient: bool = False
    tare: Tare | None = None
    leak: Leak | None = None
    memory: Memory | None = None
    touch: Touch = Touch()
    saturated: bool = False
    drift: ThermalDrift = NO_DRIFT
    invalid_s: float = 0.0

    @classmethod
    def start(cls, electrodes: int) -> "ChainState":
        """Before the first frame."""
        return cls(np.empty((0, electrodes)), Hum.start(electrodes))

    def without_tare(self) -> "ChainState":
        """The state in which the film is tared again, however long that takes; what is known about hum stays."""
        hum = self.hum._replace(raw_pC=None)
        return ChainState(self.waiting_pC[:0], hum, patient=True, invalid_s=self.invalid_s)


class Reading(NamedTuple):
    """One frame after the chain.

    Attributes:
        raw_pC: What the device sent, as charges, shape (electrodes,), pC.
        charge_pC: Touch charges, shape (electrodes,), pC; None while there is no tare, and of an invalid frame.
        tare: What was subtracted.
        contact: Whether something touches.
        flags: Words from `isocharge.serve.flags`: those that the frame had before the chain, and the chain's.
        doubt: Relative standard deviation of all touch charges together, for what is not known of the film's memory.
    """

    raw_pC: Array
    charge_pC: Array | None
    tare: Tare | None
    contact: bool
    flags: tuple[str, ...] = ()
    doubt: float = 0.0


def advance(
    chain: Chain,
    state: ChainState,
    values: Array,
    t_s: float,
    dt_s: float,
    *,
    limited: bool = False,
    misfit: Misfit | None = None,
    flags: tuple[str, ...] = (),
) -> tuple[ChainState, Reading]:
    """Take the next frame through all stages.

    Args:
        chain: The rules.
        state: After the frame before.
        values: As they came, in the device's unit, shape (electrodes,).
        t_s: The device's clock, s.
        dt_s: Since the frame before, s.
        limited: Whether the device says that an amplifier is at its limit.
        misfit: Of the model; the thermal stage needs it, the others do not.
        flags: Words that the frame has already, to which the chain adds its own.

    Raises:
        TareError: If the film is not left alone for long enough to tare.
        ValueError: If the chain has a thermal stage and no misfit is given.
    """
    if not math.hypot(*values.tolist()) <= chain.largest:
        return state._replace(invalid_s=state.invalid_s + dt_s), _invalid(chain, values, flags)
    dt_s += state.invalid_s
    raw_pC = chain.raw(values)
    limited = limited or (chain.limit_pC is not None and bool((np.abs(raw_pC) >= chain.limit_pC).any()))
    hum, quiet_pC = (state.hum, raw_pC) if chain.hum is None else remove_hum(chain.hum, state.hum, raw_pC, t_s, dt_s)
    if state.tare is None:
        untared = Reading(raw_pC, None, None, contact=False, flags=(*flags, TARE) + (SATURATED,) * limited)
        return _look_for_tare(chain, state, hum, quiet_pC), untared
    tare, output_pC = state.tare, quiet_pC - state.tare.charge_pC
    leak, memory, charge_pC = _charge(chain, state, tare, output_pC, dt_s)
    unknown = 0.0 if memory is None else doubt(memory)
    touch = _touch(chain, state, charge_pC, tare, dt_s, unknown)
    if chain.memory is not None and memory is not None and touch.contact and not state.touch.contact:
        memory = begin_touch(chain.memory, memory)
        charge_pC, unknown = memory.leak.charge_pC, doubt(memory)
    saturated = limited or (state.saturated and touch.contact)
    drift = NO_DRIFT
    if chain.thermal is not None and touch.contact:
        drift = _drift(chain, chain.thermal, state.drift, charge_pC, misfit, dt_s, saturated=saturated)
    told = chain.thermal is not None and abs(drift.charge_pC) >= chain.thermal.tell_pC
    if touch.contact and drift.charge_pC != state.drift.charge_pC:
        change_pC = (drift.charge_pC - state.drift.charge_pC) * chain.pyro
        charge_pC = charge_pC - change_pC
        if memory is not None:
            memory = warmer(memory, change_pC, drift.rate_pC_per_s * chain.pyro, learns=not told)
        elif leak is not None:
            leak = leak._replace(charge_pC=leak.charge_pC - change_pC)
        else:
            tare = tare._replace(charge_pC=tare.charge_pC + change_pC)
    after = ChainState(state.waiting_pC, hum, state.frames, state.patient, tare, leak, memory, touch, saturated, drift)
    flags += (SATURATED,) * saturated + (NEGATIVE,) * touch.below
    if not saturated:
        flags += (THERMAL,) * told + (BLIND,) * drift.blind
    return after, Reading(raw_pC, charge_pC, tare, touch.contact, flags, unknown)


def _invalid(chain: Chain, values: Array, flags: tuple[str, ...]) -> Reading:
    with np.errstate(over="ignore"):  # a value may be the largest number that a double holds
        return Reading(chain.raw(values), None, None, contact=False, flags=(*flags, INVALID))


def _look_for_tare(chain: Chain, state: ChainState, hum: Hum, quiet_pC: Array) -> ChainState:
    """Tare on the latest frames as soon as they are enough and quiet."""
    if chain.tare is None:
        nothing_pC = np.zeros_like(quiet_pC)
        return ChainState(state.waiting_pC, hum, tare=Tare(nothing_pC, nothing_pC, 0))
    waiting = np.vstack([state.waiting_pC, quiet_pC])[-chain.tare.frames :]
    frames = 0 if state.patient else state.frames + 1
    tare = look_for_tare(chain.tare, waiting, frames)
    return ChainState(waiting if tare is None else waiting[:0], hum, frames, state.patient, tare)


def _charge(
    chain: Chain, state: ChainState, tare: Tare, output_pC: Array, dt_s: float
) -> tuple[Leak | None, Memory | None, Array]:
    """Touch charges: the output above tare, its leak and the film's memory undone if there are any."""
    contact = state.touch.contact
    if chain.memory is not None:
        memory = state.memory
        if memory is None:
            memory = Memory.start(chain.memory, output_pC)
        else:
            rules = chain.memory, chain.leak, chain.tau_s
            memory = undo_memory(*rules, memory, output_pC, tare.noise_pC, dt_s, contact=contact)
        return None, memory, memory.leak.charge_pC
    if chain.tau_s is None:
        return None, None, output_pC
    leak = (
        Leak.start(output_pC)
        if state.leak is None
        else undo_leak(chain.leak, chain.tau_s, state.leak, output_pC, tare.noise_pC, dt_s, contact=contact)
    )
    return leak, None, leak.charge_pC


def _touch(chain: Chain, state: ChainState, charge_pC: Array, tare: Tare, dt_s: float, unknown: float) -> Touch:
    if chain.touch is None:
        return Touch(contact=True)
    relax_s = math.inf if chain.tau_s is None else chain.leak.relax_s
    if chain.memory is not None:
        leaves = state.memory is not None and state.memory.lingers and state.touch.base_pC > 0.0
        relax_s = math.inf if leaves else 0.5 * chain.memory.settle_s
    decay = math.exp(-dt_s / relax_s)
    return update_contact(chain.touch, state.touch, float(charge_pC.sum()), tare.noise_pC, decay, unknown)


def _drift(
    chain: Chain,
    rule: ThermalRule,
    drift: ThermalDrift,
    charge_pC: Array,
    misfit: Misfit | None,
    dt_s: float,
    *,
    saturated: bool,
) -> ThermalDrift:
    if misfit is None:
        raise ValueError("the thermal stage needs the misfit of a model, got None")
    if saturated:  # a clipped charge fits no contact, whatever the temperature
        return drift
    warmth_s = None if chain.memory is None else chain.memory.warmth_s
    return track_thermal_drift(rule, drift, charge_pC, misfit, dt_s, chain.pyro, warmth_s)
