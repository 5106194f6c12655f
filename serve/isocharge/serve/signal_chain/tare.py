"""Tare: the charge of each electrode at rest, mean and noise, from frames in which nothing moves."""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import TareError
from isocharge.serve.signal_chain.rule import Count, Rule, Setting


class TareRule(Rule, frozen=True, kw_only=True):
    """Which frames are quiet enough for a tare.

    Attributes:
        frames: Number of frames in a tare; 100 are 0.5 s at 200 Hz.
        noise_limit_pC: Largest standard deviation of a quiet electrode, pC. The reference noise is 1 pC.
        offset_limit_pC: Largest mean of an idle electrode, pC. Any press from 0.05 N on a 25 um film gives more on the
            average of three electrodes, also one that is held still during the tare.
        patience: Frames after which the search for quiet ones is given up; 0 for never.
    """

    frames: Count = 100
    noise_limit_pC: Setting = 5.0
    offset_limit_pC: Setting = 100.0
    patience: Count = 2000


class Tare(NamedTuple):
    """Charge at rest: `charge_pC` (electrodes,) and its standard deviation `noise_pC` (electrodes,), from `frames`."""

    charge_pC: Array
    noise_pC: Array
    frames: int


def look_for_tare(rule: TareRule, waiting_pC: Array, frames: int) -> Tare | None:
    """The tare of the latest frames, if they are enough and quiet.

    Args:
        rule: How many frames, and how quiet.
        waiting_pC: The latest frames, at most `rule.frames`, shape (k, electrodes), pC.
        frames: Frames seen during the search.

    Raises:
        TareError: If the search is given up.
    """
    if len(waiting_pC) < rule.frames:
        return None
    try:
        return measure_tare(rule, waiting_pC)
    except TareError:
        if rule.patience and frames >= rule.patience:
            raise
    return None


def measure_tare(rule: TareRule, raw_pC: Array) -> Tare:
    """Mean and noise of frames with nothing on the film.

    Args:
        rule: How quiet they must be.
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
