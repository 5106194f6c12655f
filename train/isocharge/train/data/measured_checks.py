"""Checks of measured presses before a network is trained on these presses.

Without these checks, the loss could become infinite or NaN during the training, or the reported errors and misfits of
the model could be meaningless.
"""

from collections.abc import Mapping

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, PressError, shown
from isocharge.common.measured_presses import CONTACT, FORCE_STD, POSITION_STD_MM, MeasuredPresses
from isocharge.simulate import Dataset
from isocharge.train.data.channel_noise import usual_size
from isocharge.train.data.measured_sensor import PressedArea

USUAL_SIZES = (1e-30, 1e30)
"""Range of the median size of the charges of a channel, pC.

Within this range, float32 numbers can represent the squares of the charges and small fractions of them.
"""

LEAST_VARIATION = 1e-6
"""Smallest range of the charges of a channel, relative to the largest size."""

LEAST_VARYING_SHARE = 0.01
"""Smallest share of the presses in which the charge of a channel differs from its most frequent value."""

USUAL_SHARE = 0.9
"""Share of the values of a column that lie in its usual range, dimensionless."""

FARTHEST = 1_000.0
"""Largest distance of a value from the median of its column, as a multiple of the usual range."""

LEAST_INDEPENDENCE = 1e-4
"""Smallest singular value of the standardised charges of independent channels, relative to the largest."""

LEAST_PARTICIPATION = 1e-2
"""Smallest coefficient of a channel that takes part in a linear dependence, relative to the largest coefficient."""


def check_measured_presses(presses: MeasuredPresses) -> None:
    """Check that a network can be trained on measured presses without unknown values.

    Args:
        presses: The presses. All positions, forces and charges are known.

    Raises:
        PressError: If the charges of a channel hardly vary or are too small or too large, if a value is far from all
            others, if channels depend linearly on each other, or if the positions enclose no area. The message names
            the channels, or the line and the column.
    """
    channels = dict(zip(presses.electrodes, presses.charge_pC.T, strict=True))
    contact_columns = dict(zip(CONTACT, presses.contact.T, strict=True))
    for name, charge in channels.items():
        _check_variation(name, charge)
        _check_size(name, charge)
    for name, values in {**contact_columns, **channels}.items():
        _check_far_value(presses, name, values, compared=values)

    # A force that is far too small is not far from the others, but its inverse is.
    force = contact_columns["force_N"]
    _check_far_value(presses, "force_N", force, compared=1.0 / force)
    _check_independence(channels)
    PressedArea.of(presses.contact)  # raises if the positions enclose no area


def check_measured_dataset(dataset: Dataset) -> None:
    """Check that a network can be trained on a dataset of measured presses, whose samples are numbered from 0.

    Args:
        dataset: The dataset.

    Raises:
        DatasetError: If `check_measured_presses` finds a fault, or if a number is too large for a file of presses.
    """
    samples = dataset.samples
    count = len(samples)
    try:
        presses = MeasuredPresses(
            contact=np.column_stack([samples.x_mm, samples.y_mm, samples.force_N]),
            charge_pC=samples.charge_pC,
            position_std_mm=np.full(count, POSITION_STD_MM),  # the checks do not use the standard deviations
            force_std=np.full(count, FORCE_STD),
            electrodes=tuple(dataset.sensor.electrode_names),
            lines=tuple(range(count)),
            row_noun="sample",
        )
        check_measured_presses(presses)
    except PressError as error:
        raise DatasetError(str(error)) from error


def _check_variation(name: str, charge: Array) -> None:
    """Raise an error if nearly all charges of a channel are equal.

    Args:
        name: Name of the channel.
        charge: Charges of the channel, shape (n,), pC.

    Raises:
        PressError: If the charges hardly vary, or vary in only a few presses.
    """
    if np.ptp(charge) <= LEAST_VARIATION * np.abs(charge).max():
        raise PressError(
            f"channel {shown(name)}: expected charges that vary, got {charge[0]:g} everywhere; leave the channel out"
        )
    values, counts = np.unique(charge, return_counts=True)
    most_frequent_value = values[counts.argmax()]
    varying_count = len(charge) - int(counts.max())
    if varying_count < LEAST_VARYING_SHARE * len(charge):
        raise PressError(
            f"channel {shown(name)}: expected charges that vary, got {most_frequent_value:g} in all but "
            f"{varying_count} of {len(charge)} presses; leave the channel out"
        )


def _check_size(name: str, charge: Array) -> None:
    """Raise an error if the charges of a channel are so small or large that their unit is probably not pC.

    Args:
        name: Name of the channel.
        charge: Charges of the channel, shape (n,), pC.

    Raises:
        PressError: If the median of the absolute charges is outside `USUAL_SIZES`.
    """
    median_size = float(usual_size(charge[:, np.newaxis])[0])
    smallest, largest = USUAL_SIZES
    if not smallest <= median_size <= largest:
        raise PressError(
            f"channel {shown(name)}: expected charges in pC, of {smallest:g} to {largest:g}, got {median_size:.3g} as "
            "the median of their sizes; check the unit of the column"
        )


def _check_far_value(presses: MeasuredPresses, name: str, values: Array, compared: Array) -> None:
    """Raise an error if a value is far from all others.

    The largest distance from the median is compared with a quantile of the distances.

    Args:
        presses: The presses, for the number of the line.
        name: The column, for the message.
        values: Values of the column, shape (n,).
        compared: Numbers that are compared, shape (n,): the values, or a function of them.

    Raises:
        PressError: If the largest distance exceeds `FARTHEST` times the usual distance.
    """
    distance = np.abs(compared - np.median(compared))
    if not distance.any():  # all values are equal
        return
    # Distances of zero are left out. If most values are equal, the usual distance would otherwise be zero.
    usual_distance = float(np.quantile(distance[distance > 0.0], USUAL_SHARE))
    row = int(distance.argmax())
    if distance[row] > FARTHEST * usual_distance:
        raise PressError(
            f"{presses.row_noun} {presses.lines[row]}, column {shown(name)}: expected a value of the size of the "
            f"others, whose median is {np.median(values):.3g}, got {values[row]:.6g}; correct it, or remove the "
            f"{presses.row_noun}"
        )


def _check_independence(channels: Mapping[str, Array]) -> None:
    """Raise an error if the charges of a channel are a linear combination of the charges of other channels.

    Args:
        channels: Charges of each channel, shape (n,), pC, by its name.

    Raises:
        PressError: If the smallest singular value of the standardised charges is nearly zero. The message names the
            channels that contribute to its singular vector.
    """
    charge = np.column_stack(list(channels.values()))
    scaled_charge = charge / usual_size(charge)
    standardised = (scaled_charge - scaled_charge.mean(axis=0)) / scaled_charge.std(axis=0)
    _, singular_values, directions = np.linalg.svd(standardised, full_matrices=False)
    largest, *_, smallest = singular_values
    if smallest > LEAST_INDEPENDENCE * largest:
        return
    # The last singular vector contains the coefficients of a combination of the channels that is nearly zero.
    coefficients = np.abs(directions[-1])
    smallest_coefficient = LEAST_PARTICIPATION * coefficients.max()
    dependent_names = [
        shown(name)
        for name, coefficient in zip(channels, coefficients, strict=True)
        if coefficient > smallest_coefficient
    ]
    raise PressError(
        f"channels {', '.join(dependent_names)}: expected charges that are linearly independent, got channels of which "
        "each follows from the others; leave out a channel that is a copy or a sum of others"
    )
