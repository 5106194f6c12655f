"""Presses that are held still: when the charges of a press have settled, and what they are then.

A press is steady when, over a window, each charge scatters and drifts by little. Its charge is the mean over the window
less the mean at rest just before the touch, so that slow drift of the amplifier or of the film's temperature does not
count as touch. A press that saturates an amplifier, moves, creeps, or ends too early is refused, with the reason.
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
"""How often a window is looked at while it moves by its own length: a board may send thousands of frames a second."""

AWAY = "the port was away: leave the film alone until it is tared"
"""Why a press is refused that was lost with its port."""

TOO_SOON = (
    "pressed too soon after the last touch: leave the film alone for half a second before; if that does not help, the "
    "amplifier leaks: a device file needs [leak] with the time constant of its circuit"
)
"""Why a press is refused before which there was no rest."""

LEAST_REST = 3
"""Frames of rest before a touch, at least."""

AS_CALM = 2.0
"""Scatter over the least of the press up to which a window is of a held press: beyond it the probe leaves."""

ALIKE = 0.3
"""Largest difference of the charges' relative slopes, over their mean, at which all electrodes change alike."""


class SteadyRule(NamedTuple):
    """When a press is steady.

    Attributes:
        window_s: Length of the window, s.
        fewest: Frames in a window, at least.
        scatter_sigmas: Largest scatter about a straight line, in standard deviations of the noise.
        noise_share: Noise of a charge under load as a share of it, on top of the noise at rest; a hand trembles by 1 %.
        drift_share: Largest drift of a charge over the window, as a share of it or of the mean of all: half of what a
            place known to 0.1 mm leaves, and what a time constant that is 5 % wrong leaves of a leak of 10 s.
        drift_sigmas: Standard errors of the drift that are allowed on top.
        latest_s: Time after the touch at which a press that has not settled is refused, s: the longer it is held, the
            more the leak has been guessed.
        shortest_s: Shorter touches are no presses, s.
        rest_s: Length of the rest before the touch that is subtracted, s.
        edge_s: Time next to a press that is no rest yet: the probe lands, or leaves, s.
    """

    window_s: float = 0.5
    fewest: int = 20
    scatter_sigmas: float = 3.0
    noise_share: float = 0.007
    drift_share: float = 0.005
    drift_sigmas: float = 4.0
    latest_s: float = 8.0
    shortest_s: float = 0.1
    rest_s: float = 0.3
    edge_s: float = 0.05


class Phase(StrEnum):
    """What a press watch waits for, or what has just happened."""

    taring = "taring"
    lift = "lift"
    waiting = "waiting"
    settling = "settling"
    taken = "taken"
    refused = "refused"


class SteadyPress(NamedTuple):
    """A press that was held still.

    Attributes:
        charge_pC: Touch charges, means over the window, shape (n_electrode,), pC.
        scatter_pC: Standard deviations about a straight line in the window, shape (n_electrode,), pC.
        drift_pC: Changes over the window by that line, shape (n_electrode,), pC.
        held_s: From the touch to the end of the window, s.
        window_s: Length of the window, s.
        frames: Frames in the window.
        flags: Words from `isocharge.serve.flags` that frames of the window had.
    """

    charge_pC: Array
    scatter_pC: Array
    drift_pC: Array
    held_s: float
    window_s: float
    frames: int
    flags: tuple[str, ...]


class Watched(NamedTuple):
    """What a press watch says of a reading.

    Attributes:
        phase: What it waits for, or `taken` or `refused` once, at the reading that decides.
        charge_pC: Touch charges of this reading above the rest before, shape (n_electrode,), pC; None without a tare.
        held_s: Since the touch, s; 0 where nothing touches.
        reason: Why a press is refused, or has not settled yet; a part of a sentence.
        press: The press that is taken.
    """

    phase: Phase
    charge_pC: Array | None = None
    held_s: float = 0.0
    reason: str = ""
    press: SteadyPress | None = None


