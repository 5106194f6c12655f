"""Presses for training and presses for measuring errors, split by position.

All presses at one position belong to the same part. If a test contained positions of the training, the measured errors
would be too small. Measured presses are always split in the same way, because the coordinates of the presses determine
which fifth of the presses is held out. Every command therefore measures errors on the same presses of a file.
"""

from dataclasses import dataclass

import numpy as np
from msgspec import Struct
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import DatasetError, PressError, cut, shown
from isocharge.common.files import sha256_of
from isocharge.common.structs import Positive, convert
from isocharge.serve.presses.measured_presses import CONTACT, MeasuredPresses, PLACE_STEP_mm
from isocharge.simulate import Dataset, Domain, Probe, Samples, Sensor
from isocharge.simulate.numerics.disk import log_spaced_forces
from isocharge.train.data.channel_noise import Noise

LOWEST_CHARGE = 1.0
"""Usual lower limit of charges before their logarithm is computed, pC.

The limit is lower if presses have smaller charges that exceed the noise."""

HIGHEST_CHARGE = 1e6
"""Upper limit of charges before their logarithm is computed, pC. Larger charges are set to this value."""

SOLVER = "solver"
"""Name of a manifest entry. Every simulated dataset has this entry, and no measured dataset has it."""

YIELD_FORCE = "yield_force_N"
"""Name of the manifest entry with the force at which the film yields."""

MIN_PRESSES = 500
"""Smallest number of presses for a fit."""

MIN_PLACES = 50
"""Smallest number of places for a fit, and smallest number of measured presses for training or for measuring errors."""


@dataclass(frozen=True)
class LabelledPresses:
    """Contacts with their measured or simulated charges.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Charges, shape (n, n_electrode), pC.
    """

    contact: Array
    charge: Array

    @classmethod
    def of(cls, samples: Samples) -> "LabelledPresses":
        """Return the contacts and charges of samples without checking them."""
        return cls(np.column_stack([samples.x_mm, samples.y_mm, samples.force_N]), samples.charge_pC)

    def __getitem__(self, rows: np.ndarray | slice) -> "LabelledPresses":
        """Return some of the presses."""
        return LabelledPresses(self.contact[rows], self.charge[rows])

    def __len__(self) -> int:
        return len(self.contact)

    @property
    def has_nonpositive_charges(self) -> bool:
        """Whether at least one charge is zero or negative, so that it has no logarithm."""
        return bool((self.charge <= 0.0).any())

    @property
    def distance(self) -> Array:
        """Distance of each press from the centre, shape (n,), mm."""
        return np.hypot(self.contact[:, 0], self.contact[:, 1])

    @property
    def domain(self) -> Domain:
        """Smallest disk around the centre, and smallest range of forces, that contain all presses."""
        force = self.contact[:, 2]
        return Domain(float(self.distance.max()), (float(force.min()), float(force.max())))

    def within(self, radius: float) -> "LabelledPresses":
        """Return the presses whose distance from the centre is at most `radius`, mm."""
        return self[self.distance <= radius]

    def repeated(self, min_count: int) -> "LabelledPresses":
        """Return at least `min_count` presses, by repeating all presses in their order.

        Args:
            min_count: Smallest number of presses to return. If there are more presses, each press is returned once.
        """
        count = max(min_count, len(self))
        return self[np.arange(count) % len(self)]

    def noisy(self, noise: Noise, seed: int) -> Array:
        """Return the charges with random noise, shape (n, n_electrode), pC. The seed determines the noise."""
        return noise.add(self.charge, np.random.default_rng(seed))


def is_measured(dataset: Dataset) -> bool:
    """Return whether a dataset was measured. The manifest of a measured dataset has no settings of a simulator."""
    return SOLVER not in dataset.manifest


def draw_contacts(rng: np.random.Generator, domain: Domain, count: int) -> Array:
    """Draw contacts with positions uniformly distributed over a disk and with log-uniform forces.

    The squared distances from the centre are uniformly distributed, because the area grows with the square of the
    distance.

    Args:
        rng: Random number generator.
        domain: Disk and range of forces.
        count: Number of contacts.

    Returns:
        Contacts (x, y, F), shape (count, 3), mm and N.
    """
    distance = domain.radius * np.sqrt(rng.random(count))
    place = distance * np.exp(2j * np.pi * rng.random(count))  # x + i y
    force = log_spaced_forces(rng.random(count), domain.force_range)
    return np.column_stack([place.real, place.imag, force])


class _Ranges(Struct):
    """Ranges of the contacts in a manifest."""

    radius_mm: Positive
    force_N: tuple[Positive, Positive]


