"""Tests of the average charges of a touch near its largest force."""

import numpy as np

from isocharge.serve.model.contact import Contact
from isocharge.serve.tracking.film_follower import TouchPeak


def test_only_the_frames_near_the_largest_force_are_averaged():
    peak = TouchPeak()
    for force_N in (0.2, 0.6, 1.0, 1.02, 0.98, 0.6, 0.2):
        contact = Contact(1.0, 0.0, force_N, x_std_mm=0.1, y_std_mm=0.1, force_std_N=0.01, misfit=0.5)
        peak.add_frame(contact, force_N * np.array([100.0, 50.0]))
    np.testing.assert_allclose(peak.mean_charge_pC, [100.0, 50.0])
