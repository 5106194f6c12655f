"""The place of one viewer in a recording: where it plays, how fast, and whether it does."""

from dataclasses import dataclass

from isocharge.serve.viewer.messages import PageRequest


@dataclass
class Playhead:
    """Where a viewer is in a recording.

    Attributes:
        at_s: Time since the start of the recording, s.
        speed: Times the recorded pace.
        is_playing: Whether time goes on.
        has_jumped: Whether the viewer sought another place, and has nothing of it yet.
    """

    at_s: float = 0.0
    speed: float = 1.0
    is_playing: bool = True
    has_jumped: bool = True

    def advance(self, step_s: float, end_s: float, *, is_complete: bool) -> bool:
        """Let time go on.

        Args:
            step_s: Time that has passed, s.
            end_s: How far the recording is known, s.
            is_complete: Whether that is all of it.

        Returns:
            Whether the end has just been reached.
        """
        if not self.is_playing:
            return False
        self.at_s = min(self.at_s + step_s * self.speed, end_s)
        if is_complete and self.at_s >= end_s:
            self.is_playing = False
            return True
        return False

    def apply(self, request: PageRequest, end_s: float) -> None:
        """Do what the page asks for; at the end, playing begins anew."""
        if request.action == "speed":
            self.speed = request.value
        elif request.action == "seek":
            self.at_s, self.has_jumped = min(request.value, end_s), True
        else:
            self.is_playing = request.action == "play"
            if self.is_playing and self.at_s >= end_s:
                self.at_s, self.has_jumped = 0.0, True

    def to_json(self) -> dict[str, float | bool]:
        """For the page."""
        return {"at_s": round(self.at_s, 3), "speed": self.speed, "is_playing": self.is_playing}
