"""Detection and measurement of presses that are held still.

The charges of a press are examined in a time window. The press is steady if the scatter and the drift of each charge in
the window are small. The charge of a press is the mean charge in the window minus the mean charge at rest just before
the touch. A slow drift of the amplifiers or of the film's temperature therefore does not affect the measured charge. A
press is refused if it saturates an amplifier, moves, creeps or ends too early. The reason for the refusal is returned.
"""

from collections import deque
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import RECONNECTED, RESTART, SATURATED, TARE
from isocharge.serve.frames.frame import Frame
from isocharge.serve.live.fading import cause_of_fading

CHECKS_PER_WINDOW = 10
"""Number of times that a window is examined within its length.

A board may send thousands of frames per second, so that it would take too long to examine the window at every frame.
"""

PORT_LOST = "the port was lost: do not touch the film until it is tared"
"""Reason for which a press is refused if the port was lost."""

NO_REST_BEFORE_PRESS = (
    "pressed too soon after the last touch: do not touch the film for half a second before a press; if that does not "
    "help, the amplifier leaks: state its time constant in the section [leak] of a device file"
)
"""Reason for which a press is refused if the film was not at rest before the press."""

MIN_REST_FRAMES = 3
"""Smallest number of frames at rest that must precede a press."""

MAX_SCATTER_RATIO = 2.0
"""Largest scatter in a calm window, relative to the smallest scatter in a window of the same press.

A larger scatter means that the probe has moved suddenly.
"""

MAX_SLOPE_DIFFERENCE = 0.3
"""Largest difference between the slope of a charge and a proportional change of all charges, dimensionless.

The difference is relative to the magnitude of the charge or to the mean magnitude, whichever is larger, and to the
relative slope of the mean magnitude. If no difference is larger, all charges change in proportion, and the press does
not move.
"""

MIN_CHARGE_pC = 1e-9
"""Smallest charge by which a drift is divided, pC. It avoids a division by zero."""


