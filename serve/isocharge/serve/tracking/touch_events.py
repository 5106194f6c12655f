"""Detection of the events of a touch: press, hold, slide, tap and release."""

from isocharge.serve.record.record import TrackedContact

HOLD_TIME_s = 0.2
"""Time at rest after which a hold begins, s."""

MAX_TAP_TIME_s = 0.25
"""Longest duration of a tap, s."""

SLIDE_DISTANCE_mm = 0.3
"""Distance from the position at which the contact last rested, above which a moving contact slides, mm."""

SLIDE_PROBABILITY = 0.95
"""Probability that the contact moves, above which it may slide."""

REST_PROBABILITY = 0.5
"""Probability that the contact moves, below which it is at rest."""


class TouchEvents:
    """Detector that derives the events of a touch from the tracked contacts of its frames.

    The durations of a touch and of a rest are measured with the times of the frames. If the clock is set back during a
    touch, the time between the two frames is unknown and is not counted.
    """

    def __init__(self) -> None:
        """Start without a touch."""
        # `begin` sets these values when a touch begins.
        self._press_s = 0.0  # time at which the touch began
        self._rest_position = 0j  # position x + iy at which the contact last rested, mm
        self._rest_begin_s = 0.0  # time at which the contact began to rest at this position
        self._latest_frame_s = 0.0
        self._latest_event = ""

    def begin(self, tracked: TrackedContact, t_s: float) -> str:
        """Begin a new touch, and return its first event, which is always `press`.

        Args:
            tracked: Tracked contact of the first frame of the touch.
            t_s: Time of the frame, s.
        """
        self._press_s = t_s
        self._rest_position = complex(tracked.x_mm, tracked.y_mm)
        self._rest_begin_s = t_s
        self._latest_frame_s = t_s
        self._latest_event = "press"
        return "press"

    def step(self, tracked: TrackedContact, t_s: float) -> str | None:
        """Return the event that begins with the next frame of a touch, or None if no event begins.

        A slide begins when the contact moves and is away from the position at which it last rested. A hold begins when
        the contact has rested at one position for `HOLD_TIME_s`. The same event does not occur twice in succession. If
        it is uncertain whether the contact moves or rests, no event begins.

        Args:
            tracked: Tracked contact of the frame. Its attribute `moving` is the probability that the contact moves.
            t_s: Time of the frame, s.
        """
        self._correct_for_clock(t_s)
        position = complex(tracked.x_mm, tracked.y_mm)
        is_away = abs(position - self._rest_position) > SLIDE_DISTANCE_mm
        if tracked.moving > SLIDE_PROBABILITY:
            if is_away and self._latest_event != "slide":
                self._latest_event = "slide"
                return "slide"
        elif tracked.moving < REST_PROBABILITY:
            if is_away:  # the contact rests at another position than before
                self._rest_position = position
                self._rest_begin_s = t_s
            elif self._latest_event != "hold" and t_s - self._rest_begin_s >= HOLD_TIME_s:
                self._latest_event = "hold"
                return "hold"
        return None

    def end(self, t_s: float) -> str:
        """Return the event with which a touch ends: `tap` or `release`.

        A touch ends with a tap if the touch was short, and no other event has followed the press.

        Args:
            t_s: Time of the first frame without a contact, s.
        """
        self._correct_for_clock(t_s)
        is_short = t_s - self._press_s <= MAX_TAP_TIME_s
        if self._latest_event == "press" and is_short:
            return "tap"
        return "release"

    def _correct_for_clock(self, t_s: float) -> None:
        """Store the time of the next frame. If the clock was set back, set the stored times back by the same amount.

        Args:
            t_s: Time of the frame, s.
        """
        set_back_s = max(self._latest_frame_s - t_s, 0.0)
        self._press_s -= set_back_s
        self._rest_begin_s -= set_back_s
        self._latest_frame_s = t_s
