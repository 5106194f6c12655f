"""Detection of presses that are held still, and measurement of their charges.

A press is steady if, within a window of time, the scatter and the drift of each charge are small. The charge of the
press is the mean over the window minus the mean at rest just before the touch. A slow drift of the amplifiers, or of
the temperature of the film, therefore does not affect the charge. A press is refused, with a reason, if it saturates an
amplifier, moves, creeps or ends too early.
"""

from collections import deque
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import RECONNECTED, RESTART, SATURATED, TARE
from isocharge.serve.live.fading import cause_of_fading
from isocharge.serve.live.reading_stream import TimedReading
from isocharge.serve.signal_chain.chain import Reading

CHECKS_PER_WINDOW = 10
"""Number of checks in the length of a window. A board may send thousands of frames per second."""

PORT_LOST = "the port was lost: do not touch the film until it is tared"
"""Reason why a press is refused if the port was lost."""

NO_REST_BEFORE_PRESS = (
    "pressed too soon after the last touch: do not touch the film for half a second before a press; if that does not "
    "help, the amplifier leaks: state its time constant in the section [leak] of a device file"
)
"""Reason why a press is refused if the film was not at rest before the press."""

MIN_REST_FRAMES = 3
"""Smallest number of frames at rest before a touch."""

MAX_SCATTER_RATIO = 2.0
"""Largest scatter of a window, relative to the calmest window of the press. A larger scatter shows a jerk."""

MAX_SLOPE_DIFFERENCE = 0.3
"""Largest deviation of the relative slope of a charge from the mean slope, relative to the mean slope.

If no deviation is larger, all charges change in proportion.
"""

MIN_CHARGE_pC = 1e-9
"""Smallest charge by which a drift is divided, pC."""


class SteadyRule(NamedTuple):
    """Conditions for a steady press.

    Attributes:
        window_s: Length of the window, s.
        min_frames: Smallest number of frames in a window.
        max_scatter_sigmas: Largest scatter about a straight line, in standard deviations of the noise.
        relative_noise: Standard deviation of a charge under load, relative to the charge, in addition to the noise at
            rest. The force of a hand varies by about 1 %.
        max_relative_drift: Largest drift of a charge over the window, relative to the larger of the charge and of the
            mean magnitude of all charges. A drift of this size changes the position by about 0.05 mm.
        drift_sigmas: Number of standard errors of the drift that are added to the largest drift.
        max_held_s: Time after the touch at which a press that is not yet steady is refused, s. The longer a press is
            held, the larger is the error of the leak correction.
        min_held_s: Time below which a touch is not a press, s.
        rest_s: Length of the rest before the touch that is subtracted, s.
        edge_s: Time before and after a press that is not counted as rest, because the probe lands or leaves, s.
    """

    window_s: float = 0.5
    min_frames: int = 20
    max_scatter_sigmas: float = 3.0
    relative_noise: float = 0.007
    max_relative_drift: float = 0.005
    drift_sigmas: float = 4.0
    max_held_s: float = 8.0
    min_held_s: float = 0.1
    rest_s: float = 0.3
    edge_s: float = 0.05


class Phase(StrEnum):
    """State of a press watch: the event that the watch waits for, or the result of the latest reading."""

    taring = "taring"
    lift = "lift"
    waiting = "waiting"
    settling = "settling"
    taken = "taken"
    refused = "refused"


class SteadyPress(NamedTuple):
    """A press that was held still.

    Attributes:
        charge_pC: Mean touch charges over the window, shape (n_electrode,), pC.
        scatter_pC: Standard deviations about a straight line in the window, shape (n_electrode,), pC.
        drift_pC: Changes of this straight line over the window, shape (n_electrode,), pC.
        held_s: Time from the touch to the end of the window, s.
        window_s: Length of the window, s.
        frames: Number of frames in the window.
        flags: Words of `isocharge.serve.flags` that frames of the window had.
    """

    charge_pC: Array
    scatter_pC: Array
    drift_pC: Array
    held_s: float
    window_s: float
    frames: int
    flags: tuple[str, ...]


class WatchResult(NamedTuple):
    """Result of a press watch for one reading.

    Attributes:
        phase: What the watch waits for; `taken` or `refused` only for the reading with which a press is decided.
        charge_pC: Touch charges of this reading minus the rest before, shape (n_electrode,), pC; None without a tare.
        held_s: Time since the touch, s; 0 if nothing touches.
        reason: Why a press is refused, or is not yet steady; a part of a sentence.
        press: The press, if it was accepted with this reading; otherwise None.
    """

    phase: Phase
    charge_pC: Array | None = None
    held_s: float = 0.0
    reason: str = ""
    press: SteadyPress | None = None


