"""Detection and measurement of presses that are held still.

The charges of a press are examined in a time window. The press is steady if the scatter and the drift of each charge in
the window are small. The charge of a press is the mean charge in the window minus the mean charge at rest just before
the touch. A slow drift of the amplifiers or of the film's temperature therefore does not affect the measured charge. A
press is refused if it saturates an amplifier, moves, changes its force or ends too early. The reason for the refusal is
returned.
"""

import math
from collections import deque
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import RECONNECTED, RESTART, SATURATED, TARE
from isocharge.serve.frames.frame import Frame
from isocharge.serve.record.record import flags_in_order

PORT_LOST = "the port was lost or the board was restarted: do not touch the film until it is tared"
"""Reason for which a press is refused after an interruption."""

NO_REST_BEFORE_PRESS = (
    "pressed too soon after the last touch: do not touch the film for half a second before a press; if that does not "
    "help, the amplifier leaks: state its time constant in the section [leak] of a device file"
)
"""Reason for which a press is refused if the film was not at rest before the press."""


class Phase(StrEnum):
    """State of a `PressWatch`, or result of its latest reading.

    Attributes:
        taring: The watch waits until the charge of the untouched film has been measured.
        lift: The watch waits until the finger leaves the film.
        waiting: The watch waits for a touch.
        settling: The watch waits until the present press is steady.
        taken: The present press was accepted with the latest reading.
        refused: The present press was refused with the latest reading.
    """

    taring = "taring"
    lift = "lift"
    waiting = "waiting"
    settling = "settling"
    taken = "taken"
    refused = "refused"


class SteadyPress(NamedTuple):
    """Charges of a press that was held still, measured in a time window.

    Attributes:
        charge_pC: Mean touch charges over the window, shape (n_electrode,), pC.
        held_s: Time from the touch to the end of the window, s.
        flags: Flags of `isocharge.serve.flags` that at least one frame in the window has.
    """

    charge_pC: Array
    held_s: float
    flags: tuple[str, ...] = ()


class WatchResult(NamedTuple):
    """Result that a `PressWatch` returns for one reading.

    Attributes:
        phase: What the watch waits for. The phase is `taken` or `refused` only for the reading with which a press was
            accepted or refused.
        reason: Reason why the press is refused or is not steady yet, as a part of a sentence.
        press: The accepted press if the phase is `taken`, and otherwise None.
    """

    phase: Phase
    reason: str = ""
    press: SteadyPress | None = None


