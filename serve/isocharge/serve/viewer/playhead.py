"""Playhead, which is the position at which a viewer plays a recording."""

from dataclasses import dataclass

from isocharge.serve.viewer.messages import Pause, Play, ReplayRequest, Seek, Speed


@dataclass
class Playhead:
    """Position at which a viewer plays a recording.

    Attributes:
        at_s: Time since the start of the recording, s.
        speed: Speed relative to the recorded speed.
        is_playing: Whether the position advances.
        has_jumped: Whether the viewer has selected another position and has not yet received samples from there.
    """

    at_s: float = 0.0
    speed: float = 1.0
    is_playing: bool = True
    has_jumped: bool = True

    def advance(self, step_s: float, end_s: float, *, is_complete: bool) -> bool:
        """Advance the position if the recording is being played, and stop playing at the end of the recording.

        While the recording is still being read, the position stays within the part that has already been read. Playing
        then continues.

        Args:
            step_s: Time that has passed since the previous call, s.
            end_s: Length of the part of the recording that has been read, s.
            is_complete: Whether the whole recording has been read.

        Returns:
            Whether the position has just reached the end of the recording.
        """
        if not self.is_playing:
            return False
        self.at_s = min(self.at_s + step_s * self.speed, end_s)
        self.is_playing = not (is_complete and self.at_s >= end_s)
        return not self.is_playing

    def apply(self, request: ReplayRequest, end_s: float) -> None:
        """Carry out a request of the page.

        If the position is at the end of the recording, a request to play starts again at the beginning.

        Args:
            request: Request to change the speed, to go to another position, to pause, or to play.
            end_s: Length of the part of the recording that has been read, s.
        """
        match request:
            case Speed(value=value):
                self.speed = value
            case Seek(value=value):
                self._jump(min(value, end_s))
            case Pause():
                self.is_playing = False
            case Play():
                self.is_playing = True
                if self.at_s >= end_s:
                    self._jump(0.0)

    def _jump(self, at_s: float) -> None:
        """Set the position to a given time since the start of the recording, s."""
        self.at_s = at_s
        self.has_jumped = True

    def to_json(self) -> dict[str, float | bool]:
        """Return the position, the speed and whether the recording is being played, as a JSON object for the page."""
        return {"at_s": round(self.at_s, 3), "speed": self.speed, "is_playing": self.is_playing}