class WindowFrame(NamedTuple):
    """A frame in the window of a press.

    Attributes:
        t_s: Time, s.
        charge_pC: Touch charges minus the rest before, shape (n_electrode,), pC.
        flags: Flags of the frame.
    """

    t_s: float
    charge_pC: Array
    flags: tuple[str, ...]


class PressWatch:
    """Finds one steady press in each touch. An object belongs to one thread."""

    def __init__(self, electrodes: tuple[str, ...], rule: SteadyRule | None = None) -> None:
        """Begin to wait for a tare, which is the charge of the untouched film.

        Args:
            electrodes: Names of the electrodes, which appear in the reasons.
            rule: Conditions for a steady press.
        """
        self._electrodes = electrodes
        self._rule = rule or SteadyRule()
        self._phase = Phase.taring
        self._rest: deque[tuple[float, Array]] = deque()  # times and charges of the latest frames without a touch

        # State of the present press
        self._window: deque[WindowFrame] = deque()  # the latest frames of the press
        self._rest_pC = np.zeros(len(electrodes))  # mean charges just before the press
        self._has_rest = False  # whether enough frames before the press were at rest
        self._begin_s = -np.inf  # time of the first frame of the press
        self._end_s = -np.inf  # time of the latest frame of the press
        self._check_s = -np.inf  # time at which the window was last examined
        self._reason = ""  # why the press is not steady yet
        self._min_scatter_pC = np.inf  # smallest scatter of all windows of the press
        self._sizes: list[tuple[float, float]] = []  # time since the touch and mean charge of each calm window

    def arm(self) -> None:
        """Ignore the press that is in progress, and wait for the next press."""
        if self._phase is Phase.settling:
            self._phase = Phase.lift

    def feed(self, timed: TimedReading) -> WatchResult:
        """Process the next reading, and return the state of the press.

        The phases follow each other: `taring` until the charge of the untouched film has been measured, `waiting` for
        a touch, `settling` until the press is steady or refused, and `lift` until the finger leaves the film.

        Args:
            timed: The reading with its time.

        Returns:
            The phase with the charges of the reading. A press is returned once, with the reading that completes it.
        """
        reading = timed.reading
        t_s = timed.time.clock_s
        if RECONNECTED in reading.flags or RESTART in reading.flags:
            self._rest.clear()
            return self._refuse(PORT_LOST, Phase.taring)
        if reading.charge_pC is None:  # there is no tare yet, or the frame is invalid
            if TARE in reading.flags:  # the tare is being measured
                self._phase = Phase.taring
            return WatchResult(self._phase)
        if not reading.contact:
            return self._process_rest(reading.charge_pC, t_s)

        # Something touches the film.
        if self._phase in (Phase.waiting, Phase.taring):
            self._begin_press(t_s)
        charge_pC = reading.charge_pC - self._rest_pC
        held_s = t_s - self._begin_s
        if self._phase is Phase.lift:  # the press has been taken or refused, and the finger is still on the film
            return WatchResult(Phase.lift, charge_pC, held_s)
        result = self._process_press(reading, charge_pC, t_s)
        return result._replace(charge_pC=charge_pC, held_s=held_s)

    def _process_rest(self, charge_pC: Array, t_s: float) -> WatchResult:
        """Store a frame in which nothing touches. If a press has ended before it was steady, refuse this press.

        Args:
            charge_pC: Charges of the frame, shape (n_electrode,), pC.
            t_s: Time of the frame, s.
        """
        rule = self._rule
        held_s = self._end_s - self._begin_s  # duration of the previous press
        is_press_unfinished = self._phase is Phase.settling
        self._phase = Phase.waiting

        # Store the frame, and drop frames that are too old to measure the rest before the next press.
        if t_s > self._end_s + rule.edge_s:  # the finger has left the film
            self._rest.append((t_s, charge_pC))
        oldest_rest_s = t_s - rule.rest_s - rule.edge_s
        while self._rest:
            first_rest_s, _ = self._rest[0]
            if first_rest_s >= oldest_rest_s:
                break
            self._rest.popleft()

        if is_press_unfinished and held_s >= rule.min_held_s:
            reason = self._reason or "hold it longer"
            return self._refuse(f"released after {held_s:.1f} s, before it was steady: {reason}", Phase.waiting)
        return WatchResult(Phase.waiting, charge_pC)

    def _begin_press(self, t_s: float) -> None:
        """Begin a press at the time `t_s`, s, and measure the charges at rest just before the press.

        The latest frames before the press are left out, because the finger may have touched the film already.
        """
        rest_end_s = t_s - self._rule.edge_s
        rest_charges_pC = [charge_pC for frame_s, charge_pC in self._rest if frame_s <= rest_end_s]
        self._has_rest = len(rest_charges_pC) >= MIN_REST_FRAMES
        self._rest_pC = np.zeros(len(self._electrodes))
        if rest_charges_pC:
            self._rest_pC = np.mean(rest_charges_pC, axis=0)
        self._rest.clear()
        self._window.clear()
        self._sizes.clear()
        self._phase = Phase.settling
        self._begin_s = t_s
        self._check_s = t_s
        self._reason = ""
        self._min_scatter_pC = np.inf

    def _process_press(self, reading: Reading, charge_pC: Array, t_s: float) -> WatchResult:
        """Add a frame to the window of a press, and accept the press if it is steady.

        Args:
            reading: The frame.
            charge_pC: Charges of the frame minus the rest, shape (n_electrode,), pC.
            t_s: Time of the frame, s.

        Returns:
            The phase `taken` with the press if it is steady, `refused` with the reason if it cannot become steady, and
            otherwise `settling`.
        """
        rule = self._rule
        self._end_s = t_s
        held_s = t_s - self._begin_s
        if SATURATED in reading.flags:
            return self._refuse("an amplifier is at its limit: press less hard", Phase.lift)
        if not self._has_rest and held_s >= rule.min_held_s:
            return self._refuse(NO_REST_BEFORE_PRESS, Phase.lift)

        self._window.append(WindowFrame(t_s, charge_pC, reading.flags))
        while self._window[0].t_s < t_s - rule.window_s:
            self._window.popleft()

        # The window is examined several times within its length, but not in each frame.
        is_window_full = held_s >= rule.window_s and len(self._window) >= rule.min_frames
        is_check_due = t_s - self._check_s >= rule.window_s / CHECKS_PER_WINDOW
        if is_window_full and is_check_due:
            self._check_s = t_s
            press = self._steady_press(reading)
            if press is not None:
                self._phase = Phase.lift
                return WatchResult(Phase.taken, press=press)
        if held_s > rule.max_held_s:
            reason = self._reason or "too few frames come"
            return self._refuse(f"not steady within {rule.max_held_s:g} s: {reason}", Phase.lift)
        return WatchResult(Phase.settling, reason=self._reason)

    def _steady_press(self, reading: Reading) -> SteadyPress | None:
        """Return the press in the window if it is steady; otherwise store the reason and return None.

        A window is calm if it contains no sudden movement. Its scatter is then not much larger than that of the calmest
        window so far. The mean charge of a calm window is stored, from which the law of a slow decrease is determined
        later. If a window is not calm, its mean charge and its reason are not stored.

        Args:
            reading: The latest frame, which has the noise of the charges at rest.
        """
        press = self._measure_window()
        scatter_pC = float(press.scatter_pC.max())
        is_calm = scatter_pC <= MAX_SCATTER_RATIO * self._min_scatter_pC
        self._min_scatter_pC = min(self._min_scatter_pC, scatter_pC)
        # The first window of a press contains its beginning, during which the force may still rise.
        is_after_first_window = press.held_s >= 2.0 * press.window_s
        if is_calm and is_after_first_window:
            middle_s = press.held_s - 0.5 * press.window_s  # time from the touch to the middle of the window
            mean_size_pC = float(np.abs(press.charge_pC).mean())
            self._sizes.append((middle_s, mean_size_pC))

        noise_pC = np.zeros_like(press.charge_pC)
        if reading.tare is not None:
            noise_pC = reading.tare.noise_pC
        reason = unsteadiness(self._rule, press, noise_pC, self._electrodes, self._sizes)
        if not reason:
            return press
        if is_calm:
            self._reason = reason
        return None

    def _measure_window(self) -> SteadyPress:
        """Fit a straight line to each charge in the window, and return the mean, the scatter and the change.

        The scatter is the standard deviation of the residuals. The change is the difference between the two ends of the
        line.
        """
        begin_s = self._window[0].t_s
        end_s = self._end_s
        window_s = float(end_s - begin_s)
        times_s = np.array([frame.t_s for frame in self._window]) - begin_s
        charge_pC = np.array([frame.charge_pC for frame in self._window])  # shape (frames, n_electrode)

        # Least squares with centred times, so that the slope is independent of the mean.
        centred_s = times_s - times_s.mean()
        square_sum_s2 = max(float(centred_s @ centred_s), 1e-30)  # not 0, even if all times are equal
        slope_pC_per_s = centred_s @ charge_pC / square_sum_s2
        mean_pC = charge_pC.mean(axis=0)
        residual_pC = charge_pC - mean_pC - np.outer(centred_s, slope_pC_per_s)

        all_flags = [flag for frame in self._window for flag in frame.flags]
        different_flags = dict.fromkeys(all_flags)  # each flag once, in the order of its first frame
        return SteadyPress(
            charge_pC=mean_pC,
            scatter_pC=residual_pC.std(axis=0),
            drift_pC=slope_pC_per_s * window_s,
            held_s=end_s - self._begin_s,
            window_s=window_s,
            frames=len(self._window),
            flags=tuple(different_flags),
        )

    def _refuse(self, reason: str, phase: Phase) -> WatchResult:
        """Refuse a press for a reason, and continue with a phase."""
        self._phase = phase
        return WatchResult(Phase.refused, reason=reason)


