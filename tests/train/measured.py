"""Measured presses for tests, with the same standard deviations for all presses."""

from dataclasses import replace

import numpy as np

from isocharge.serve import MeasuredPresses


def measured_presses(contact, charge, names=("A", "B", "C")):
    """Return measured presses with standard deviations of 0.05 mm and 0.5 % of the force, in the lines of a file."""
    count = len(contact)
    return MeasuredPresses(
        contact=contact,
        charge_pC=charge,
        position_std_mm=np.full(count, 0.05),
        force_std=np.full(count, 0.005),
        electrodes=names,
        lines=tuple(range(2, count + 2)),
    )


def with_samples(dataset, **columns):
    """Return a dataset with other values in some columns of its samples."""
    return replace(dataset, samples=replace(dataset.samples, **columns))
