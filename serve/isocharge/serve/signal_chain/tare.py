"""Measurement of the tare in quiet frames.

The tare consists of the mean and the noise of the charge of each electrode. While nothing touches the film, the tare
follows a slow drift of the charge at rest.
"""

import math
from collections import deque
from typing import Annotated

import numpy as np
from msgspec import Meta, structs

from isocharge.common.arrays import Array
from isocharge.common.errors import TareError
from isocharge.common.toml_text import toml_key
from isocharge.serve.flags import TARE
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.stage import LARGEST, Count, Divisor, Rule, Setting, Setup, Stage


class TareRule(Rule, frozen=True, kw_only=True):
    """Conditions for the frames from which the tare is measured, from the section `[tare]` of a device file.

    Attributes:
        frames: Number of frames in a tare. At 200 Hz, 100 frames take 0.5 s.
        noise_limit_pC: Largest standard deviation of an electrode at rest, pC. The reference noise is 1 pC.
        offset_limit_pC: Largest magnitude of the mean charge of an electrode at rest, pC. A press of 0.05 N or more on
            a film of 25 um causes mean charges above the default limit on three electrodes. The tare therefore fails
            even if the press is held still. If the board sends currents, there is no limit, because a held press causes
            no current.
        patience: Number of frames after which the search for quiet frames ends with an error; 0 for no limit.
        relax_s: Time constant with which the tare follows a slow drift while nothing touches the film, s. The tare
            changes by at most `noise_limit_pC / relax_s`, so that a touch does not change the tare noticeably.
    """

    frames: Annotated[int, Meta(ge=1, le=LARGEST)] = 100
    noise_limit_pC: Setting = 5.0
    offset_limit_pC: Setting = 100.0
    patience: Count = 2000
    relax_s: Divisor = 2.0

    def unrest(self, mean_pC: Array, noise_pC: Array) -> str:
        """Return a text with the reason why some frames are not quiet; empty if nothing seems to touch the film.

        Args:
            mean_pC: Mean charge of each electrode in the frames, shape (n_electrode,), pC.
            noise_pC: Standard deviation of each charge, shape (n_electrode,), pC.
        """
        largest_noise_pC = noise_pC.max()
        if largest_noise_pC > self.noise_limit_pC:
            return (
                f"the charge of an electrode varies by {largest_noise_pC:.3g} pC rms, expected at most "
                f"{self.noise_limit_pC:g} pC; leave the film alone and start again; if nothing touches the film, look "
                "for hum and noise with `isocharge serve doctor`"
            )
        largest_offset_pC = np.abs(mean_pC).max()
        if largest_offset_pC > self.offset_limit_pC:
            return (
                f"an electrode rests at {largest_offset_pC:.4g} pC, expected at most {self.offset_limit_pC:g} pC; take "
                "off what lies on the film, or raise the limit if the amplifier rests there"
            )
        return ""


