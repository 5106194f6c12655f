"""Tests of the average charges of a touch near its largest force."""

import numpy as np

from isocharge.serve.model.contact import Contact
from isocharge.serve.tracking.film_follower import TouchPeak


def contact(force_N):
    """Return a contact with a force; the other values do not matter."""
    return Contact(1.0, 0.0, force_N, x_std_mm=0.1, y_std_mm=0.1, force_std_N=0.01, misfit=0.5)


def peak_of(contacts, charges):
    """Return the peak of a touch with these contacts and charges of its frames."""
    peak = TouchPeak()
    for frame_contact, charge in zip(contacts, charges, strict=True):
        peak.add_frame(frame_contact, np.array(charge))
    return peak


def test_only_the_frames_near_the_largest_force_are_averaged():
    forces_N = [0.2, 0.6, 1.0, 1.02, 0.98, 0.6, 0.2]
    charges = [[100.0 * force_N, 50.0 * force_N] for force_N in forces_N]
    peak = peak_of([contact(force_N) for force_N in forces_N], charges)
    np.testing.assert_allclose(peak.mean_charge_pC, [100.0, 50.0])
