"""Search for a mistake in the presses of a calibration that no film explains.

The mistakes that are considered are swapped columns, rotated or mirrored axes, and other units. The presses are
corrected for each mistake in turn and compared with a few films. An error message names the mistakes whose correction
makes the presses agree with a film. The data themselves are never changed. Separate checks find positions off the film,
dead channels and channels with the wrong sign before this search.
"""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.train.calibration.film_charges import FilmCharges

MAX_DEAD_RATIO = 0.02
"""Ratio of the median charge of a channel to that of the other channels, below which the channel counts as dead.

The limit is smaller for channels on which films have smaller charges."""

MIN_REVERSED_RATIO = 0.3
"""Ratio of the median charge of a channel to that of the other channels, above which its sign is checked."""

MIN_TYPICAL_CHARGE_pC = 1e-9
"""Smallest median charge by which the median charge of another channel is divided, pC."""

MAX_NEGATIVE_FRACTION = 0.8
"""Fraction of negative charges above which a channel counts as reversed."""

MIN_POSITION_RANGE_MM = 0.05
"""Smallest credible range of the positions, mm. Positions in a smaller range were probably written in metres."""


class OtherUnit(NamedTuple):
    """Unit that may have been used by mistake.

    Attributes:
        values: Name of the values.
        expected: Expected unit.
        written: Unit in which the values may have been written.
        factor: Factor that converts the values to the expected unit.
    """

    values: Literal["forces", "positions", "charges"]
    expected: str
    written: str
    factor: float


OTHER_UNITS = (
    OtherUnit("forces", "N", "g", 9.80665e-3),
    OtherUnit("forces", "N", "mN", 1e-3),
    OtherUnit("forces", "N", "kg", 9.80665),
    OtherUnit("forces", "N", "lbf", 4.4482216),
    OtherUnit("positions", "mm", "m", 1e3),
    OtherUnit("positions", "mm", "cm", 10.0),
    OtherUnit("positions", "mm", "inch", 25.4),
    OtherUnit("positions", "mm", "um", 1e-3),
    OtherUnit("charges", "pC", "nC", 1e3),
    OtherUnit("charges", "pC", "C", 1e12),
    OtherUnit("charges", "pC", "fC", 1e-3),
)
"""Units that are considered."""

PRETENSIONS = (0.03, 0.25, 0.5, 1.0)
"""Pretensions of the films that are compared, relative to the largest pretension of the prior."""

SCATTER_STD = 0.1
"""Standard deviation of the logarithm of measured over expected charges, among electrodes and presses.

Gains and the shift of the electrodes cause such differences."""

OFFSET_STD = 0.6
"""Standard deviation of a common offset of the logarithm of measured over expected charges.

The piezoelectric coefficients cause such an offset."""

MIN_CHARGE_pC = 1e-3
"""Lower limit to which charges are raised in comparisons of their logarithms, pC."""

MAX_SQUARED_DEVIATION = 4.0
"""Limit of the squared deviation of a logarithm of charges, which bounds the effect of outliers."""

MAX_OUTSIDE_FRACTION = 0.2
"""Largest fraction of presses outside the domain for which a misfit is computed."""

CLEARER = 0.25
"""Ratio of the misfits with and without the correction of a mistake, below which the mistake is named."""

MAX_MISFIT_RATIO = 2.0
"""Largest ratio of the misfit of a mistake to the smallest misfit for which the mistake is named as well."""

AXES = (
    ("they are turned by 90 degrees", np.array([[0.0, -1.0], [1.0, 0.0]])),
    ("they are turned by 180 degrees", np.array([[-1.0, 0.0], [0.0, -1.0]])),
    ("they are turned by -90 degrees", np.array([[0.0, 1.0], [-1.0, 0.0]])),
    ("x is mirrored", np.array([[-1.0, 0.0], [0.0, 1.0]])),
    ("y is mirrored", np.array([[1.0, 0.0], [0.0, -1.0]])),
    ("x and y are exchanged", np.array([[0.0, 1.0], [1.0, 0.0]])),
    ("x and y are exchanged and mirrored", np.array([[0.0, -1.0], [-1.0, 0.0]])),
)
"""Rotations and reflections that are considered: a description, and the matrix that corrects written positions."""


