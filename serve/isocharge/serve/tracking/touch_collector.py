"""Touches that are used to follow a film, collected from the frames of a stream.

Each touch is described by its average charges near the largest force; see `TouchPeak`. A touch is not used if its
frames have flags that make the charges unreliable.
"""

from collections import deque
from typing import NamedTuple

from isocharge.common.arrays import Array
from isocharge.serve.flags import BEYOND, GAP, MISFIT, OUTSIDE, REPEAT, STRESS
from isocharge.serve.prediction.contact import Contact
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.tracking.touch_misfits import relative_misfit_std
from isocharge.serve.tracking.touch_peak import TouchPeak

UNUSED_FRAME_FLAGS = frozenset({OUTSIDE, BEYOND, STRESS, GAP, REPEAT})
"""Flags of frames that are not used, although the other frames of the same touch may be used.

The first and the last frames of every touch have the flag OUTSIDE. GAP and REPEAT only mean that frames were lost.
"""

HARMLESS_FLAGS = UNUSED_FRAME_FLAGS | {MISFIT}
"""Flags that do not make the touch of a frame unusable.

The noise of a single frame may cause the flag MISFIT. Therefore the misfit of the average charges of the touch decides
whether the touch is used.
"""

MISFIT_WINDOW = 12
"""Number of the latest touches that determine whether touches with the flag MISFIT are used.

If a few touches have the flag, they are probably faulty, for example because two fingers touched the film. If more than
half of the touches have the flag, the film has probably changed, and the touches show how.
"""


class ObservedTouch(NamedTuple):
    """A touch, described by its charges near the largest force.

    Attributes:
        contact: Contact that the model computed from the charges.
        charge_pC: Touch charges, averaged over the frames with about the largest force, shape (n_electrode,), pC.
        misfit_std: Root mean square misfit of good touches with as little noise as this touch, relative to the root
            mean square misfit of single frames of good touches.
    """

    contact: Contact
    charge_pC: Array
    misfit_std: float = 1.0


class TouchCollector:
    """Collector of the frames of touches, which decides whether a touch is used."""

    def __init__(self) -> None:
        """Start without a touch."""
        self.reset()

    def reset(self) -> None:
        """Discard all frames and touches."""
        self._recent_misfit_flags: deque[bool] = deque(maxlen=MISFIT_WINDOW)  # of all touches, used or not
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

    def end_touch(self, predictor: Predictor) -> ObservedTouch | None:
        """End the present touch, and return it unless it is unusable.

        A touch is unusable if one of its frames has a flag that is not harmless, or if no frame was averaged. A touch
        whose average charges no contact explains is only used if this applies to most of the latest touches.

        Args:
            predictor: Model of the film with the estimated pretension.

        Returns:
            The touch; None if there is no usable touch.
        """
        peak = self._peak if self._is_touch_usable else None
        self.discard_touch()
        if peak is None:
            return None

        charge_pC = peak.mean_charge_pC
        contact = predictor.predict(charge_pC)
        has_misfit = MISFIT in predictor.flags(contact)
        self._recent_misfit_flags.append(has_misfit)
        is_misfit_common = sum(self._recent_misfit_flags) > MISFIT_WINDOW // 2
        if has_misfit and not is_misfit_common:
            return None

        frame_variance_pC2 = predictor.metadata.noise.variance(charge_pC)
        misfit_std = relative_misfit_std(peak.relative_noise_variance(frame_variance_pC2))
        return ObservedTouch(contact, charge_pC, misfit_std)
