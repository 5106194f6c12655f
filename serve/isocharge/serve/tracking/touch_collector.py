"""Touches that are used to follow a film, collected from the frames of a stream.

Each touch is described by its average charges near the largest force; see `TouchPeak`. A touch is not used if its
frames have flags that make the charges unreliable.
"""

from isocharge.common.arrays import Array
from isocharge.serve.flags import BEYOND, GAP, MISFIT, OUTSIDE, REPEAT, STRESS
from isocharge.serve.prediction.contact import Contact
from isocharge.serve.tracking.touch_peak import TouchPeak

UNUSED_FRAME_FLAGS = frozenset({OUTSIDE, BEYOND, STRESS, GAP, REPEAT})
"""Flags of frames that are not used, although the other frames of the same touch may be used.

The first and the last frames of every touch have the flag OUTSIDE. GAP and REPEAT only mean that frames were lost.
"""

HARMLESS_FLAGS = UNUSED_FRAME_FLAGS | {MISFIT}
"""Flags that do not make the touch of a frame unusable.

If the film has changed, frames have the flag MISFIT. The estimate of the state of the film gives little weight to
touches that no contact explains.
"""


class TouchCollector:
    """Collector of the frames of touches, which decides whether a touch is used."""

    def __init__(self) -> None:
        """Start without a touch."""
        self.reset()

    def reset(self) -> None:
        """Discard all frames and touches."""
        self.discard_touch()

    def discard_touch(self) -> None:
        """Discard the frames of the present touch."""
        self._peak: TouchPeak | None = None
        self._is_touch_usable = True

    def add_frame(self, contact: Contact, charge_pC: Array, flags: tuple[str, ...]) -> None:
        """Add a frame to the present touch.

        Frames with a flag in `UNUSED_FRAME_FLAGS` are not averaged. A flag that is not harmless makes the whole touch
        unusable.

        Args:
            contact: Contact that the model computed from the charges.
            charge_pC: Touch charges, shape (n_electrode,), pC.
            flags: Flags of the frame.
        """
        if not HARMLESS_FLAGS.issuperset(flags):
            self._is_touch_usable = False
            return
        if not UNUSED_FRAME_FLAGS.isdisjoint(flags):
            return

        if self._peak is None:
            self._peak = TouchPeak(contact, charge_pC)
        else:
            self._peak.add_frame(contact, charge_pC)

    def end_touch(self) -> TouchPeak | None:
        """End the present touch, and return its average charges.

        Returns:
            The average charges; None if one frame has a flag that is not harmless, or if no frame was averaged.
        """
        peak = self._peak if self._is_touch_usable else None
        self.discard_touch()
        return peak