def check_places(presses: MeasuredPresses, radius: float) -> None:
    """Raise an error if a press lies off the film, or if the positions were probably written in metres.

    Args:
        presses: The presses. Positions that were not measured are NaN.
        radius: Radius of the film, mm.

    Raises:
        PressError: If a position is off the film, or all positions lie within `MIN_POSITION_RANGE_MM` of each other.
    """
    places = presses.contact[:, :2]
    distance = np.hypot(places[:, 0], places[:, 1])
    outside_rows = np.flatnonzero(distance >= radius)  # the comparison is false for positions that were not measured
    if outside_rows.size:
        row = outside_rows[0]
        raise PressError(
            f"{presses.row_noun} {presses.lines[row]}: a press at ({places[row, 0]:g}, {places[row, 1]:g}) mm "
            f"is off the film, whose radius is {radius:g} mm; positions are in mm from the film's centre"
        )
    measured_places = places[np.isfinite(places[:, 0])]
    spread = np.ptp(measured_places, axis=0).max() if len(measured_places) else 0.0
    if 0.0 < spread < MIN_POSITION_RANGE_MM:  # repeated presses at one place, with a spread of zero, are allowed
        raise PressError(
            f"all places lie within {spread:.3g} mm of each other; positions are in mm: were they written in metres?"
        )