def unsteadiness(
    rule: SteadyRule,
    press: SteadyPress,
    noise_pC: Array,
    electrodes: tuple[str, ...],
    sizes: Sequence[tuple[float, float]],
) -> str:
    """Return the reason why a press is not steady, as a part of a sentence; an empty string if it is steady.

    A straight line is fitted to each charge in the window. The press is steady if each charge scatters little about its
    line, and each line changes little over the window. Noise alone explains a part of the scatter and of the change.

    Args:
        rule: Conditions for a steady press.
        press: A window of the press.
        noise_pC: Standard deviation of each charge at rest, shape (n_electrode,), pC.
        electrodes: Names of the electrodes, which appear in the reason.
        sizes: Time since the touch, s, and mean magnitude of the charges, pC, of each window so far. They are used to
            state the cause of a decrease.
    """
    # The charges scatter because of the noise at rest, and because a hand varies its force.
    mean_size_pC = float(np.abs(press.charge_pC).mean())
    expected_scatter_pC = np.hypot(noise_pC, rule.relative_noise * mean_size_pC)
    relative_scatter = press.scatter_pC / expected_scatter_pC
    if relative_scatter.max() > rule.max_scatter_sigmas:
        worst = int(relative_scatter.argmax())
        return f"the charge of {electrodes[worst]} shakes by {press.scatter_pC[worst]:.2g} pC"

    # Standard deviation of the change over a window of n frames of a line that is fitted to noise: sqrt(12 / n).
    drift_std_pC = press.scatter_pC * np.sqrt(12.0 / press.frames)
    size_pC = np.maximum(np.abs(press.charge_pC), mean_size_pC)  # small charges may change as much as the mean charge
    max_drift_pC = rule.max_relative_drift * size_pC + rule.drift_sigmas * drift_std_pC
    if (np.abs(press.drift_pC) <= max_drift_pC).all():
        return ""
    return _drift_reason(press, sizes)


def _drift_reason(press: SteadyPress, sizes: Sequence[tuple[float, float]]) -> str:
    """Return the reason for a drift of the charges, as a part of a sentence.

    The force changes if all charges change in proportion, so that their relative slopes are equal. Otherwise the
    position changes.

    Args:
        press: A window of the press. `drift_pC` is the change of each charge over the window.
        sizes: Time since the touch, s, and mean magnitude of the charges, pC, of each window so far.
    """
    charge_size_pC = np.maximum(np.abs(press.charge_pC), MIN_CHARGE_pC)
    relative_slope = press.drift_pC / charge_size_pC / press.window_s  # shape (n_electrode,), 1/s
    mean_slope = float(relative_slope.mean())
    largest_difference = np.abs(relative_slope - mean_slope).max()
    if largest_difference > MAX_SLOPE_DIFFERENCE * abs(mean_slope):
        return "the press moves: the ratios of the charges change"
    if mean_slope > 0.0:
        return f"the charges rise by {100.0 * mean_slope:.2g} % per second: hold the force"
    return (
        f"the charges fall by {-100.0 * mean_slope:.2g} % per second on all electrodes alike: hold the force; "
        f"{cause_of_fading(sizes)}"
    )
