"""Measured presses as training takes them: as a dataset, and which of them are held out.

There is one split for all: a fifth of the positions, chosen by their coordinates alone. So a model that was trained on
a file of presses is judged, by whatever command, on presses of the file that it never saw.
"""

from collections.abc import Sequence

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import PressError
from isocharge.common.files import sha256_of
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.dataset.shards import Dataset, Samples
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor

HELD_SHARE = 0.2
"""Share of measured presses that is held out, dimensionless."""

FEWEST_HELD = 10
"""Held-out presses at least, however few there are: fewer give no figure worth its name."""

FEWEST_MEASURED = 50
"""Measured presses at least for a training or a report."""


def held_out(contact: Array) -> Booleans:
    """Which measured presses are held out, shape (n,), from contacts (x, y, F), shape (n, 3), mm and N.

    Presses at one position are held out together: neighbours in force would tell too much. The order in which positions
    are taken follows from their coordinates, so that it is the same in every part of the presses.
    """
    positions, number, counts = np.unique(
        np.round(contact[:, :2], 3) + 0.0, axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort([sha256_of(position.tobytes()) for position in positions])
    enough = max(HELD_SHARE * len(contact), min(FEWEST_HELD, 0.5 * len(contact)))
    before = np.cumsum(counts[order]) - counts[order]
    return np.asarray(np.isin(number.ravel(), order[before < enough]))


def dataset_of(presses: MeasuredPresses, sensor: Sensor, probe: Probe) -> Dataset:
    """Measured presses as a dataset; those with an unknown place, force or charge are left out.

    Raises:
        PressError: If fewer than `FEWEST_MEASURED` remain.
    """
    whole = presses[complete(presses)]
    check_enough(len(whole), len(presses), sensor.name)
    x_mm, y_mm, force_N = whole.contact.T
    count = len(whole)
    samples = Samples(x_mm, y_mm, force_N, np.full(count, probe.notation), np.zeros(count), whole.charge_pC)
    return Dataset(sensor, samples, {}, presses_sha256(whole))


def complete(presses: MeasuredPresses) -> Booleans:
    """Presses of which place, force and every charge are known, shape (n,)."""
    return np.asarray(np.isfinite(presses.contact).all(axis=1) & np.isfinite(presses.charge_pC).all(axis=1))


def check_enough(count: int, of: int, sensor: str) -> None:
    """Raise PressError if there are too few measured presses to train on and to measure by."""
    if count < FEWEST_MEASURED:
        raise PressError(
            f"expected at least {FEWEST_MEASURED} presses with known place, force and charges, positive and within the "
            f"model's forces and radius, got {count} of {of}; fewer calibrate a film: isocharge train calibrate "
            f"PRESSES.csv --sensor {sensor} -o FOLDER"
        )


def presses_sha256(presses: MeasuredPresses) -> str:
    """Checksum of the presses' numbers."""
    columns: Sequence[Array] = (presses.contact, presses.charge_pC, presses.position_std_mm, presses.force_std)
    return sha256_of(np.column_stack(columns).tobytes())