def domain_of(dataset: Dataset) -> Domain:
    """Return the working area and the range of forces of a simulated dataset, which its manifest states.

    Args:
        dataset: The dataset.

    Raises:
        DatasetError: If the ranges in the manifest are missing, are not numbers or do not contain the samples.
    """
    ranges = convert(dataset.manifest.get("ranges", {}), _Ranges, "manifest ranges", DatasetError)
    domain = Domain(ranges.radius_mm, ranges.force_N)
    presses = LabelledPresses.of(dataset.samples)
    if not domain.contains(presses.contact).all():
        needed = presses.domain  # smallest domain that contains the samples
        min_force, max_force = needed.force_range
        raise DatasetError(
            f"manifest ranges: radius_mm {domain.radius:g} and force_N {domain.force_range} do not hold the samples, "
            f"which reach {needed.radius:g} mm and {min_force:g} to {max_force:g} N"
        )
    return domain


def split_by_position(presses: LabelledPresses, share: float) -> tuple[LabelledPresses, LabelledPresses]:
    """Split presses into two parts. All presses at one position belong to the same part.

    Args:
        presses: The presses.
        share: Share of the positions in the second part, 0 to 1.

    Returns:
        The first and the second part.
    """
    is_in_second = position_ranks(presses.contact) < share
    return presses[~is_in_second], presses[is_in_second]


def place_count(contact: Array) -> int:
    """Return the number of different positions of contacts (x, y, F), shape (n, 3), after rounding to 1 um."""
    return len(np.unique(np.round(contact[:, :2], 3), axis=0))


def merged_places(contact: Array, step_mm: float = PLACE_STEP_mm) -> Array:
    """Move the positions of all presses at one place to their mean, and return the contacts (x, y, F), shape (n, 3).

    The encoders of a stage report slightly different positions of one place. Positions belong to one place if steps of
    at most `step_mm` connect them, and if their rms distance from their mean is at most `step_mm`.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        step_mm: Largest step, mm.
    """
    # Round the positions to a grid that is finer than a step. This limits the number of pairs below if many presses are
    # at one place.
    position = contact[:, :2]
    grid_mm = 0.25 * step_mm
    cells, cell_of_press = np.unique(np.round(position / grid_mm), axis=0, return_inverse=True)

    # Connect cells whose distance is at most a step. Cells that are connected by a chain of such steps form a place.
    pairs = cKDTree(cells * grid_mm).query_pairs(step_mm, output_type="ndarray")
    steps = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
    _, place_of_cell = connected_components(steps, directed=False)
    place_of_press = place_of_cell[cell_of_press.ravel()]  # some versions of NumPy return two axes

    def mean_of_place(values: Array) -> Array:
        """Return for each press the mean of the values, shape (n,), over all presses at its place."""
        means = np.bincount(place_of_press, values) / np.bincount(place_of_press)  # sum / count, one for each place
        return np.asarray(means[place_of_press])

    # Keep the original positions of places that are too large.
    mean_position = np.column_stack([mean_of_place(coordinate) for coordinate in position.T])
    mean_squared_distance = mean_of_place(((position - mean_position) ** 2).sum(axis=1))
    is_small = mean_squared_distance <= step_mm**2
    merged_position = np.where(is_small[:, None], mean_position, position)
    return np.column_stack([merged_position, contact[:, 2]])


def position_ranks(contact: Array) -> Array:
    """Order the positions of presses, and return the rank of the position of each press.

    The positions are ordered by the checksums of their coordinates. The order is random but the same in every run, and
    the order of two positions does not depend on the other positions.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Ranks divided by the number of positions, from 0 to 1 (excluded), shape (n,).
    """
    rounded_position = np.round(contact[:, :2], 3) + 0.0  # the addition converts -0.0 into 0.0
    positions, position_of_press = np.unique(rounded_position, axis=0, return_inverse=True)
    order = np.argsort([sha256_of(position.tobytes()) for position in positions])
    rank = np.argsort(order) / len(order)  # the inverse of a permutation is the order of its elements
    return rank[position_of_press.ravel()]  # some versions of NumPy return two axes


