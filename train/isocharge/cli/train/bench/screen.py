"""What a person at the bench sees, on stderr: sentences, and the charges as they settle."""

import sys
from typing import TYPE_CHECKING, Any

from isocharge.cli.shared.terminal import say

if TYPE_CHECKING:
    from isocharge.serve.live.steady_press import SteadyPress, Watched

PLAIN_S = 1.0
"""Time between two lines of a settling press where there is no terminal, s."""

PHASES = {
    "taring": "taring: leave the film alone",
    "lift": "lift the probe",
    "waiting": "waiting for the press",
    "settling": "hold it",
}
"""Phase of the press watch in words."""


class Screen:
    """Sentences, and one line that lives on a terminal; plain lines elsewhere."""

    def __init__(self, electrodes: tuple[str, ...], live: bool | None = None) -> None:
        """Set up.

        Args:
            electrodes: Names, in the order of the charges.
            live: Whether to draw a living line; by default if stderr is a terminal.
        """
        self._electrodes = electrodes
        self._live = sys.stderr.isatty() if live is None else live
        self._status: Any = None
        self._last: tuple[str, float] = ("", 0.0)

    def say(self, sentence: str) -> None:
        """A sentence; the living line gives way."""
        self.rest()
        say(sentence)

    def rest(self) -> None:
        """Take the living line away."""
        if self._status is not None:
            self._status.stop()
        self._status, self._last = None, ("", 0.0)

    def show(self, watched: "Watched") -> None:
        """The charges of a reading, and what the watch waits for."""
        words = PHASES.get(watched.phase)
        if words is None:
            return
        line = f"   {words}{self._charges(watched)}{f' ({watched.reason})' if watched.reason else ''}"
        if self._live:
            self._draw(line)
            return
        phase, shown_s = self._last
        if watched.phase != phase or watched.held_s - shown_s >= PLAIN_S:
            self._last = watched.phase, watched.held_s
            say(line)

    def _draw(self, line: str) -> None:
        from rich.console import Console
        from rich.markup import escape

        if self._status is None:
            self._status = Console(stderr=True).status(escape(line))
            self._status.start()
        self._status.update(escape(line))

    def _charges(self, watched: "Watched") -> str:
        if watched.charge_pC is None or watched.phase != "settling":
            return ""
        return f", {watched.held_s:.1f} s: {charge_words(self._electrodes, watched.charge_pC)}"

    def taken(self, press: "SteadyPress") -> None:
        """A press that was steady."""
        flags = f" [{', '.join(press.flags)}]" if press.flags else ""
        self.say(f"   steady after {press.held_s:.1f} s: {charge_words(self._electrodes, press.charge_pC)}{flags}")


def charge_words(electrodes: tuple[str, ...], charge_pC: Any) -> str:
    """Charges as "A 812.3, B 401.0 pC"."""
    return ", ".join(f"{name} {charge:.1f}" for name, charge in zip(electrodes, charge_pC, strict=True)) + " pC"
