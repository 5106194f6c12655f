"""Presses to learn from and presses to measure by, split by position: none is seen twice under another force.

Of measured presses there is one split for all: a fifth of the positions, chosen by their coordinates alone. So a model
that was trained on a file of presses is judged, by whatever command, on presses of the file that it never saw.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import DatasetError, PressError
from isocharge.common.files import sha256_of
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.simulate import Dataset, Domain, Probe, Samples, Sensor
from isocharge.train.data.channel_noise import Noise

LOWEST_CHARGE, HIGHEST_CHARGE = 1.0, 1e6
"""Charges are brought between these, pC, before the logarithm: what is negative or absurd still gives a finite answer.
"""

SOLVER = "solver"
"""Entry of the manifest that every simulated dataset has, and no measured one."""

FEWEST = 500
"""Presses below which a fit makes no sense."""

FEWEST_POSITIONS = 50
"""The same for positions."""


@dataclass(frozen=True)
class LabelledPresses:
    """Contacts and their charges.

    Attributes:
        contact: (x, y, F), shape (n, 3), mm and N.
        charge: Shape (n, n_electrode), pC.
        measured: Whether the charges were measured, so that they have noise of their own.
    """

    contact: Array
    charge: Array
    measured: bool = False

    @classmethod
    def of(cls, dataset: Dataset) -> "LabelledPresses":
        """All presses of a dataset, unchecked."""
        samples = dataset.samples
        contact = np.stack([samples.x_mm, samples.y_mm, samples.force_N], axis=1)
        return cls(contact, samples.charge_pC, is_measured(dataset))

    def __getitem__(self, rows: np.ndarray) -> "LabelledPresses":
        return LabelledPresses(self.contact[rows], self.charge[rows], self.measured)

    def __len__(self) -> int:
        return len(self.contact)

    @property
    def signed(self) -> bool:
        """Whether some charge is not positive, so that it has no logarithm."""
        return bool((self.charge <= 0.0).any())

    def within(self, radius: float) -> "LabelledPresses":
        """Those up to a distance from the centre, mm."""
        return self[np.hypot(self.contact[:, 0], self.contact[:, 1]) <= radius]

    def noisy(self, noise: Noise, seed: int) -> Array:
        """The charges with noise added, shape (n, n_electrode), pC."""
        return noise.add(self.charge, np.random.default_rng(seed))


def is_measured(dataset: Dataset) -> bool:
    """Whether a dataset was measured: its manifest has no settings of a simulator."""
    return SOLVER not in dataset.manifest


def draw_contacts(rng: np.random.Generator, domain: Domain, count: int) -> Array:
    """Contacts (x, y, F), shape (count, 3), mm and N: uniform over the disk, forces log-uniform."""
    radius, angle = domain.radius * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    low, high = np.log(domain.force_range)
    force = np.exp(rng.uniform(low, high, count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), force], axis=1)


def domain_of(dataset: Dataset) -> Domain:
    """The working area and forces that the dataset covers: as its manifest says, or else as its samples show.

    Raises:
        DatasetError: If the manifest's ranges are no numbers or do not hold the samples.
    """
    samples, ranges = dataset.samples, dataset.manifest.get("ranges", {})
    reach, forces = np.hypot(samples.x_mm, samples.y_mm).max(), (samples.force_N.min(), samples.force_N.max())
    try:
        radius = float(ranges.get("radius_mm", reach))
        low, high = (float(force) for force in ranges.get("force_N", forces))
    except (AttributeError, TypeError, ValueError) as error:
        raise DatasetError(f"manifest ranges: expected radius_mm and force_N [MIN, MAX], got {ranges!r}") from error
    if not (reach <= radius * (1 + 1e-9) and 0.0 < low <= forces[0] * (1 + 1e-9) and forces[1] <= high * (1 + 1e-9)):
        raise DatasetError(
            f"manifest ranges: radius_mm {radius:g} and force_N [{low:g}, {high:g}] do not hold the samples, which "
            f"reach {reach:g} mm and {forces[0]:g} to {forces[1]:g} N"
        )
    return Domain(radius, (low, high))


def split_by_position(presses: LabelledPresses, share: float, seed: int) -> tuple[LabelledPresses, LabelledPresses]:
    """The presses at all but a share of the positions, and those at the share."""
    _, position = np.unique(np.round(presses.contact[:, :2], 6), axis=0, return_inverse=True)
    order = np.random.default_rng(seed).permutation(position.max() + 1)
    held = np.isin(position.ravel(), order[: max(1, round(share * order.size))])
    return presses[~held], presses[held]


def presses_of(dataset: Dataset, fewest: int = FEWEST) -> LabelledPresses:
    """A dataset's presses, checked.

    Args:
        dataset: The dataset.
        fewest: Presses that it must have at least.

    Raises:
        DatasetError: If the dataset has too few presses or positions, fewer than three electrodes or one whose charge
            never varies, or numbers that are not finite or forces that are not positive.
    """
    presses = LabelledPresses.of(dataset)
    finite = np.isfinite(presses.charge).all(axis=1) & np.isfinite(presses.contact).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise DatasetError(
            f"sample {row}: expected finite numbers, got the contact {presses.contact[row].tolist()} (mm, mm, N) and "
            f"{presses.charge[row].tolist()} pC"
        )
    positions = len(np.unique(np.round(presses.contact[:, :2], 3), axis=0))
    if len(presses) < fewest or positions < min(fewest, FEWEST_POSITIONS):
        raise DatasetError(
            f"expected at least {fewest} presses at {min(fewest, FEWEST_POSITIONS)} positions, got {len(presses)} at "
            f"{positions}; sweep or measure more (from 50 measured presses on, train on a CSV file with --sensor)"
        )
    if presses.charge.shape[1] < 3:
        raise DatasetError(f"expected at least three electrodes to find x, y and force, got {presses.charge.shape[1]}")
    for name, charge in zip(dataset.sensor.electrode_names, presses.charge.T, strict=True):
        if np.ptp(charge) == 0.0:
            raise DatasetError(f"electrode {name!r}: expected charges that vary, got {charge[0]:g} pC everywhere")
    wrong = np.flatnonzero(presses.contact[:, 2] <= 0.0)
    if wrong.size:
        row = int(wrong[0])
        raise DatasetError(f"sample {row}: expected a positive force, got {presses.contact[row, 2]:g} N")
    return presses


def position_error(contact: Array, truth: Array) -> Array:
    """Distance between estimated and true position, mm, shape (n,), from contacts of shape (n, 3)."""
    return np.asarray(np.hypot(contact[:, 0] - truth[:, 0], contact[:, 1] - truth[:, 1]))


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
    return _before(contact) < max(HELD_SHARE * len(contact), min(FEWEST_HELD, 0.5 * len(contact)))


def folds_by_place(contact: Array, count: int) -> Integers:
    """Numbers from 0 to `count` - 1 of measured presses, shape (n,), in the order of `held_out`: a place has one."""
    return np.asarray(_before(contact) * count // len(contact), dtype=np.intp)


def _before(contact: Array) -> Integers:
    """Number of presses at positions that are taken before each press's own, shape (n,)."""
    positions, number, counts = np.unique(
        np.round(contact[:, :2], 3) + 0.0, axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort([sha256_of(position.tobytes()) for position in positions])
    before = np.empty_like(counts)
    before[order] = np.cumsum(counts[order]) - counts[order]
    return np.asarray(before[number.ravel()])


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
    return presses.placed & np.isfinite(presses.charge_pC).all(axis=1)


def check_enough(count: int, of: int, sensor: str) -> None:
    """Raise PressError if there are too few measured presses to train on and to measure by."""
    if count < FEWEST_MEASURED:
        raise PressError(
            f"expected at least {FEWEST_MEASURED} presses with known place, force and charges, within the "
            f"model's forces and radius, got {count} of {of}; fewer calibrate a film: isocharge train calibrate "
            f"PRESSES.csv --sensor {sensor} -o FOLDER"
        )


def presses_sha256(presses: MeasuredPresses) -> str:
    """Checksum of the presses' numbers."""
    columns: Sequence[Array] = (presses.contact, presses.charge_pC, presses.position_std_mm, presses.force_std)
    return sha256_of(np.column_stack(columns).tobytes())