def check_channels(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Raise an error if a channel has no charges, is dead or has the wrong sign.

    Args:
        presses: The measured presses.
        charges: Charges of the films of the calibration. A channel may have as small charges as one of these films.

    Raises:
        PressError: If there is such a channel.
    """
    charge = presses.charge_pC
    for name, channel_charge in zip(presses.electrodes, charge.T, strict=True):
        if np.isnan(channel_charge).all():
            raise PressError(f"electrode {name!r}: no press has a charge of it; a calibration needs all electrodes")

    ratios = _charge_ratios(charge)
    smallest_film_ratios = _smallest_film_ratios(presses, charges)
    for name, channel_charge, ratio, film_ratio in zip(
        presses.electrodes, charge.T, ratios, smallest_film_ratios, strict=True
    ):
        _check_channel(name, channel_charge, ratio, film_ratio)


def _smallest_film_ratios(presses: MeasuredPresses, charges: FilmCharges) -> Array:
    """Return the smallest charge of each channel on one of the films, relative to the charges of the other channels.

    Args:
        presses: The measured presses. Those with a known place and force are computed for each film.
        charges: Charges of the films of the calibration.

    Returns:
        Ratios as in `_charge_ratios`, but not larger than 1, shape (n_electrode,). All ratios are 1 if no press has a
        known place and force.
    """
    placed_contact = presses.contact[presses.placed]
    if not len(placed_contact):
        return np.ones(len(presses.electrodes))
    film_ratios = [_charge_ratios(film_charge) for film_charge in expected_charges(charges, placed_contact)]
    return np.asarray(np.minimum(np.min(film_ratios, axis=0), 1.0))


def _check_channel(name: str, charge: Array, ratio: float, smallest_film_ratio: float) -> None:
    """Raise an error if a channel is dead or has the wrong sign.

    Args:
        name: Name of the electrode.
        charge: Charges of the channel, shape (n,), pC; NaN where a charge was not measured.
        ratio: Median charge of the channel divided by the median charge of the other channels.
        smallest_film_ratio: The smallest such ratio among the films of the calibration.

    Raises:
        PressError: If the channel is dead or has the wrong sign.
    """
    if ratio < MAX_DEAD_RATIO * smallest_film_ratio:
        raise PressError(
            f"electrode {name!r} is dead: half of its charges are below "
            f"{np.nanmedian(np.abs(charge)):.3g} pC, {100.0 * ratio:.2g} % of those of the others; check "
            "the channel, its cable and its amplifier"
        )
    negative_count = np.sum(charge < 0.0)
    measured_count = np.sum(np.isfinite(charge))
    is_mostly_negative = negative_count > MAX_NEGATIVE_FRACTION * measured_count
    # The charges of channels with a small ratio may be negative on taut uniaxial films.
    if is_mostly_negative and ratio > MIN_REVERSED_RATIO:
        raise PressError(
            f"electrode {name!r}: {negative_count} of its {measured_count} charges are negative; a press gives a "
            "positive charge: exchange its wires or its sign"
        )


def _charge_ratios(charge: Array) -> Array:
    """Return the typical charge of each channel divided by the typical charge of the other channels.

    The typical charge of a channel is the median of the magnitudes of its charges.

    Args:
        charge: Charges, shape (n, n_electrode), pC; NaN where none was measured.

    Returns:
        Ratios, shape (n_electrode,).
    """
    typical_charge = np.nanmedian(np.abs(charge), axis=0)  # shape (n_electrode,)
    typical_of_others = []
    for channel in range(typical_charge.size):
        other_channels = np.delete(typical_charge, channel)
        typical_of_others.append(np.median(other_channels))
    return np.asarray(typical_charge / np.maximum(typical_of_others, MIN_TYPICAL_CHARGE_pC))


def expected_charges(charges: FilmCharges, contact: Array) -> Array:
    """Compute the charges of the mean film of the prior with each of `PRETENSIONS`.

    Args:
        charges: The films.
        contact: Contacts (x, y, F), shape (n, 3), mm and N. Contacts outside the domain are moved into it.

    Returns:
        Charges, shape (n_pretension, n, n_electrode), pC.
    """
    prior = charges.prior
    contact = charges.into_domain(contact)
    expected = []
    for share in PRETENSIONS:
        parameters = prior.mean.copy()
        parameters[prior.index("pretension")] = share * prior.spread.pretension
        expected.append(charges.charges(parameters, contact))
    return np.array(expected)


def find_mistakes(presses: MeasuredPresses, charges: FilmCharges) -> list[str]:
    """Find the mistakes whose correction makes the presses agree far better with a film.

    A mistake is returned if its correction reduces the misfit at least by the factor `CLEARER`. The misfit must also be
    nearly as small as after the best correction.

    Args:
        presses: The measured presses.
        charges: Charges of the films of the calibration.

    Returns:
        One sentence for each mistake, the best explanation first; empty if no mistake explains the presses.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return []
    corrections = list(_corrected_presses(placed, charges))

    # The charges of the films are computed for all corrected contacts at once, which is faster.
    all_contacts = np.concatenate([correction.contact for correction in corrections])
    charges_by_correction = np.split(expected_charges(charges, all_contacts), len(corrections), axis=1)
    corrected_misfits = {}  # misfit after each correction, by the sentence about the mistake
    for correction, film_charges in zip(corrections, charges_by_correction, strict=True):
        corrected_misfits[correction.sentence] = charge_misfit(
            charges, correction.contact, correction.charge, film_charges
        )

    limit_for_improvement = CLEARER * misfit(presses, charges)
    limit_for_similarity = MAX_MISFIT_RATIO * min(corrected_misfits.values())
    sentences_best_first = sorted(corrected_misfits, key=corrected_misfits.__getitem__)
    return [
        sentence
        for sentence in sentences_best_first
        if corrected_misfits[sentence] < limit_for_improvement and corrected_misfits[sentence] <= limit_for_similarity
    ]


def misfit(presses: MeasuredPresses, charges: FilmCharges) -> float:
    """Return the misfit of all presses with a measured place and force; see `charge_misfit`.

    A misfit of 1 is common, and a misfit of 20 is not.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return 0.0
    return charge_misfit(charges, placed.contact, placed.charge_pC, expected_charges(charges, placed.contact))


def charge_misfit(charges: FilmCharges, contact: Array, charge: Array, expected: Array) -> float:
    """Compute how much measured charges differ from the charges of the most similar of several films.

    The difference is computed from the logarithms of the ratios of measured to expected charges. The difference has two
    parts: the mean squared scatter of these logarithms about their median, and the squared median. Each part is in
    units of the spread of the films.

    Args:
        charges: The films of the calibration. If many contacts lie outside their domain, the misfit is infinite.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Measured charges, shape (n, n_electrode), pC.
        expected: Charges of each film, shape (n_film, n, n_electrode), pC.
    """
    # A contact lies outside the domain if the nearest contact of the domain is another one.
    is_outside = (charges.into_domain(contact) != contact).any(axis=1)
    if is_outside.mean() > MAX_OUTSIDE_FRACTION:
        return np.inf
    # For each film, the offset common to all charges, and the mean squared deviation from this offset
    log_ratio = _log_charge(charge) - _log_charge(expected)  # shape (n_film, n, n_electrode)
    offset = np.nanmedian(log_ratio, axis=(1, 2))
    squared_deviation = np.minimum((log_ratio - offset[:, None, None]) ** 2, MAX_SQUARED_DEVIATION)
    scatter = np.nanmean(squared_deviation, axis=(1, 2))
    film_misfit = scatter / SCATTER_STD**2 + (offset / OFFSET_STD) ** 2
    return float(np.min(film_misfit))


def _log_charge(charge: Array) -> Array:
    """Return the logarithms of charges, which are first limited to at least `MIN_CHARGE_pC`; NaN remains NaN."""
    return np.asarray(np.log(np.maximum(charge, MIN_CHARGE_pC)))


class Correction(NamedTuple):
    """Presses after the correction of a possible mistake.

    Attributes:
        sentence: Description of the mistake.
        contact: Corrected contacts (x, y, F), shape (n, 3), mm and N.
        charge: Corrected charges, shape (n, n_electrode), pC.
    """

    sentence: str
    contact: Array
    charge: Array


def _corrected_presses(presses: MeasuredPresses, charges: FilmCharges) -> Iterator[Correction]:
    """Yield the presses after the correction of each mistake that is considered.

    The mistakes are swapped charge columns, rotated or reflected axes of the rig, and wrong units.

    Args:
        presses: The measured presses, with place and force.
        charges: Charges of the films of the calibration, from which possible orders of the columns follow.
    """
    contact = presses.contact
    charge = presses.charge_pC
    electrodes = presses.electrodes

    # Swapped columns: `electrode_of_column` contains the index of the electrode whose charges each column holds.
    for electrode_of_column in _fitting_orders(presses, charges):
        held_names = ", ".join(electrodes[electrode_index] for electrode_index in electrode_of_column)
        sentence = f"the charge columns are swapped: those named {', '.join(electrodes)} hold {held_names}"
        column_of_electrode = np.argsort(electrode_of_column)  # the inverse permutation
        yield Correction(sentence, contact, charge[:, column_of_electrode])

    # Rotated or reflected axes
    for description, matrix in AXES:
        position = contact[:, :2] @ matrix.T
        rotated_contact = np.column_stack([position, contact[:, 2]])
        yield Correction(f"the rig's axes are not the film's: {description}", rotated_contact, charge)

    # Wrong units, each of either the positions, the forces or the charges
    for unit in OTHER_UNITS:
        position_factor = unit.factor if unit.values == "positions" else 1.0
        force_factor = unit.factor if unit.values == "forces" else 1.0
        charge_factor = unit.factor if unit.values == "charges" else 1.0
        yield Correction(
            f"the {unit.values} are in {unit.written}, not {unit.expected}",
            contact * [position_factor, position_factor, force_factor],
            charge * charge_factor,
        )


def _fitting_orders(presses: MeasuredPresses, charges: FilmCharges) -> set[tuple[int, ...]]:
    """Find the orders of the electrodes with which the charge columns agree best with films.

    For each of `PRETENSIONS`, the columns are assigned to the electrodes of a film with this pretension. The assignment
    minimises the squared differences between the logarithms of measured and expected charges.

    Args:
        presses: The measured presses, with place and force.
        charges: Charges of the films of the calibration.

    Returns:
        For each order, the index of the electrode that each column holds. The order as written is not among them.
    """
    orders = set()
    log_measured = _log_charge(presses.charge_pC)
    for expected in expected_charges(charges, presses.contact):
        log_expected = _log_charge(expected)
        log_ratio = log_measured[:, :, None] - log_expected[:, None]  # shape (n, n_column, n_electrode)
        # The median is subtracted, because a common factor of all charges does not matter. The limit reduces the effect
        # of outliers.
        squared_deviation = np.minimum((log_ratio - np.nanmedian(log_ratio)) ** 2, MAX_SQUARED_DEVIATION)
        # The best assignment has the smallest sum of these distances, with each electrode assigned to one column.
        distance = np.nansum(squared_deviation, axis=0)  # shape (n_column, n_electrode)
        _, electrode_of_column = linear_sum_assignment(distance)
        orders.add(tuple(electrode_of_column.tolist()))
    as_written = tuple(range(len(presses.electrodes)))
    return orders - {as_written}


FAR_FROM_ALL_FILMS = "their charges are very different from those of its films"
"""Reason why presses are refused before a film is fitted to them."""

MOSTLY_OUTSIDE = "most of them lie outside the places and forces of a calibration"
"""Reason why presses are refused if few of them remain for a fit."""

UNUSUAL_FILM = "only a film that differs unusually from its description has such charges"
"""Reason why presses are refused if the correction of a common mistake explains them far better."""


def large_residual(residual_over_noise: float) -> str:
    """Return the reason why presses are refused after a fit.

    Args:
        residual_over_noise: Root-mean-square residual of the best film, in units of the noise.
    """
    return f"the charges of the best film differ from theirs by {residual_over_noise:.2g} times the noise"


def unexplained_error(presses: MeasuredPresses, charges: FilmCharges, reason: str) -> PressError:
    """Return the error for presses that no film of the sensor explains.

    The message names up to three mistakes that would explain the presses. If no mistake is found, the message asks for
    a check of the setup.

    Args:
        presses: The presses as they are written in the file.
        charges: Charges of the films of the calibration.
        reason: Reason why no film explains the presses: one of the texts above.
    """
    sensor_name = charges.prior.sensor.name
    statement = f"no film of {sensor_name!r} explains these {len(presses)} presses: {reason}"
    mistakes = find_mistakes(presses, charges)
    if mistakes:
        alternatives = "; or ".join(mistakes[:3])
        return PressError(
            f"{statement}. A film would explain them if {alternatives}. Nothing was changed: correct the file"
        )
    return PressError(
        f"{statement}; is it this layout and this probe ({charges.prior.probe.notation}), do the places and forces "
        "belong to these rows, and are the charges touch charges (reading under load minus reading without load)?"
    )
