"""Charges of a touch near its largest force.

A film is followed with one set of charges of each touch. A single frame has the noise of one reading. Therefore the
charges of several frames are averaged, namely of frames whose contact is close to the contact with the largest force.

A touch is not used if its frames have flags that make the charges unreliable.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import BEYOND, GAP, MISFIT, OUTSIDE, REPEAT, STRESS
from isocharge.serve.model.contact import Contact, is_close

MAX_AVERAGED_FRAMES = 64
"""Largest number of frames that are averaged.

The average of 64 frames has an eighth of the noise of a frame. Longer averages would gain little, and slow changes of
the charges, such as creep, would affect them more.
"""


UNUSED_FRAME_FLAGS = frozenset({OUTSIDE, BEYOND, STRESS, GAP, REPEAT})
"""Flags of frames that are not used, although the other frames of the same touch may be used.

The first and the last frames of every touch have the flag OUTSIDE. GAP and REPEAT only mean that frames were lost.
"""

HARMLESS_FLAGS = UNUSED_FRAME_FLAGS | {MISFIT}
"""Flags that do not make the touch of a frame unusable.

If the film has changed, frames have the flag MISFIT. The estimate of the state of the film gives little weight to
touches that no contact explains.
"""


class TouchPeak:
    """Average charges of the frames of a touch in which the force is close to its largest value.

    The first frame is the reference. A frame with a clearly larger force becomes the new reference, and the average
    starts again. A frame whose contact is close to the contact of the reference is added to the average. All other
    frames are ignored.
    """

    def __init__(self) -> None:
        """Start without a frame."""
        self._reference_contact: Contact | None = None
        self._averaged_charges_pC: list[Array] = []
        self._is_reliable = True  # whether all flags so far are harmless

    @property
    def is_usable(self) -> bool:
        """Whether at least one frame was averaged, and all flags of the touch are harmless."""
        return self._is_reliable and bool(self._averaged_charges_pC)

    def add_frame(self, contact: Contact, charge_pC: Array, flags: tuple[str, ...] = ()) -> None:
        """Process the next frame of the touch.

        Frames with a flag in `UNUSED_FRAME_FLAGS` are not averaged. A flag that is not harmless makes the whole touch
        unusable.

        Args:
            contact: Contact that the model computed for the frame.
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC.
            flags: Flags of the frame.
        """
        if not HARMLESS_FLAGS.issuperset(flags):
            self._is_reliable = False
        if not UNUSED_FRAME_FLAGS.isdisjoint(flags):
            return
        reference = self._reference_contact
        if is_close(contact, reference):
            if len(self._averaged_charges_pC) < MAX_AVERAGED_FRAMES:
                self._averaged_charges_pC.append(charge_pC)
        elif reference is None or contact.force_N > reference.force_N:
            self._reference_contact = contact
            self._averaged_charges_pC = [charge_pC]

    @property
    def mean_charge_pC(self) -> Array:
        """Average of the touch charges, shape (n_electrode,), pC."""
        return np.asarray(np.mean(self._averaged_charges_pC, axis=0))
