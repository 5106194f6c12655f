"""Measurement of the tare in quiet frames.

The tare consists of the mean and the noise of the charge of each electrode. While nothing touches the film, the tare
follows a slow drift of the charge at rest.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import TareError
from isocharge.common.structs import WrongKey
from isocharge.serve.signal_chain.rule import Count, Rule, Setting, TimeConstant


class TareRule(Rule, frozen=True, kw_only=True):
    """Conditions for the frames from which the tare is measured, from the section `[tare]` of a device file.

    Attributes:
        frames: Number of frames in a tare; 100 are 0.5 s at 200 Hz.
        noise_limit_pC: Largest standard deviation of an electrode at rest, pC. The reference noise is 1 pC.
        offset_limit_pC: Largest magnitude of the mean charge of an electrode at rest, pC. Under a press of 0.05 N or
            more on a film of 25 um, the mean charge of three electrodes is larger. The tare therefore fails even if the
            press is held still.
        patience: Number of frames after which the search for quiet frames ends with an error; 0 for no limit.
        relax_s: Time constant with which the tare follows a slow drift while nothing touches the film, s. The tare
            changes by at most `noise_limit_pC / relax_s`, so that a touch does not change it noticeably.
    """

    frames: Count = 100
    noise_limit_pC: Setting = 5.0
    offset_limit_pC: Setting = 100.0
    patience: Count = 2000
    relax_s: TimeConstant = 2.0

    def __post_init__(self) -> None:
        """Check that the search can find enough frames.

        Raises:
            WrongKey: If the search would end before it has the frames of a tare.
        """
        if 0 < self.patience < self.frames:
            raise WrongKey("patience", f"at least the {self.frames} frames of a tare, or 0 for no limit", self.patience)


class Tare(NamedTuple):
    """The charge at rest.

    Attributes:
        charge_pC: Mean charge, shape (electrodes,), pC.
        noise_pC: Standard deviation of the charge, shape (electrodes,), pC.
        frames: Number of frames from which the tare was measured.
    """

    charge_pC: Array
    noise_pC: Array
    frames: int


def look_for_tare(rule: TareRule, latest_pC: Array, searched_frames: int) -> Tare | None:
    """Measure the tare, which is the charge at rest, from the latest frames if these frames are quiet.

    Args:
        rule: Number of frames that a tare needs, limits of their noise and offset, and `patience`, the number of frames
            after which the search ends with an error (0 for a search without end).
        latest_pC: Charges of the latest frames, at most `rule.frames`, shape (k, electrodes), pC.
        searched_frames: Number of frames since the search began.

    Returns:
        The tare; None if there are too few frames, or the frames are not quiet.

    Raises:
        TareError: If the frames are not quiet, and the search has lasted for `rule.patience` frames.
    """
    if len(latest_pC) < rule.frames:
        return None
    try:
        return measure_tare(rule, latest_pC)
    except TareError:
        has_time_limit = rule.patience > 0
        if has_time_limit and searched_frames >= rule.patience:
            raise
        return None  # search again with the next frame


def measure_tare(rule: TareRule, raw_pC: Array) -> Tare:
    """Measure the tare: the mean and the noise of each electrode in frames in which nothing touches the film.

    Args:
        rule: Limits of noise and offset of quiet frames.
        raw_pC: Charges of the frames, shape (n, electrodes), pC.

    Raises:
        TareError: If the noise of an electrode or the magnitude of its mean charge exceeds the limit. Something then
            touches the film.
    """
    tare = Tare(charge_pC=raw_pC.mean(axis=0), noise_pC=raw_pC.std(axis=0), frames=len(raw_pC))
    largest_noise_pC = float(tare.noise_pC.max())
    largest_offset_pC = float(np.abs(tare.charge_pC).max())
    if largest_noise_pC > rule.noise_limit_pC:
        raise TareError(
            f"cannot tare on the last {tare.frames} frames: the charge of an electrode varies by "
            f"{largest_noise_pC:.3g} pC rms, expected at most {rule.noise_limit_pC:g} pC; leave the film alone and "
            "start again"
        )
    if largest_offset_pC > rule.offset_limit_pC:
        raise TareError(
            f"cannot tare on the last {tare.frames} frames: an electrode rests at {largest_offset_pC:.4g} pC, expected "
            f"at most {rule.offset_limit_pC:g} pC; take off what lies on the film, or raise the limit if the amplifier "
            "rests there"
        )
    return tare


def follow_drift(rule: TareRule, tare: Tare, charge_pC: Array, dt_s: float) -> Tare:
    """Return the tare after a frame in which nothing touches the film.

    The tare approaches the charge of the frame exponentially. Its rate is limited, so that a finger that rests lightly
    on the film or is just arriving hardly changes it.

    Args:
        rule: Time constant, and the limit of the difference between the charge and the tare.
        tare: The tare before the frame.
        charge_pC: Charges of the frame, shape (electrodes,), pC.
        dt_s: Time since the previous frame, s.
    """
    limit_pC = rule.noise_limit_pC
    difference_pC = np.minimum(np.maximum(charge_pC - tare.charge_pC, -limit_pC), limit_pC)
    share = -math.expm1(-dt_s / rule.relax_s)
    return tare._replace(charge_pC=tare.charge_pC + share * difference_pC)
