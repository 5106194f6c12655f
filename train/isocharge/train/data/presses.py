"""Which samples train and which measure: split by position, so that no press is seen twice under another force."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.simulate.dataset.shards import Dataset, Samples
from isocharge.train.data.domain import ContactDomain

FEWEST = 500
"""Presses below which a fit makes no sense."""

FEWEST_POSITIONS = 50
"""The same for positions."""


@dataclass(frozen=True)
class LabelledPresses:
    """Contacts and their clean charges.

    Attributes:
        contact: (x_mm, y_mm, force_N), shape (n, 3).
        charge_pC: Shape (n, n_electrode).
    """

    contact: Array
    charge_pC: Array

    @classmethod
    def of(cls, samples: Samples) -> "LabelledPresses":
        """From a dataset's columns."""
        return cls(np.stack([samples.x_mm, samples.y_mm, samples.force_N], axis=1), samples.charge_pC)

    def __getitem__(self, rows: np.ndarray) -> "LabelledPresses":
        return LabelledPresses(self.contact[rows], self.charge_pC[rows])

    def __len__(self) -> int:
        return len(self.contact)


def domain_of(dataset: Dataset) -> ContactDomain:
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
    return ContactDomain(radius, (low, high))


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
        DatasetError: If the dataset has too few presses or positions, fewer than three electrodes, or numbers that are
            not finite or charges that are not positive.
    """
    presses = LabelledPresses.of(dataset.samples)
    _check(presses, fewest)
    return presses


def _check(presses: LabelledPresses, fewest: int) -> None:
    finite = np.isfinite(presses.charge_pC).all(axis=1) & np.isfinite(presses.contact).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise DatasetError(
            f"sample {row}: expected finite numbers, got the contact {presses.contact[row].tolist()} (mm, mm, N) and "
            f"{presses.charge_pC[row].tolist()} pC"
        )
    positions = len(np.unique(np.round(presses.contact[:, :2], 3), axis=0))
    if len(presses) < fewest or positions < min(fewest, FEWEST_POSITIONS):
        raise DatasetError(
            f"expected at least {fewest} presses at {min(fewest, FEWEST_POSITIONS)} positions, got {len(presses)} at "
            f"{positions}; sweep or measure more (from 50 measured presses on, train on a CSV file with --sensor)"
        )
    if presses.charge_pC.shape[1] < 3:
        raise DatasetError(
            f"expected at least three electrodes to find x, y and force, got {presses.charge_pC.shape[1]}"
        )
    wrong = np.flatnonzero((presses.charge_pC <= 0.0).any(axis=1) | (presses.contact[:, 2] <= 0.0))
    if wrong.size:
        row = int(wrong[0])
        raise DatasetError(
            f"sample {row}: expected positive force and charges (the features are logarithms), got "
            f"{presses.contact[row, 2]:g} N and {presses.charge_pC[row].tolist()} pC"
        )


def position_error(contact: Array, truth: Array) -> Array:
    """Distance between estimated and true position, mm, shape (n,), from contacts of shape (n, 3)."""
    distance: Array = np.hypot(contact[:, 0] - truth[:, 0], contact[:, 1] - truth[:, 1])
    return distance
