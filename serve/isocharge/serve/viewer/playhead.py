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

    def advance(self, step_s: float, read_s: float, *, is_complete: bool) -> bool:
        """Advance the position if the recording is being played, and stop playing at the end of the recording.

        The position stays within the part of the recording that has already been read. If it reaches the end of this
        part while the recording is still being read, it waits there, and the recording counts as being played.

        Args:
            step_s: Time that has passed since the previous call, s.
            read_s: Length of the part of the recording that has been read, s.
            is_complete: Whether the whole recording has been read.

        Returns:
            Whether the position has just reached the end of the recording.
        """
        if not self.is_playing:
            return False
        self.at_s = min(self.at_s + step_s * self.speed, read_s)
        has_reached_end = is_complete and self.at_s >= read_s
        if has_reached_end:
            self.is_playing = False
        return has_reached_end

    def apply(self, request: ReplayRequest, read_s: float) -> None:
        """Carry out a request of the page.

        A request to play starts again at the beginning if the position is at the end of the part that has been read.

        Args:
            request: Request to change the speed, to go to another position, to pause, or to play.
            read_s: Length of the part of the recording that has been read, s.
        """
        match request:
            case Speed(value=value):
                self.speed = value
            case Seek(value=value):
                self._jump(min(value, read_s))
            case Pause():
                self.is_playing = False
            case Play():
                self.is_playing = True
                if self.at_s >= read_s:
                    self._jump(0.0)

    def _jump(self, at_s: float) -> None:
        """Set the position to a given time since the start of the recording, s."""
        self.at_s = at_s
        self.has_jumped = True

    def to_json(self) -> dict[str, float | bool]:
        """Return the position, the speed and whether the recording is being played, as a JSON object for the page."""
        return {"at_s": round(self.at_s, 3), "speed": self.speed, "is_playing": self.is_playing}
