"""Charges of a touch near its largest force.

A film is followed with one set of charges of each touch. A single frame has the noise of one reading. Therefore the
charges of several frames are averaged, namely of frames whose contact is close to the contact with the largest force.

The average has less noise than a frame only if the noise differs from frame to frame. The frames themselves show how
much of the noise does: if a board filters its signals, for example, successive frames are nearly equal. A touch is not
used if its frames have flags that make the charges unreliable.
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

    def relative_noise_variance(self, frame_variance_pC2: Array) -> float:
        """Estimate the variance of the noise of the average charges, relative to the variance for a single frame.

        One part of the noise of a frame is independent of the other frames, and the average of n frames has a variance
        of 1/n of this part. The other part is equal in all frames, and the average does not reduce it. The variance of
        the independent part is half the mean squared difference of successive frames (von Neumann 1941).

        Args:
            frame_variance_pC2: Variance of the noise of a single frame, shape (n_electrode,), pC^2.

        Returns:
            Ratio of the variances, averaged over the electrodes, from 1/n to 1.
        """
        frame_count = len(self._averaged_charges_pC)
        if frame_count == 1:
            return 1.0
        difference_pC = np.diff(self._averaged_charges_pC, axis=0)  # of successive frames, shape (n - 1, n_electrode)
        independent_variance_pC2 = 0.5 * (difference_pC**2).mean(axis=0)
        independent_share = min(float((independent_variance_pC2 / frame_variance_pC2).mean()), 1.0)
        return 1.0 - independent_share + independent_share / frame_count
