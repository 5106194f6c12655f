"""The signal chain: from what a board counts to touch charges and whether something touches.

Each stage is a rule (frozen settings) and a pure function; `advance` puts them in order and carries their state. A
stage whose rule is None is switched off.

1. gain: the device's unit to pC, sign and gain of each channel;
2. saturation: a charge at the converter's limit, flagged until the press is over;
3. hum: mains hum, followed and subtracted (`isocharge.serve.signal_chain.hum`);
4. tare: mean and noise of quiet frames, subtracted from everything after (`isocharge.serve.signal_chain.tare`);
5. leak: the amplifier's forgetting undone, its offset learned (`isocharge.serve.signal_chain.leak`);
6. touch: contact with hysteresis (`isocharge.serve.signal_chain.contact`).
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from isocharge.arrays import Array
from isocharge.serve.flags import NEGATIVE, SATURATED, TARE
from isocharge.serve.signal_chain.contact import Touch, TouchRule, update_contact
from isocharge.serve.signal_chain.hum import Hum, HumRule, remove_hum
from isocharge.serve.signal_chain.leak import Leak, LeakRule, undo_leak
from isocharge.serve.signal_chain.tare import Tare, TareRule, look_for_tare

LARGEST_PC = 1e9
"""A larger charge is no reading, finite or not: a chain that sums it loses no digit that counts (1e-7 pC)."""


@dataclass(frozen=True, slots=True)
class Chain:
    """The rules of all stages, in their order; None switches a stage off.

    Attributes:
        gain_pC: What one unit of the device is, with sign, shape (electrodes,), pC.
        limit_pC: Largest charge that the converter can show, pC.
        hum: How mains hum is followed.
        tare: When frames are good for taring.
        leak: The amplifier.
        touch: When something touches; without, everything does.
    """

    gain_pC: Array | None = None
    limit_pC: float | None = None
    hum: HumRule | None = None
    tare: TareRule | None = field(default_factory=TareRule)
    leak: LeakRule | None = None
    touch: TouchRule | None = field(default_factory=TouchRule)

    def raw(self, values: Array) -> Array:
        """The first stage: what the device sent, shape (electrodes,), as charges, pC."""
        return values if self.gain_pC is None else values * self.gain_pC

    @property
    def largest(self) -> float:
        """The largest value that can be a reading, in the device's unit."""
        return LARGEST_PC if self.gain_pC is None else LARGEST_PC / float(np.abs(self.gain_pC).max())


@dataclass(frozen=True, slots=True)
class ChainState:
    """What the chain remembers between frames.

    Attributes:
        waiting_pC: The latest charges while there is no tare, shape (k, electrodes), pC.
        frames: Frames seen while looking for a tare.
        patient: Whether looking for it is never given up.
        tare: None until quiet frames were found.
        hum, leak, touch: Of the stages; no leak before the tare.
        saturated: Whether a charge was at the limit in this press.
    """

    waiting_pC: Array
    hum: Hum
    frames: int = 0
    patient: bool = False
    tare: Tare | None = None
    leak: Leak | None = None
    touch: Touch = field(default_factory=Touch)
    saturated: bool = False

    @classmethod
    def start(cls, electrodes: int) -> "ChainState":
        """Before the first frame."""
        return cls(np.empty((0, electrodes)), Hum.start(electrodes))

    def without_tare(self) -> "ChainState":
        """The film is tared anew, however long that takes; what is known about hum stays."""
        return ChainState(self.waiting_pC[:0], replace(self.hum, raw_pC=None), patient=True)

    def shifted(self, charge_pC: float) -> "ChainState":
        """The same charge taken from every electrode from here on: by the leak's charge, or by the tare."""
        if self.leak is not None:
            return replace(self, leak=self.leak._replace(charge_pC=self.leak.charge_pC - charge_pC))
        assert self.tare is not None
        return replace(self, tare=replace(self.tare, charge_pC=self.tare.charge_pC + charge_pC))


@dataclass(frozen=True, slots=True)
class Reading:
    """One frame after the chain.

    Attributes:
        raw_pC: What the device sent, as charges, shape (electrodes,), pC.
        charge_pC: Touch charges, shape (electrodes,), pC; None while there is no tare.
        tare: What was subtracted.
        contact: Whether something touches.
        flags: Words from `isocharge.serve.flags`.
    """

    raw_pC: Array
    charge_pC: Array | None
    tare: Tare | None
    contact: bool
    flags: tuple[str, ...] = ()


def advance(
    chain: Chain, state: ChainState, values: Array, t_s: float, dt_s: float, *, limited: bool = False
) -> tuple[ChainState, Reading]:
    """Take the next frame through all stages.

    Args:
        chain: The rules.
        state: After the frame before.
        values: As they came, in the device's unit, shape (electrodes,).
        t_s: The device's clock, s.
        dt_s: Since the frame before, s.
        limited: Whether the device says that an amplifier is at its limit.

    Raises:
        TareError: If the film is not left alone for long enough to tare.
    """
    raw_pC = chain.raw(values)
    limited = limited or (chain.limit_pC is not None and bool((np.abs(raw_pC) >= chain.limit_pC).any()))
    hum, quiet_pC = (state.hum, raw_pC) if chain.hum is None else remove_hum(chain.hum, state.hum, raw_pC, t_s, dt_s)
    if state.tare is None:
        return _look_for_tare(chain, state, hum, quiet_pC), _untared(raw_pC, limited)
    output_pC = quiet_pC - state.tare.charge_pC
    leak, charge_pC = _charge(chain, state, state.tare, output_pC, dt_s)
    touch = _touch(chain, state, charge_pC, state.tare, dt_s)
    saturated = limited or (state.saturated and touch.contact)
    after = ChainState(state.waiting_pC, hum, state.frames, state.patient, state.tare, leak, touch, saturated)
    flags = (SATURATED,) * saturated + (NEGATIVE,) * touch.below
    return after, Reading(raw_pC, charge_pC, state.tare, touch.contact, flags)


def _untared(raw_pC: Array, limited: bool) -> Reading:
    return Reading(raw_pC, None, None, contact=False, flags=(TARE, SATURATED) if limited else (TARE,))


def _look_for_tare(chain: Chain, state: ChainState, hum: Hum, quiet_pC: Array) -> ChainState:
    """Tare on the latest frames as soon as they are enough and quiet."""
    if chain.tare is None:
        return ChainState(state.waiting_pC, hum, tare=Tare.none(quiet_pC.size))
    waiting = np.vstack([state.waiting_pC, quiet_pC])[-chain.tare.frames :]
    frames = 0 if state.patient else state.frames + 1
    tare = look_for_tare(chain.tare, waiting, frames)
    return ChainState(waiting if tare is None else waiting[:0], hum, frames, state.patient, tare)


def _charge(chain: Chain, state: ChainState, tare: Tare, output_pC: Array, dt_s: float) -> tuple[Leak | None, Array]:
    """Touch charges: the output above tare, its leak undone if there is one."""
    if chain.leak is None:
        return None, output_pC
    if state.leak is None:
        leak = Leak.start(output_pC)
    else:
        leak = undo_leak(chain.leak, state.leak, output_pC, tare.noise_pC, dt_s, contact=state.touch.contact)
    return leak, leak.charge_pC


def _touch(chain: Chain, state: ChainState, charge_pC: Array, tare: Tare, dt_s: float) -> Touch:
    if chain.touch is None:
        return Touch(contact=True)
    keep = 1.0 if chain.leak is None else math.exp(-dt_s / chain.leak.relax_s)
    return update_contact(chain.touch, state.touch, float(charge_pC.sum()), tare.noise_pC, keep)
