"""The interface of a stage of the signal chain, and the frame that passes through the stages."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import NamedTuple

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.contact import NO_TOUCH, Touch
from isocharge.serve.signal_chain.tare import Tare


@dataclass(slots=True)
class ChainFrame:
    """A frame of the signal chain. The stages change it in place.

    Attributes:
        values: Values as the device sent them, in the unit of the device, shape (electrodes,).
        t_s: Time on the clock of the device, s.
        dt_s: Time since the previous frame, s.
        is_at_limit: Whether an amplifier is at its limit.
        was_contact: Whether something touched in the previous frame.
        flags: Flags of `isocharge.serve.flags`, in the order in which the stages add them.
        raw_pC: Charges as the device sent them, shape (electrodes,), pC.
        charge_pC: Charges after the stages that have processed the frame, shape (electrodes,), pC.
        tare: The tare that was subtracted; None while there is none.
        is_finished: Whether the later stages skip the frame, because there is no tare yet.
        charge_scale_std: Relative standard deviation that all charges have in common, because the film's memory is not
            known exactly.
        touch: State of the touch detection after this frame. The touch stage sets it.
        base_relax_s: Time constant with which the charge out of contact decays to zero, s.
        is_base_held: Whether a finger is touching or leaving the film. A positive base of the touch detection then does
            not decay.
        is_saturated: Whether an amplifier was at its limit at any time in this press.
    """

    values: Array
    t_s: float
    dt_s: float
    is_at_limit: bool
    was_contact: bool
    flags: list[str]
    raw_pC: Array = field(init=False)
    charge_pC: Array = field(init=False)
    tare: Tare | None = None
    is_finished: bool = False
    charge_scale_std: float = 0.0
    touch: Touch = NO_TOUCH
    base_relax_s: float = math.inf
    is_base_held: bool = False
    is_saturated: bool = False

    def __post_init__(self) -> None:
        self.raw_pC = self.values
        self.charge_pC = self.values

    @property
    def noise_pC(self) -> Array:
        """Standard deviation of each electrode at rest, shape (electrodes,), pC. It requires a tare."""
        assert self.tare is not None
        return self.tare.noise_pC


class Stage(ABC):
    """One stage of the signal chain. The object contains the settings and the state of the stage."""

    @abstractmethod
    def step(self, frame: ChainFrame) -> None:
        """Process the next frame in place."""

    def reset(self) -> None:  # noqa: B027  # most stages have no state
        """Discard the state that depends on the tare, because the film is tared again."""

    def begin_touch(self, frame: ChainFrame) -> None:  # noqa: B027  # most stages do nothing
        """Change the state and the frame for a touch that begins with this frame. The touch stage calls this method."""


class OffsetStage(Stage):
    """A stage that stores the charge at rest. The touch charge is measured relative to the charge at rest."""

    @abstractmethod
    def add_warming(self, change: "WarmingChange") -> None:
        """Assign a part of the touch charge to the warming of the film."""


class WarmingChange(NamedTuple):
    """A change of the estimated warming.

    Attributes:
        charge_pC: Part of the touch charge that is warming, shape (electrodes,), pC.
        rate_pC_per_s: Change of the slope of the warming, shape (electrodes,), pC/s.
        is_learned: Whether the properties of the film may be learned after this touch.
    """

    charge_pC: Array | float
    rate_pC_per_s: Array | float
    is_learned: bool