def presses_of(dataset: Dataset, fewest: int = MIN_PRESSES) -> LabelledPresses:
    """Return the presses of a dataset after checking them.

    Args:
        dataset: The dataset.
        fewest: Smallest number of presses that is accepted.

    Returns:
        Contacts and charges of the presses.

    Raises:
        DatasetError: If the dataset has too few presses, fewer than `MIN_PLACES` positions or three electrodes, or if
            the charge of an electrode never varies.
    """
    presses = LabelledPresses.of(dataset.samples)
    # The position of a press is its place (x, y).
    n_position = place_count(presses.contact)
    if len(presses) < fewest or n_position < MIN_PLACES:
        raise DatasetError(
            f"expected at least {fewest} presses at {MIN_PLACES} positions, got {len(presses)} at "
            f"{n_position}; sweep or measure more (of a described film, `isocharge train calibrate` needs only a few)"
        )

    n_electrode = presses.charge.shape[1]
    if n_electrode < 3:
        raise DatasetError(f"expected at least three electrodes to find x, y and force, got {n_electrode}")
    for name, charge in zip(dataset.sensor.electrode_names, presses.charge.T, strict=True):
        if np.ptp(charge) == 0.0:
            raise DatasetError(f"electrode {name!r}: expected charges that vary, got {charge[0]:g} pC everywhere")
    return presses


N_FOLDS = 5
"""Number of parts into which measured presses are split. One part is held out to measure errors.

A cross-validation trains the same number of networks.
"""


def dataset_of(presses: MeasuredPresses, sensor: Sensor, probe: Probe) -> Dataset:
    """Convert measured presses into a dataset. Presses with an unknown place, force or charge are left out.

    Args:
        presses: The measured presses.
        sensor: Sensor on which the presses were made.
        probe: Probe with which the presses were made.

    Raises:
        PressError: If a column is missing, or fewer than `MIN_PLACES` presses remain.
    """
    check_known_columns(presses)
    complete_presses = presses[complete(presses)]
    count = len(complete_presses)
    check_enough(count, len(presses), sensor.name)
    x_mm, y_mm, force_N = merged_places(complete_presses.contact).T
    probe_column = np.full(count, probe.notation)
    # The notation of the probe does not contain its rotation, so the rotation has a column of its own, 0 to 360 deg.
    orientation_deg = np.full(count, np.rad2deg(probe.angle) % 360.0)
    samples = Samples(x_mm, y_mm, force_N, probe_column, orientation_deg, complete_presses.charge_pC)
    sha256 = presses_sha256(complete_presses)
    return Dataset(sensor, samples, manifest={}, sha256=sha256)  # measured presses have no settings of a simulator


def have_charges_of(charge: Array, others: Array) -> Booleans:
    """Return whether each press has the same charges as at least one of the other presses, shape (n,).

    Args:
        charge: Charges of the presses, shape (n, n_electrode), pC.
        others: Charges of the other presses, shape (m, n_electrode), pC.
    """
    return np.asarray((charge[:, None] == others).all(axis=2).any(axis=1))


def have_charges_of_earlier(charge: Array) -> Booleans:
    """Return whether each press has the same charges as an earlier press, and is therefore a copy, shape (n,).

    Args:
        charge: Charges of the presses, shape (n, n_electrode), pC. A press with an unknown charge is not a copy.
    """
    _, first_rows = np.unique(charge, axis=0, return_index=True)
    return ~np.isin(np.arange(len(charge)), first_rows)


def complete(presses: MeasuredPresses) -> Booleans:
    """Return whether each press has a known place, a known force and a known charge of every electrode, shape (n,)."""
    return presses.placed & np.isfinite(presses.charge_pC).all(axis=1)


def check_known_columns(presses: MeasuredPresses) -> None:
    """Raise an error if the place, the force or a charge is unknown for all presses.

    Raises:
        PressError: If a column is missing or empty. The message names the column.
    """
    columns = presses.columns
    unknown = [name for name in (*CONTACT, *presses.electrodes) if np.isnan(columns[name]).all()]
    if unknown:
        names = cut(", ".join(map(shown, unknown)))
        raise PressError(
            f"expected presses with known place, force and charges, got a file without the column {names}, or with "
            f"only empty cells in it; add the column {names}"
        )


def check_enough(count: int, total_count: int, sensor: str) -> None:
    """Raise an error if there are too few measured presses for training and for measuring errors.

    Args:
        count: Number of presses that can be used.
        total_count: Number of all presses.
        sensor: Name of the sensor, for the message.

    Raises:
        PressError: If there are fewer than `MIN_PLACES` presses that can be used.
    """
    if count < MIN_PLACES:
        raise PressError(
            f"expected at least {MIN_PLACES} presses with known place, force and charges, within the "
            f"model's forces and radius, got {count} of {total_count}; fewer calibrate a film: isocharge train "
            f"calibrate PRESSES.csv --sensor {sensor} -o FOLDER"
        )


def presses_sha256(presses: MeasuredPresses) -> str:
    """Return the checksum of the contacts, the charges and the standard deviations of measured presses."""
    table = np.column_stack([*presses.columns.values()])
    return sha256_of(table.tobytes())