class SteadyRule(NamedTuple):
    """Conditions for a steady press.

    Attributes:
        window_s: Length of the window, s.
        min_frames: Smallest number of frames in a window.
        max_scatter_sigmas: Largest scatter of a charge about a straight line, in standard deviations of its noise.
        relative_noise: Standard deviation of the additional noise of a press, relative to its charge. It is larger than
            0 because the force of a hand varies.
        max_relative_drift: Largest drift of a charge over the window, relative to its magnitude or to the mean
            magnitude of all charges, whichever is larger. A drift of this size changes the position by about 0.05 mm.
        drift_sigmas: Number of standard errors of the drift by which the drift may also exceed this limit.
        max_held_s: Time since the touch after which a press is refused if it is not steady yet, s. A longer press would
            have a larger error of the leak correction.
        min_held_s: Shortest duration of a press, s. Shorter touches are ignored.
        rest_s: Duration of the rest before a touch over which the charges at rest are averaged, s.
        edge_s: Time just before and just after a press that does not count as rest, s. The probe may already or still
            touch the film during this time.
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
    """Charges of a press that was held still, which were measured in a time window.

    Attributes:
        charge_pC: Mean touch charges over the window, shape (n_electrode,), pC.
        scatter_pC: Standard deviation of each charge about a straight line that is fitted to it, shape (n_electrode,),
            pC.
        drift_pC: Change of each straight line over the window, shape (n_electrode,), pC.
        held_s: Time from the touch to the end of the window, s.
        window_s: Length of the window, s.
        frames: Number of frames in the window.
        flags: Flags of `isocharge.serve.flags` that at least one frame in the window has.
    """

    charge_pC: Array
    scatter_pC: Array
    drift_pC: Array
    held_s: float
    window_s: float
    frames: int
    flags: tuple[str, ...]


class WatchResult(NamedTuple):
    """Result that a `PressWatch` returns for one reading.

    Attributes:
        phase: What the watch waits for. It is `taken` or `refused` only for the reading with which a press was accepted
            or refused.
        charge_pC: Touch charges of this reading minus the charges at rest before the press, shape (n_electrode,), pC.
            None if the reading has no charges.
        held_s: Time since the touch began, s; 0 if nothing touches the film.
        reason: Reason why the press is refused or is not steady yet, as a part of a sentence.
        press: The accepted press if the phase is `taken`, and otherwise None.
    """

    phase: Phase
    charge_pC: Array | None = None
    held_s: float = 0.0
    reason: str = ""
    press: SteadyPress | None = None


class PressWatch:
    """Finds one steady press in each touch. Each object may be used by only one thread."""

    def __init__(self, electrodes: tuple[str, ...], rule: SteadyRule | None = None) -> None:
        """Create a watch that waits for the tare, which is the charge of the untouched film.

        Args:
            electrodes: Names of the electrodes, which are used in the reasons why presses are refused.
            rule: Conditions for a steady press. By default, the default values of `SteadyRule` are used.
        """
        self._electrodes = electrodes
        self._rule = rule or SteadyRule()
        self._phase = Phase.taring
        self._rest_frames: deque[tuple[float, Array]] = deque()  # times and charges of the latest frames without touch

        # State of the present or latest press
        self._window: deque[Frame] = deque()  # the latest frames of the press
        self._rest_pC = np.zeros(len(electrodes))  # mean charges just before the press
        self._has_rest = False  # whether enough frames before the press were at rest
        self._begin_s = -np.inf  # time of the first frame of the press
        self._end_s = -np.inf  # time of the latest frame of the press
        self._last_check_s = -np.inf  # time at which the window was last examined
        self._reason = ""  # why the press is not steady yet
        self._min_scatter_pC = np.inf  # smallest scatter of all windows of the press
        # Time since the touch, s, and mean magnitude of the charges, pC, of each calm window
        self._mean_magnitudes: list[tuple[float, float]] = []

    def arm(self) -> None:
        """Ignore the present press if there is one, and wait for the next press."""
        if self._phase is Phase.settling:
            self._phase = Phase.lift

    def feed(self, frame: Frame) -> WatchResult:
        """Process the next reading, and return the phase of the watch with the charges of the reading.

        The first phase is `taring`, which ends when the charge of the untouched film has been measured. The phase
        `waiting` follows until a touch begins. The phase `settling` follows until the press is accepted or refused. The
        phase `lift` follows until the finger leaves the film. The phase `waiting` then begins again.

        Args:
            frame: The frame, after the stages of a `ReadingStream`.

        Returns:
            The phase, the charges of the reading and, if a press is refused or not steady yet, the reason. The result
            contains an accepted press only for the reading with which the press was accepted.
        """
        t_s = frame.clock_s
        if RECONNECTED in frame.flags or RESTART in frame.flags:
            # The charges before the interruption cannot be compared with later charges.
            self._rest_frames.clear()
            return self._refuse(PORT_LOST, Phase.taring)
        if frame.charge_pC is None:  # there is no tare yet, or the frame is invalid
            if TARE in frame.flags:  # the tare is being measured
                self._phase = Phase.taring
            return WatchResult(self._phase)
        if not frame.is_contact:
            return self._process_rest(frame.charge_pC, t_s)

        # Something touches the film.
        if self._phase in (Phase.waiting, Phase.taring):
            self._begin_press(t_s)
        charge_pC = frame.charge_pC - self._rest_pC
        held_s = t_s - self._begin_s
        if self._phase is Phase.lift:  # the press was accepted or refused before, and the finger is still on the film
            return WatchResult(Phase.lift, charge_pC, held_s)
        result = self._process_press(frame)
        return result._replace(charge_pC=charge_pC, held_s=held_s)

    def _process_rest(self, charge_pC: Array, t_s: float) -> WatchResult:
        """Store a frame in which nothing touches the film, and refuse a press that has ended without becoming steady.

        The charges at rest before the next press are measured from the stored frames. Frames within `edge_s` after a
        press are not stored, because the finger may still touch the film. Frames within `edge_s` before a press are not
        used, because the finger may already touch the film. A touch shorter than `min_held_s` is ignored.

        Args:
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC.
            t_s: Time of the frame, s.
        """
        rule = self._rule
        held_s = self._end_s - self._begin_s  # duration of the previous press
        is_press_unfinished = self._phase is Phase.settling
        self._phase = Phase.waiting

        if t_s > self._end_s + rule.edge_s:
            self._rest_frames.append((t_s, charge_pC))

        # Drop frames that are too old. If a press began now, its rest would be measured over a duration of `rest_s`,
        # which ends `edge_s` before now.
        oldest_rest_s = t_s - rule.edge_s - rule.rest_s
        while self._rest_frames:
            first_rest_s, _ = self._rest_frames[0]
            if first_rest_s >= oldest_rest_s:
                break
            self._rest_frames.popleft()

        if is_press_unfinished and held_s >= rule.min_held_s:
            reason = self._reason or "hold it longer"
            return self._refuse(f"released after {held_s:.1f} s, before it was steady: {reason}", Phase.waiting)
        return WatchResult(Phase.waiting, charge_pC)

    def _begin_press(self, t_s: float) -> None:
        """Begin a press, and measure the charges at rest just before the press.

        The frames of the last `edge_s` before the press are excluded, because the finger may have touched the film
        before the touch was detected.

        Args:
            t_s: Time of the first frame of the press, s.
        """
        rest_end_s = t_s - self._rule.edge_s
        rest_charges_pC = [charge_pC for frame_s, charge_pC in self._rest_frames if frame_s <= rest_end_s]
        self._has_rest = len(rest_charges_pC) >= MIN_REST_FRAMES
        self._rest_pC = np.zeros(len(self._electrodes))
        if rest_charges_pC:
            self._rest_pC = np.mean(rest_charges_pC, axis=0)
        self._rest_frames.clear()
        self._window.clear()
        self._mean_magnitudes.clear()
        self._phase = Phase.settling
        self._begin_s = t_s
        self._last_check_s = t_s
        self._reason = ""
        self._min_scatter_pC = np.inf

    def _process_press(self, frame: Frame) -> WatchResult:
        """Add a frame to the window of the present press, and accept or refuse the press if this can be decided.

        The press is accepted if it is steady. It is refused if an amplifier is saturated, if the film was not at rest
        before the press, or if the press is not steady within `max_held_s`.

        Args:
            frame: The frame.

        Returns:
            The phase `taken` and the press if the press is steady, `refused` and the reason if the press is refused,
            and otherwise `settling`. The charges and the time since the touch are not filled in.
        """
        rule = self._rule
        t_s = frame.clock_s
        self._end_s = t_s
        held_s = t_s - self._begin_s
        if SATURATED in frame.flags:
            return self._refuse("an amplifier is at its limit: press less hard", Phase.lift)
        if not self._has_rest and held_s >= rule.min_held_s:
            return self._refuse(NO_REST_BEFORE_PRESS, Phase.lift)

        self._window.append(frame)
        while self._window[0].clock_s < t_s - rule.window_s:
            self._window.popleft()

        # The window is examined several times within its length, but not in each frame, which would take too long.
        is_window_full = held_s >= rule.window_s and len(self._window) >= rule.min_frames
        is_check_due = t_s - self._last_check_s >= rule.window_s / CHECKS_PER_WINDOW
        if is_window_full and is_check_due:
            self._last_check_s = t_s
            press = self._steady_press(frame)
            if press is not None:
                self._phase = Phase.lift
                return WatchResult(Phase.taken, press=press)
        if held_s > rule.max_held_s:
            reason = self._reason or "too few frames come"
            return self._refuse(f"not steady within {rule.max_held_s:g} s: {reason}", Phase.lift)
        return WatchResult(Phase.settling, reason=self._reason)

    def _steady_press(self, frame: Frame) -> SteadyPress | None:
        """Return the press in the window if the press is steady. Otherwise, return None and store the reason.

        A window is calm if it contains no sudden movement: its scatter is at most `MAX_SCATTER_RATIO` times the
        smallest scatter in the earlier windows of the present press. If the window is not calm, neither its mean
        magnitude nor the reason is stored, because they would only describe the movement.

        Args:
            frame: The latest frame, which contains the noise of the charges at rest.
        """
        press = self._measure_window()
        scatter_pC = float(press.scatter_pC.max())
        is_calm = scatter_pC <= MAX_SCATTER_RATIO * self._min_scatter_pC
        self._min_scatter_pC = min(self._min_scatter_pC, scatter_pC)
        if is_calm:
            self._store_mean_magnitude(press)

        reason = unsteadiness(self._rule, press, frame.noise_pC, self._electrodes, self._mean_magnitudes)
        if not reason:
            return press
        if is_calm:
            self._reason = reason
        return None

    def _store_mean_magnitude(self, press: SteadyPress) -> None:
        """Store the mean magnitude of the charges in a calm window, and the time of its middle since the touch.

        The cause of a slow decrease of the charges is determined from the stored values. A window that overlaps the
        first window of the press is not stored, because the force may still rise in the first window.

        Args:
            press: The calm window.
        """
        window_begin_s = press.held_s - press.window_s  # time from the touch to the beginning of the window
        overlaps_first_window = window_begin_s < press.window_s
        if overlaps_first_window:
            return
        window_middle_s = press.held_s - 0.5 * press.window_s
        mean_magnitude_pC = float(np.abs(press.charge_pC).mean())
        self._mean_magnitudes.append((window_middle_s, mean_magnitude_pC))

    def _measure_window(self) -> SteadyPress:
        """Fit a straight line to each charge in the window, and return the mean, the scatter and the drift of each.

        The scatter of a charge is the standard deviation of its residuals from the line. The drift of a charge is the
        change of its line from the beginning to the end of the window.
        """
        begin_s = self._window[0].clock_s
        end_s = self._end_s
        window_s = float(end_s - begin_s)
        times_s = np.array([frame.clock_s for frame in self._window]) - begin_s
        charge_pC = np.array([frame.charge_pC for frame in self._window]) - self._rest_pC  # shape (frames, n_electrode)

        # The line is fitted by least squares. Its value at the mean time of the frames is the mean charge.
        centred_s = times_s - times_s.mean()
        square_sum_s2 = max(float(centred_s @ centred_s), 1e-30)  # avoids a division by 0 if all times are equal
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
        """Continue in the given phase, and return a result that refuses the present press.

        Args:
            reason: Reason for the refusal.
            phase: Phase in which the watch continues.
        """
        self._phase = phase
        return WatchResult(Phase.refused, reason=reason)


def unsteadiness(
    rule: SteadyRule,
    press: SteadyPress,
    noise_pC: Array,
    electrodes: tuple[str, ...],
    mean_magnitudes: Sequence[tuple[float, float]],
) -> str:
    """Return the reason why a press is not steady, or an empty text if the press is steady.

    A straight line was fitted to each charge in the window. The press is steady if the scatter of each charge about its
    line is small, and if the change of each line over the window (the drift) is small. The limits allow for the scatter
    and the drift that noise alone causes.

    Args:
        rule: Conditions for a steady press.
        press: Charges, scatter and drift in a window of the press.
        noise_pC: Standard deviation of each charge at rest, shape (n_electrode,), pC.
        electrodes: Names of the electrodes, for the reason.
        mean_magnitudes: Time since the touch, s, and mean magnitude of the charges, pC, of each calm window so far. The
            cause of a slow decrease is determined from these values.

    Returns:
        The reason as a part of a sentence.
    """
    # The charges scatter because of the noise at rest, and because a hand varies its force.
    mean_magnitude_pC = float(np.abs(press.charge_pC).mean())
    expected_scatter_pC = np.hypot(noise_pC, rule.relative_noise * mean_magnitude_pC)
    relative_scatter = press.scatter_pC / expected_scatter_pC
    if relative_scatter.max() > rule.max_scatter_sigmas:
        worst_index = int(relative_scatter.argmax())
        return f"the charge of {electrodes[worst_index]} shakes by {press.scatter_pC[worst_index]:.2g} pC"

    # If a line is fitted to n values of noise, the standard deviation of its change is sqrt(12 / n) times the noise.
    drift_std_pC = press.scatter_pC * np.sqrt(12.0 / press.frames)
    # A charge that is smaller than the mean magnitude may change as much as a charge of the mean magnitude.
    reference_pC = np.maximum(np.abs(press.charge_pC), mean_magnitude_pC)
    max_drift_pC = rule.max_relative_drift * reference_pC + rule.drift_sigmas * drift_std_pC
    is_drift_small = (np.abs(press.drift_pC) <= max_drift_pC).all()
    if is_drift_small:
        return ""
    return _drift_reason(press, mean_magnitudes)


def _drift_reason(press: SteadyPress, mean_magnitudes: Sequence[tuple[float, float]]) -> str:
    """Return the probable reason for a drift of the charges, as a part of a sentence.

    If only the force changes, all charges change in proportion. If they change otherwise, the position of the press
    changes. A charge rises if its magnitude becomes larger, so that charges of both signs can be compared.

    Args:
        press: Charges and drift in a window of the press. The drift is the change of each charge over the window.
        mean_magnitudes: Time since the touch, s, and mean magnitude of the charges, pC, of each calm window so far.
    """
    magnitude_pC = np.abs(press.charge_pC)
    mean_magnitude_pC = max(float(magnitude_pC.mean()), MIN_CHARGE_pC)  # avoids a division by 0
    magnitude_slope_pC_per_s = np.sign(press.charge_pC) * press.drift_pC / press.window_s
    mean_slope = float(magnitude_slope_pC_per_s.mean()) / mean_magnitude_pC  # relative, 1/s

    # A charge that is smaller than the mean magnitude is compared with the mean magnitude. Otherwise, the noise of a
    # charge near zero would look like a movement.
    reference_pC = np.maximum(magnitude_pC, mean_magnitude_pC)
    proportional_slope_pC_per_s = mean_slope * magnitude_pC
    slope_difference = (magnitude_slope_pC_per_s - proportional_slope_pC_per_s) / reference_pC  # shape (n_electrode,)
    if np.abs(slope_difference).max() > MAX_SLOPE_DIFFERENCE * abs(mean_slope):
        return "the press moves: the ratios of the charges change"
    if mean_slope > 0.0:
        return f"the charges rise by {100.0 * mean_slope:.2g} % per second: hold the force"
    return (
        f"the charges fall by {-100.0 * mean_slope:.2g} % per second on all electrodes alike: hold the force; "
        f"{cause_of_fading(mean_magnitudes)}"
    )