class PressWatch:
    """Readings in, steady presses out; one press from each touch. Belongs to one thread."""

    def __init__(self, electrodes: tuple[str, ...], rule: SteadyRule | None = None) -> None:
        """Set up the watch.

        Args:
            electrodes: Names, for reasons.
            rule: When a press is steady.
        """
        self._electrodes, self._rule = electrodes, rule or SteadyRule()
        self._phase = Phase.taring
        self._rest: deque[tuple[float, Array]] = deque()
        self._window: deque[tuple[float, Array, tuple[str, ...]]] = deque()
        self._rest_pC = np.zeros(len(electrodes))
        self._begin_s = self._end_s = self._check_s = -np.inf
        self._reason, self._calmest_pC, self._has_rest = "", np.inf, False
        self._sizes: list[tuple[float, float]] = []

    def arm(self) -> None:
        """From now on, take only a press that has not begun yet."""
        if self._phase is Phase.settling:
            self._phase = Phase.lift

    def feed(self, timed: TimedReading) -> Watched:
        """Take the next reading."""
        reading, t_s = timed.reading, timed.time.clock_s
        if RECONNECTED in reading.flags or RESTART in reading.flags:
            self._rest.clear()
            return self._refuse(AWAY, Phase.taring)
        if reading.charge_pC is None:  # no tare yet, or a frame without numbers
            self._phase = Phase.taring if TARE in reading.flags else self._phase
            return Watched(self._phase)
        if not reading.contact:
            return self._at_rest(reading.charge_pC, t_s)
        if self._phase in (Phase.waiting, Phase.taring):
            self._touch(t_s)
        charge_pC, held_s = reading.charge_pC - self._rest_pC, t_s - self._begin_s
        if self._phase is Phase.lift:
            return Watched(Phase.lift, charge_pC, held_s)
        return self._settle(reading, charge_pC, t_s)._replace(charge_pC=charge_pC, held_s=held_s)

    def _at_rest(self, charge_pC: Array, t_s: float) -> Watched:
        held_s, unsettled = self._end_s - self._begin_s, self._phase is Phase.settling
        self._phase = Phase.waiting
        if t_s > self._end_s + self._rule.edge_s:
            self._rest.append((t_s, charge_pC))
        while self._rest and self._rest[0][0] < t_s - self._rule.rest_s - self._rule.edge_s:
            self._rest.popleft()
        if unsettled and held_s >= self._rule.shortest_s:
            reason = self._reason or "hold it longer"
            return self._refuse(f"released after {held_s:.1f} s, before it was steady: {reason}", Phase.waiting)
        return Watched(Phase.waiting, charge_pC)

    def _touch(self, t_s: float) -> None:
        """A press begins: what was there just before is rest."""
        rest = [charge_pC for at_s, charge_pC in self._rest if at_s <= t_s - self._rule.edge_s]
        self._has_rest = len(rest) >= LEAST_REST
        self._rest_pC = np.mean(rest, axis=0) if rest else np.zeros(len(self._electrodes))
        self._rest.clear()
        self._window.clear()
        self._sizes.clear()
        self._phase, self._begin_s, self._check_s, self._reason = Phase.settling, t_s, t_s, ""
        self._calmest_pC = np.inf

    def _settle(self, reading: Reading, charge_pC: Array, t_s: float) -> Watched:
        rule, self._end_s = self._rule, t_s
        if SATURATED in reading.flags:
            return self._refuse("an amplifier is at its limit: press less hard", Phase.lift)
        if not self._has_rest and t_s - self._begin_s >= rule.shortest_s:
            return self._refuse(TOO_SOON, Phase.lift)
        self._window.append((t_s, charge_pC, reading.flags))
        while self._window[0][0] < t_s - rule.window_s:
            self._window.popleft()
        full = t_s - self._begin_s >= rule.window_s and len(self._window) >= rule.fewest
        if full and t_s - self._check_s >= rule.window_s / CHECKS_PER_WINDOW:
            self._check_s = t_s
            noise_pC = reading.tare.noise_pC if reading.tare else np.zeros_like(charge_pC)
            press = self._measured(t_s)
            calm = press.scatter_pC.max() <= AS_CALM * self._calmest_pC
            self._calmest_pC = min(self._calmest_pC, float(press.scatter_pC.max()))
            if calm and press.held_s >= 2.0 * press.window_s:  # the probe has landed before the window
                self._sizes.append((press.held_s - 0.5 * press.window_s, float(np.abs(press.charge_pC).mean())))
            reason = unsteadiness(rule, press, noise_pC, self._electrodes, self._sizes)
            if not reason:
                self._phase = Phase.lift
                return Watched(Phase.taken, press=press)
            if calm:
                self._reason = reason
        if t_s - self._begin_s > rule.latest_s:
            reason = self._reason or "too few frames come"
            return self._refuse(f"not steady within {rule.latest_s:g} s: {reason}", Phase.lift)
        return Watched(Phase.settling, reason=self._reason)

    def _measured(self, t_s: float) -> SteadyPress:
        """The window as a press, with a straight line through each charge."""
        times, charges, flags = zip(*self._window, strict=True)
        at, charge_pC = np.array(times) - times[0], np.array(charges)
        centred = at - at.mean()
        slope = centred @ charge_pC / max(float(centred @ centred), 1e-30)
        mean_pC = charge_pC.mean(axis=0)
        scatter_pC = (charge_pC - mean_pC - np.outer(centred, slope)).std(axis=0)
        words = tuple(dict.fromkeys(word for group in flags for word in group))
        return SteadyPress(mean_pC, scatter_pC, slope * at[-1], t_s - self._begin_s, float(at[-1]), len(charges), words)

    def _refuse(self, reason: str, phase: Phase) -> Watched:
        self._phase = phase
        return Watched(Phase.refused, reason=reason)


