"""The signal chain: from raw charges to touch charges and whether something touches.

Each stage is a rule (frozen settings) and a pure function; `advance` puts them in order and carries their state. So
far:

1. tare: mean and noise of the first frames in which nothing moves, subtracted from everything after;
2. contact: touch when the total charge stands out of the noise, release at a share of that press's own peak. An
   absolute release threshold would never release once the base has drifted.
"""

from dataclasses import dataclass, field

import numpy as np

from isocharge.errors import TareError
from isocharge.serve.arrays import Array
from isocharge.serve.flags import TARE


@dataclass(frozen=True, slots=True)
class TareRule:
    """When frames are good for taring.

    Attributes:
        frames: How many; 100 are 0.5 s at 200 Hz.
        noise_limit_pC: Largest standard deviation of a quiet electrode, pC. The reference noise is 1 pC.
        offset_limit_pC: Largest mean of an idle electrode, pC. A press of 0.05 N on a 25 um film gives more than this
            on the three electrodes' average; so does a larger one that is held still while we tare.
        patience: Frames after which looking for quiet ones is given up.
    """

    frames: int = 100
    noise_limit_pC: float = 5.0
    offset_limit_pC: float = 100.0
    patience: int = 2000


@dataclass(frozen=True, slots=True)
class TouchRule:
    """When something touches.

    The smallest press we care about, 0.05 N on a 25 um film, gives 340 pC in total; reference noise makes the touch
    threshold 20 pC. A press that falls from 2 N (4000 pC) to 0.05 N keeps 8 % of its peak.

    Attributes:
        sigmas: The total charge must rise by so many of its standard deviations,
        floor_pC: plus this, pC, to be a touch.
        release_share: Release threshold as a share of the press's peak, but at least half the rise of a touch.
    """

    sigmas: float = 6.0
    floor_pC: float = 10.0
    release_share: float = 0.05


@dataclass(frozen=True, slots=True)
class Chain:
    """The rules of all stages."""

    tare: TareRule = field(default_factory=TareRule)
    touch: TouchRule = field(default_factory=TouchRule)


@dataclass(frozen=True, slots=True)
class Tare:
    """Charge at rest: `charge_pC` (electrodes,) and its standard deviation `noise_pC` (electrodes,), from `frames`."""

    charge_pC: Array
    noise_pC: Array
    frames: int


@dataclass(frozen=True, slots=True)
class Touch:
    """Whether something touches.

    Attributes:
        contact: Whether it does.
        peak_pC: Largest total charge of this press so far, pC, that two frames in a row reached: a spike is no peak.
        last_pC: Total charge of the latest frame, pC.
        base_pC: Smallest total charge since the last release, pC: a drifted base must not count as the next touch.
    """

    contact: bool = False
    peak_pC: float = 0.0
    last_pC: float = 0.0
    base_pC: float = 0.0


@dataclass(frozen=True, slots=True)
class ChainState:
    """What the chain remembers between frames.

    Attributes:
        waiting_pC: The latest raw frames while there is no tare, shape (k, electrodes), pC.
        frames: Frames seen.
        tare: None until quiet frames were found.
        touch: Contact so far.
    """

    waiting_pC: Array
    frames: int = 0
    tare: Tare | None = None
    touch: Touch = field(default_factory=Touch)

    @classmethod
    def start(cls, electrodes: int) -> "ChainState":
        """Before the first frame."""
        return cls(np.empty((0, electrodes)))


@dataclass(frozen=True, slots=True)
class Reading:
    """One frame after the chain.

    Attributes:
        charge_pC: Touch charges, shape (electrodes,), pC; None while there is no tare.
        tare: What was subtracted.
        contact: Whether something touches.
        flags: Words from `isocharge.serve.flags`.
    """

    charge_pC: Array | None
    tare: Tare | None
    contact: bool
    flags: tuple[str, ...] = ()


def advance(chain: Chain, state: ChainState, raw_pC: Array) -> tuple[ChainState, Reading]:
    """Take the next frame through all stages.

    Args:
        chain: The rules.
        state: After the frame before.
        raw_pC: Charges as they came, shape (electrodes,), pC.

    Raises:
        TareError: If the film is not left alone for long enough to tare.
    """
    if state.tare is None:
        return _look_for_tare(chain.tare, state, raw_pC), Reading(None, None, contact=False, flags=(TARE,))
    charge_pC = raw_pC - state.tare.charge_pC
    touch = next_touch(chain.touch, state.touch, abs(float(charge_pC.sum())), state.tare.noise_pC)
    after = ChainState(state.waiting_pC, state.frames + 1, state.tare, touch)
    return after, Reading(charge_pC, state.tare, touch.contact)


def _look_for_tare(rule: TareRule, state: ChainState, raw_pC: Array) -> ChainState:
    """Tare on the latest frames as soon as they are enough and quiet."""
    waiting = np.vstack([state.waiting_pC, raw_pC])[-rule.frames :]
    frames = state.frames + 1
    if len(waiting) < rule.frames:
        return ChainState(waiting, frames)
    try:
        return ChainState(waiting[:0], frames, measure_tare(rule, waiting))
    except TareError:
        if frames >= rule.patience:
            raise
    return ChainState(waiting, frames)


def measure_tare(rule: TareRule, raw_pC: Array) -> Tare:
    """Mean and noise of frames with nothing on the film.

    Args:
        rule: What is quiet.
        raw_pC: Charges as they came, shape (n, electrodes), pC.

    Raises:
        TareError: If the film is touched: a charge varies, or rests far from zero.
    """
    tare = Tare(raw_pC.mean(axis=0), raw_pC.std(axis=0), len(raw_pC))
    noise, offset = float(tare.noise_pC.max()), float(np.abs(tare.charge_pC).max())
    if noise > rule.noise_limit_pC:
        raise TareError(
            f"cannot tare on the last {tare.frames} frames: the charge of an electrode varies by {noise:.3g} pC rms, "
            f"expected at most {rule.noise_limit_pC:g} pC; leave the film alone and start again"
        )
    if offset > rule.offset_limit_pC:
        raise TareError(
            f"cannot tare on the last {tare.frames} frames: an electrode rests at {offset:.4g} pC, expected at most "
            f"{rule.offset_limit_pC:g} pC; take off what lies on the film, or raise the limit if the amplifier "
            "rests there"
        )
    return tare


def next_touch(rule: TouchRule, touch: Touch, total_pC: float, noise_pC: Array) -> Touch:
    """Contact with hysteresis.

    Args:
        rule: The thresholds.
        touch: After the frame before.
        total_pC: Total touch charge of this frame, pC, positive.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
    """
    threshold = rule.floor_pC + rule.sigmas * float(np.sqrt(np.dot(noise_pC, noise_pC)))
    if touch.contact:
        peak = max(touch.peak_pC, min(total_pC, touch.last_pC))
        released = total_pC < max(rule.release_share * peak, 0.5 * threshold)
        return Touch(last_pC=total_pC, base_pC=total_pC) if released else Touch(True, peak, total_pC)
    if total_pC > touch.base_pC + threshold:
        return Touch(True, min(total_pC, touch.last_pC), total_pC)
    return Touch(last_pC=total_pC, base_pC=min(touch.base_pC, total_pC))