class PressWatch:
    """Finds one steady press in each touch. Each object may be used by only one thread."""

    REST_S = 0.3
    """Duration of the rest before a touch over which the charges at rest are averaged, s."""

    EDGE_S = 0.05
    """Time just before and just after a press that does not count as rest, s.

    The probe may already or still touch the film during this time.
    """

    WINDOW_S = 0.5
    """Length of the window, s. If frames are rare, the window is longer and contains `MIN_FRAMES` frames."""

    MIN_FRAMES = 20
    """Smallest number of frames in a window."""

    MAX_HELD_S = 8.0
    """Time since the touch after which an unsteady press is refused, s. A longer press would have a
    larger error of the leak correction."""

    CHECK_INTERVAL_S = 0.05
    """Time between examinations of the window, s. An examination at every frame would take too long."""

    MIN_REST_FRAMES = 3
    """Smallest number of frames at rest that must precede a press."""

    MIN_HELD_S = 0.1
    """Shortest duration of a press, s. Shorter touches are ignored."""

    MAX_SCATTER_SIGMAS = 3.0
    """Largest scatter of a charge about a straight line, in standard deviations of its noise."""

    RELATIVE_NOISE = 0.007
    """Standard deviation of the additional noise of a press, relative to its charge. The force of a hand varies."""

    MAX_RELATIVE_DRIFT = 0.005
    """Largest drift of a charge over the window, relative to its magnitude or the mean magnitude of all charges.

    The larger of the two magnitudes is used. A drift of this size changes the position by about 0.05 mm.
    """

    DRIFT_SIGMAS = 4.0
    """Number of standard errors of the drift by which the drift may exceed `MAX_RELATIVE_DRIFT`."""

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Create a watch that waits for the tare, which is the charge of the untouched film.

        Args:
            electrodes: Names of the electrodes, which are used in the reasons why presses are refused.
        """
        self._electrodes = electrodes
        self._frames: deque[Frame] = deque()  # the latest frames without touch, or the window of the present press
        self._reset()

    def _reset(self) -> None:
        """Discard the present press and all stored frames, and wait for the tare.

        The latest press counts as infinitely long ago, so that all later frames without touch are frames at rest.
        """
        self._begin_press(-math.inf)
        self._phase = Phase.taring

    def _begin_press(self, begin_s: float) -> None:
        """Begin a press: measure the charges at rest before the press, and begin an empty window.

        Args:
            begin_s: Time of the first frame of the press, s.
        """
        self._press_begin_s = begin_s
        self._press_end_s = begin_s  # time of the latest frame of the press
        # Until now, `_frames` contains the latest frames without touch. From now on, it contains the window.
        rest_charges_pC = [frame.charge_pC for frame in self._frames if frame.clock_s <= begin_s - self.EDGE_S]
        self._rest_pC: Array | None = None  # mean charges just before the touch; None without enough frames
        if len(rest_charges_pC) >= self.MIN_REST_FRAMES:
            self._rest_pC = np.array(rest_charges_pC).mean(axis=0)
        self._frames.clear()
        self._last_check_s = begin_s  # time at which the window was last examined
        self._unsteady_reason = ""  # why the press is not steady yet; empty before the first examined window
        self._min_scatter_pC = math.inf  # smallest scatter of all windows

    def arm(self) -> None:
        """Ignore the present press if there is one, and wait for the next press."""
        if self._phase is Phase.settling:
            self._phase = Phase.lift

    def feed(self, frame: Frame) -> WatchResult:
        """Process the next reading, and return the phase of the watch.

        The first phase is `taring`, which ends when the charge of the untouched film has been measured. The phase
        `waiting` follows until a touch begins. The phase `settling` follows until the press is accepted or refused. The
        phase `lift` follows until the finger leaves the film. The phase `waiting` then begins again.

        The result for the reading with which a press is accepted or refused has the phase `taken` or `refused`. The
        watch itself has then already begun the next phase, with which the next reading continues.

        The charges at rest before a press are measured in a period of the length `REST_S`, which ends `EDGE_S` before
        the touch is detected.

        Args:
            frame: The frame, after the stages of a `ReadingStream`.

        Returns:
            The phase and, if a press is refused or not steady yet, the reason. The result contains an accepted press
            only for the reading with which the press was accepted.
        """
        if RECONNECTED in frame.flags or RESTART in frame.flags:
            # The charges and times before the interruption cannot be compared with later ones. A press is refused, and
            # the watch waits for a new tare.
            self._reset()
            return WatchResult(Phase.refused, PORT_LOST)
        if frame.charge_pC is None:  # there is no tare yet, or the frame is invalid
            if TARE in frame.flags:  # the tare is being measured
                self._phase = Phase.taring
            return WatchResult(self._phase)
        if not frame.is_contact:
            return self._process_rest(frame)  # also ends the phases `settling` and `lift`
        if self._phase is Phase.lift:  # the press of this touch was accepted or refused before
            return WatchResult(Phase.lift)
        if self._phase is not Phase.settling:  # the touch begins with this frame
            self._begin_press(frame.clock_s)
            self._phase = Phase.settling
        result = self._process_press(frame)
        if result.phase is not Phase.settling:
            self._phase = Phase.lift
        return result

    def _process_press(self, frame: Frame) -> WatchResult:
        """Add the next frame to the window, and accept or refuse the press if this can be decided.

        The press is accepted if it is steady. The press is refused if an amplifier is saturated, if the film was not at
        rest before the press, or if the press is not steady within `MAX_HELD_S`. Until then, the phase is `settling`.
        """
        self._press_end_s = frame.clock_s
        held_s = self._press_end_s - self._press_begin_s
        if SATURATED in frame.flags:
            return WatchResult(Phase.refused, "an amplifier is at its limit: press less hard")
        if self._rest_pC is None:  # the film was not at rest before
            if held_s < self.MIN_HELD_S:  # the touch may end so soon that it is ignored
                return WatchResult(Phase.settling)
            return WatchResult(Phase.refused, NO_REST_BEFORE_PRESS)
        self._store(frame, self.WINDOW_S, self.MIN_FRAMES)

        is_window_full = held_s >= self.WINDOW_S and len(self._frames) >= self.MIN_FRAMES
        if is_window_full and self._press_end_s - self._last_check_s >= self.CHECK_INTERVAL_S:
            self._last_check_s = self._press_end_s
            press = self._examine_window(self._rest_pC, frame.noise_pC)  # None if unsteady; sets `_unsteady_reason`
            if press is not None:
                return WatchResult(Phase.taken, press=press)
        if held_s > self.MAX_HELD_S:
            reason = self._unsteady_reason or "too few frames come"
            return WatchResult(Phase.refused, f"not steady within {self.MAX_HELD_S:g} s: {reason}")
        return WatchResult(Phase.settling, self._unsteady_reason)

    def _examine_window(self, rest_pC: Array, noise_pC: Array) -> SteadyPress | None:
        """Return the press in the window if the press is steady. Otherwise, return None and store the reason.

        A straight line is fitted to each charge in the window. The scatter of a charge is the standard deviation of its
        residuals from the line. The drift of a charge is the change of its line from the beginning to the end of the
        window. The charges scatter because of the noise at rest, and because a hand varies its force.

        The stored reason belongs to the window with the smallest scatter. The reason from a window with a sudden
        movement, such as the release, would describe only this movement.

        Args:
            rest_pC: Mean charges just before the touch, shape (n_electrode,), pC.
            noise_pC: Standard deviation of each charge at rest, shape (n_electrode,), pC.
        """
        times_s = np.array([frame.clock_s for frame in self._frames])
        charge_pC = np.array([frame.charge_pC for frame in self._frames]) - rest_pC  # shape (frames, n_electrode)

        # The line is fitted by least squares. Its value at the mean time of the frames is the mean charge.
        centred_s = times_s - times_s.mean()
        square_sum_s2 = max(centred_s @ centred_s, 1e-30)  # avoids a division by 0 if all times are equal
        slope_pC_per_s = centred_s @ charge_pC / square_sum_s2
        mean_pC = charge_pC.mean(axis=0)
        scatter_pC = (charge_pC - mean_pC - np.outer(centred_s, slope_pC_per_s)).std(axis=0)
        drift_pC = np.abs(slope_pC_per_s) * (times_s[-1] - times_s[0])

        # Divide the drift by its limit. A charge that is smaller than the mean magnitude may change as much as a charge
        # of the mean magnitude.
        magnitude_pC = np.abs(mean_pC)
        reference_pC = np.maximum(magnitude_pC, magnitude_pC.mean())
        # Because of the scatter, the change of a line through n values has the standard deviation sqrt(12 / n) times
        # that of one value.
        drift_std_pC = scatter_pC * math.sqrt(12.0 / len(times_s))
        max_drift_pC = self.MAX_RELATIVE_DRIFT * reference_pC + self.DRIFT_SIGMAS * drift_std_pC
        relative_drift = drift_pC / max_drift_pC

        # Divide the scatter by its limit.
        hand_noise_pC = self.RELATIVE_NOISE * magnitude_pC.mean()
        max_scatter_pC = self.MAX_SCATTER_SIGMAS * np.hypot(noise_pC, hand_noise_pC)
        relative_scatter = scatter_pC / max_scatter_pC

        # If a charge exceeds a limit, state the reason why the press is not steady. Otherwise, return the press.
        worst_scatter = relative_scatter.argmax()  # index of the electrode with the largest relative scatter
        worst_drift = relative_drift.argmax()  # index of the electrode with the largest relative drift
        if relative_scatter[worst_scatter] > 1.0:
            reason = f"the charge of {self._electrodes[worst_scatter]} shakes by {scatter_pC[worst_scatter]:.2g} pC"
        elif relative_drift[worst_drift] > 1.0:
            reason = (
                f"the charge of {self._electrodes[worst_drift]} changes by {slope_pC_per_s[worst_drift]:.2g} pC per "
                f"second from {mean_pC[worst_drift]:.3g} pC: hold place and force still; if it also changes under a "
                "weight, measure the leak of the amplifiers with isocharge serve doctor"
            )
        else:
            flags = flags_in_order(flag for frame in self._frames for flag in frame.flags)
            return SteadyPress(mean_pC, self._press_end_s - self._press_begin_s, flags)

        # Store the reason, but keep the reason from an earlier window with a smaller scatter.
        if scatter_pC.max() <= self._min_scatter_pC:
            self._min_scatter_pC = scatter_pC.max()
            self._unsteady_reason = reason
        return None

    def _store(self, frame: Frame, kept_s: float, min_count: int = 1) -> None:
        """Store a frame, and discard the frames that are older than `kept_s`, except the latest `min_count`."""
        self._frames.append(frame)
        while len(self._frames) > min_count and self._frames[0].clock_s < frame.clock_s - kept_s:
            self._frames.popleft()

    def _process_rest(self, frame: Frame) -> WatchResult:
        """Store a frame in which nothing touches the film, and refuse a press that has ended without becoming steady.

        Frames within `EDGE_S` after a press are not stored. A touch shorter than `MIN_HELD_S` is ignored. In each case,
        the watch then waits for the next press. Only the result for this frame states that a press was refused.

        Args:
            frame: The frame.
        """
        is_press_unfinished = self._phase is Phase.settling
        if self._phase is not Phase.waiting:
            self._frames.clear()  # frames of a press
        self._phase = Phase.waiting
        if frame.clock_s > self._press_end_s + self.EDGE_S:
            self._store(frame, kept_s=self.EDGE_S + self.REST_S)

        held_s = self._press_end_s - self._press_begin_s
        if is_press_unfinished and held_s >= self.MIN_HELD_S:
            reason = self._unsteady_reason or "hold it longer"
            return WatchResult(Phase.refused, f"released after {held_s:.1f} s, before it was steady: {reason}")
        return WatchResult(Phase.waiting)
