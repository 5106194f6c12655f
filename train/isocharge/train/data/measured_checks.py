"""Checks of measured presses, which are made before a network is trained on the presses.

Without such checks, the loss could become infinite or NaN during the training. The reported errors and misfits of the
model could also be meaningless.
"""

from collections.abc import Mapping

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError, shown
from isocharge.serve.presses.measured_presses import CONTACT, MeasuredPresses
from isocharge.train.data.channel_noise import usual_size
from isocharge.train.data.measured_sensor import PressedArea

LEAST_VARIATION = 1e-6
"""Smallest difference from the median that counts as a variation, relative to the largest charge of the channel."""

LEAST_VARYING_SHARE = 0.01
"""Smallest share of the presses in which the charge of a channel differs from its median."""

USUAL_SHARE = 0.9
"""Share of the values of a column whose distance from the median is at most the usual distance, dimensionless."""

FARTHEST = 1_000.0
"""Largest distance of a value from the median of its column, as a multiple of the usual distance."""

LEAST_INDEPENDENCE = 1e-4
"""Smallest ratio of the smallest to the largest singular value of the standardised charges of independent channels."""


def check_measured_presses(presses: MeasuredPresses) -> None:
    """Check that a network can be trained on measured presses.

    Args:
        presses: The presses. None of their positions, forces and charges may be unknown.

    Raises:
        PressError: If the charges of a channel hardly vary, if a value is far from all
            others, if channels depend linearly on each other, or if the positions enclose no area. The message names
            the channels, or the line and the column.
    """
    channels = dict(zip(presses.electrodes, presses.charge_pC.T, strict=True))
    contact_columns = dict(zip(CONTACT, presses.contact.T, strict=True))
    for name, values in {**contact_columns, **channels}.items():
        _check_far_value(presses, name, values, compared_values=values)
    for name, charge in channels.items():
        _check_variation(name, charge)

    # A force that is far too small is not far from the other forces, but its inverse is far from the other inverses.
    force = contact_columns["force_N"]
    _check_far_value(presses, "force_N", force, compared_values=1.0 / force)
    _check_independence(channels)
    PressedArea.of_contacts(presses.contact)  # raises if the positions enclose no area


def _check_variation(name: str, charge: Array) -> None:
    """Raise an error if nearly all charges of a channel are equal.

    Args:
        name: Name of the channel.
        charge: Charges of the channel, shape (n,), pC.

    Raises:
        PressError: If fewer than the share `LEAST_VARYING_SHARE` of the charges differ from their median.
    """
    median = np.median(charge)
    varies = np.abs(charge - median) > LEAST_VARIATION * np.abs(charge).max()
    if varies.mean() < LEAST_VARYING_SHARE:
        raise PressError(
            f"channel {shown(name)}: expected charges that vary, got {median:g} in all but {varies.sum()} of "
            f"{len(charge)} presses; leave the channel out"
        )


def _check_far_value(presses: MeasuredPresses, name: str, values: Array, compared_values: Array) -> None:
    """Raise an error if a value of a column is far from all other values.

    The largest distance of a value from the median is compared with the usual distance, which is a quantile of all
    distances that are not zero.

    Args:
        presses: The presses, which contain the number of each line for the message.
        name: Name of the column, for the message.
        values: Values of the column, shape (n,).
        compared_values: Numbers whose distances from their median are compared, shape (n,). They are the values or a
            function of the values.

    Raises:
        PressError: If the largest distance exceeds `FARTHEST` times the usual distance.
    """
    distance = np.abs(compared_values - np.median(compared_values))
    if not distance.any():  # all values are equal
        return
    # Distances of zero are left out, because the usual distance would otherwise be zero if most values are equal.
    usual_distance = float(np.quantile(distance[distance > 0.0], USUAL_SHARE))
    row = int(distance.argmax())
    if distance[row] > FARTHEST * usual_distance:
        raise PressError(
            f"{presses.row_noun} {presses.lines[row]}, column {shown(name)}: expected a value of the size of the "
            f"others, whose median is {np.median(values):.3g}, got {values[row]:.6g}; correct it, or remove the "
            f"{presses.row_noun}"
        )


def _check_independence(channels: Mapping[str, Array]) -> None:
    """Raise an error if the charges of any channel are a linear combination of those of other channels.

    Args:
        channels: Charges of each channel, shape (n,), pC, by its name.

    Raises:
        PressError: If the smallest singular value of the standardised charges is nearly zero. The message names the
            channels that contribute to the singular vector of this value.
    """
    charge = np.column_stack(list(channels.values()))
    scaled_charge = charge / usual_size(charge)
    standardised_charge = (scaled_charge - scaled_charge.mean(axis=0)) / scaled_charge.std(axis=0)
    _, singular_values, directions = np.linalg.svd(standardised_charge, full_matrices=False)
    largest, *_, smallest = singular_values
    if smallest > LEAST_INDEPENDENCE * largest:
        return
    # The last singular vector contains the coefficients of a combination of the channels that is nearly zero.
    coefficients = np.abs(directions[-1])
    smallest_coefficient = LEAST_INDEPENDENCE * coefficients.max()
    dependent_names = [
        shown(name)
        for name, coefficient in zip(channels, coefficients, strict=True)
        if coefficient > smallest_coefficient
    ]
    raise PressError(
        f"channels {', '.join(dependent_names)}: expected charges that are linearly independent, got channels of which "
        "each follows from the others; leave out a channel that is a copy or a sum of others"
    )