def unsteadiness(
    rule: SteadyRule,
    press: SteadyPress,
    noise_pC: Array,
    electrodes: tuple[str, ...],
    sizes: Sequence[tuple[float, float]],
) -> str:
    """Why a press is not steady, a part of a sentence; empty if it is.

    Args:
        rule: When a press is steady.
        press: A window of it.
        noise_pC: Standard deviation of each charge at rest, shape (n_electrode,), pC.
        electrodes: Names, for the reason.
        sizes: Times since the touch, s, and mean magnitudes of the charges, pC, of the windows so far.
    """
    size_pC = float(np.abs(press.charge_pC).mean())
    noise_pC = np.hypot(noise_pC, rule.noise_share * size_pC)
    excess = press.scatter_pC / noise_pC
    if excess.max() > rule.scatter_sigmas:
        worst = int(excess.argmax())
        return f"the charge of {electrodes[worst]} shakes by {press.scatter_pC[worst]:.2g} pC"
    error_pC = press.scatter_pC * np.sqrt(12.0 / press.frames)
    allowed_pC = rule.drift_share * np.maximum(np.abs(press.charge_pC), size_pC) + rule.drift_sigmas * error_pC
    if (np.abs(press.drift_pC) <= allowed_pC).all():
        return ""
    return _drift_words(press, sizes)


def _drift_words(press: SteadyPress, sizes: Sequence[tuple[float, float]]) -> str:
    """What changes: the force, if all charges change alike, or the place."""
    share_per_s = press.drift_pC / np.maximum(np.abs(press.charge_pC), 1e-9) / press.window_s
    mean = float(share_per_s.mean())
    if np.abs(share_per_s - mean).max() > ALIKE * abs(mean):
        return "the press moves: the ratios of the charges change"
    if mean > 0.0:
        return f"the charges rise by {100.0 * mean:.2g} % per second: hold the force"
    return (
        f"the charges fall by {-100.0 * mean:.2g} % per second on all electrodes alike: hold the force; "
        f"{cause_of_fading(sizes)}"
    )