class Tare(Stage):
    """Measures the charge at rest in quiet frames, and subtracts this charge from all later frames.

    Without a later stage that estimates the drift, the tare follows a slow drift while nothing touches the film. The
    tare approaches the charge of each frame exponentially. The rate is limited, so that a finger that rests lightly on
    the film or is just arriving hardly changes the tare. The tare follows a frame only after the later stages have
    found that the frame has no contact. The first frame of a touch therefore does not change the tare.
    """

    section = "tare"
    is_required = True
    rule_class = TareRule
    is_default = True

    def __init__(self, setup: Setup) -> None:
        """Begin without a tare, the charges of the untouched film that are subtracted from all charges."""
        self._rule = setup.device.rule(TareRule)  # None if the device file switches the tare off
        if self._rule is not None and setup.device.has_currents:  # at rest, a current of any size is an offset
            self._rule = structs.replace(self._rule, offset_limit_pC=math.inf)
        self._electrodes = setup.electrodes
        # True if no later stage corrects the drift of the charge at rest and the warming, so the tare must follow them
        self._follows_drift = LeakRule not in setup.device.rules and not setup.device.has_currents
        self._tare_pC: Array | None = None  # charge at rest
        self._noise_pC = np.zeros(len(setup.electrodes))  # standard deviation of the charge at rest
        self._previous: Frame | None = None  # previous frame
        rule = self._rule or TareRule()  # without a tare, both numbers below have no effect
        self._latest_pC: deque[Array] = deque(maxlen=rule.frames)  # charges from which the tare is measured
        # Number of frames after which the search ends with an error; a patience of 0 means no limit
        self._remaining_frames = rule.patience or math.inf

    def step(self, frame: Frame) -> None:
        """Subtract the tare from a frame. Without a tare, search for one, and remove the charges from the frame.

        The tare is the charge of the untouched film. If the tare follows a drift, each frame changes the tare by the
        drift that the previous frame shows. Only of the previous frame is it known whether something touches the film,
        because the stages after this one detect a touch.

        Raises:
            TareError: If the film is touched during the whole search for a tare.
        """
        if frame.charge_pC is None:
            return
        if self._tare_pC is None:
            self._search(frame, frame.charge_pC)
            frame.charge_pC = None
            frame.flags.append(TARE)
            return
        if self._follows_drift:
            if self._previous is not None:
                self._tare_pC = self._tare_pC + self._tare_change_pC(self._previous)
            # The touch detection keeps a base, the charges that belong to no touch. The base decays as fast as the tare
            # takes over the charge at rest. A base that remains of the latest touch is held and does not decay, because
            # a finger that is leaving the film may still cause it. The touch detection applies `is_base_held` only to
            # such a base.
            frame.is_base_held = True
            if self._rule is not None:
                frame.base_relax_s = self._rule.relax_s
        self._previous = frame
        frame.tare_pC = self._tare_pC
        frame.noise_pC = self._noise_pC
        frame.charge_pC = frame.charge_pC - self._tare_pC

    def reset(self) -> None:
        """Measure the tare again from the next quiet frames.

        Unlike the first search for a tare, the new search does not end with an error.
        """
        self._tare_pC = None
        self._previous = None
        self._latest_pC.clear()
        self._remaining_frames = math.inf

    def _tare_change_pC(self, frame: Frame) -> Array | float:
        """Return the change of the tare after a frame, shape (n_electrode,) or one number, pC.

        While something touches the film, only the warming of the film changes the tare. The same applies if the tare is
        switched off. Otherwise, the film is at rest, and the tare approaches the charges of the frame with the time
        constant `relax_s`. These charges contain the warming. A large charge may be the beginning of a touch, and
        counts only up to `noise_limit_pC`.

        Args:
            frame: The frame, whose charges no longer contain the tare.
        """
        rule = self._rule
        if frame.is_contact or rule is None or frame.charge_pC is None:
            return frame.warming_pC
        limited_charge_pC = frame.charge_pC.clip(-rule.noise_limit_pC, rule.noise_limit_pC)
        approached_share = -math.expm1(-frame.dt_s / rule.relax_s)  # 1 - exp(-dt_s / relax_s)
        return approached_share * limited_charge_pC

    def _search(self, frame: Frame, charge_pC: Array) -> None:
        """Add a frame to the latest frames, and measure the tare if there are enough frames and they are quiet.

        The latest frames are at most `TareRule.frames`, and the oldest is forgotten. If the tare is switched off, the
        tare is 0.

        Args:
            frame: The frame.
            charge_pC: Charges of the frame, shape (n_electrode,), pC.

        Raises:
            TareError: If the frames are not quiet, and the search has lasted for `TareRule.patience` frames.
        """
        rule = self._rule
        if rule is None:
            self._tare_pC = np.zeros_like(charge_pC)
            return
        self._latest_pC.append(charge_pC)
        self._remaining_frames -= 1
        if len(self._latest_pC) < rule.frames:
            return
        latest_pC = np.array(self._latest_pC)  # shape (frames, n_electrode)
        mean_pC = latest_pC.mean(axis=0)
        noise_pC = latest_pC.std(axis=0)
        reason = rule.unrest(mean_pC, noise_pC)  # why the frames are not quiet; empty if they are
        if not reason:
            self._tare_pC = mean_pC
            self._noise_pC = noise_pC
        elif self._remaining_frames <= 0:
            raise self._search_error(reason, frame)

    def _search_error(self, reason: str, frame: Frame) -> TareError:
        """Return the error for a search without a result. The message contains the present values as settings.

        The search may have failed because the film is touched, or because the board has large offsets. If the board has
        large offsets, the present values are the offsets.

        Args:
            reason: Reason why the last frames were not quiet.
            frame: The last frame.
        """
        value_of_electrode = zip(self._electrodes, frame.sent.tolist(), strict=True)
        offsets = ", ".join(f"{toml_key(name)} = {value:.10g}" for name, value in value_of_electrode)
        return TareError(
            f"cannot tare on the last {len(self._latest_pC)} frames: {reason}; if the board rests there without a "
            f"touch, add to the section [gain] of a device file, below pC_per_unit: offset = {{{offsets}}}"
        )
