"""Charges of a touch near its largest force.

A film is followed with one set of charges of each touch. A single frame has the noise of one reading. Therefore the
charges of several frames are averaged, namely of frames whose contact is close to the contact with the largest force.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.prediction.contact import Contact, is_close

MAX_AVERAGED_FRAMES = 64
"""Largest number of frames that are averaged.

The average of 64 frames has an eighth of the noise of a frame. Longer averages would gain little, and slow changes of
the charges, such as creep, would affect them more.
"""


class TouchPeak:
    """Average charges of the frames of a touch in which the force is close to its largest value.

    The first frame is the reference. A frame with a clearly larger force becomes the new reference, and the average
    starts again. A frame whose contact is close to the contact of the reference is added to the average. All other
    frames are ignored.
    """

    def __init__(self, contact: Contact, charge_pC: Array) -> None:
        """Start with the first frame of a touch.

        Args:
            contact: Contact that the model computed for the frame.
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC.
        """
        self._start_average(contact, charge_pC)

    def add_frame(self, contact: Contact, charge_pC: Array) -> None:
        """Process another frame of the touch.

        Args:
            contact: Contact that the model computed for the frame.
            charge_pC: Touch charges of the frame, shape (n_electrode,), pC.
        """
        if is_close(contact, self._reference_contact):
            if self._frame_count < MAX_AVERAGED_FRAMES:
                self._charge_sum_pC = self._charge_sum_pC + charge_pC
                self._frame_count += 1
        elif contact.force_N > self._reference_contact.force_N:
            self._start_average(contact, charge_pC)

    @property
    def mean_charge_pC(self) -> Array:
        """Average of the touch charges, shape (n_electrode,), pC."""
        return np.asarray(self._charge_sum_pC / self._frame_count)

    def _start_average(self, contact: Contact, charge_pC: Array) -> None:
        """Make a frame the reference and the only frame of the average."""
        self._reference_contact = contact
        self._charge_sum_pC = charge_pC
        self._frame_count = 1
