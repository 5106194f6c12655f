"""Mistakes by which presses fit no film: swapped columns, turned or mirrored axes, other units, a dead channel.

Presses that no film explains are compared with films again under each mistake: other orders of the columns, other axes,
other units. The mistakes that explain them are named. The data are never changed.
"""

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.train.calibration.film_charges import FilmCharges

DEAD_SHARE = 0.02
"""Typical charge of a channel over that of the others, below which it counts as dead; less where films give less."""

REVERSED_SHARE = 0.3
"""Typical charge of a channel over that of the others, above which a negative one is reversed."""

REVERSED = 0.8
"""Share of negative charges above which a channel counts as reversed."""

METRES_MM = 0.05
"""Positions that differ, but by less than this in all, were hardly meant as mm."""

OTHER_UNITS = (
    ("forces", "N", "g", (1.0, 1.0, 9.80665e-3), 1.0),
    ("forces", "N", "mN", (1.0, 1.0, 1e-3), 1.0),
    ("forces", "N", "kg", (1.0, 1.0, 9.80665), 1.0),
    ("forces", "N", "lbf", (1.0, 1.0, 4.4482216), 1.0),
    ("positions", "mm", "m", (1e3, 1e3, 1.0), 1.0),
    ("positions", "mm", "cm", (10.0, 10.0, 1.0), 1.0),
    ("positions", "mm", "inch", (25.4, 25.4, 1.0), 1.0),
    ("positions", "mm", "um", (1e-3, 1e-3, 1.0), 1.0),
    ("charges", "pC", "nC", (1.0, 1.0, 1.0), 1e3),
    ("charges", "pC", "C", (1.0, 1.0, 1.0), 1e12),
    ("charges", "pC", "fC", (1.0, 1.0, 1.0), 1e-3),
)
"""What is written, in which unit, in which one by mistake, and the factors on (x, y, F) and Q that put it right."""

PRETENSIONS = (0.03, 0.25, 0.5, 1.0)
"""Pretensions that are tried, over the largest of the prior."""

SCATTER = 0.1
OFFSET = 0.6
"""Standard deviations of the logarithm of a charge over the expected one: among electrodes and presses, and in common.
Gains, shift and coefficients explain this much."""

CLEARER = 0.25
"""Mean squared misfit of the mistake over that of the data as they are, below which the mistake is named."""

AS_GOOD = 2.0
"""Other mistakes are named too if their misfit is at most this much larger."""


AXES = (
    ("they are turned by 90 degrees", np.array([[0.0, -1.0], [1.0, 0.0]])),
    ("they are turned by 180 degrees", np.array([[-1.0, 0.0], [0.0, -1.0]])),
    ("they are turned by -90 degrees", np.array([[0.0, 1.0], [-1.0, 0.0]])),
    ("x is mirrored", np.array([[-1.0, 0.0], [0.0, 1.0]])),
    ("y is mirrored", np.array([[1.0, 0.0], [0.0, -1.0]])),
    ("x and y are exchanged", np.array([[0.0, 1.0], [1.0, 0.0]])),
    ("x and y are exchanged and mirrored", np.array([[0.0, -1.0], [-1.0, 0.0]])),
)
"""In words, and the matrix from positions as written to positions on the film."""


def check_places(presses: MeasuredPresses, radius: float) -> None:
    """Raise an error if a press lies off the film, or the positions were written in metres.

    Args:
        presses: The presses. Positions that were not measured are NaN.
        radius: Radius of the film, mm.

    Raises:
        PressError: If a position is off the film, or all positions lie within `METRES_MM` of each other.
    """
    places = presses.contact[:, :2]
    outside_rows = np.flatnonzero(np.hypot(*places.T) >= radius)
    if outside_rows.size:
        row = outside_rows[0]
        raise PressError(
            f"{presses.row_noun} {presses.lines[row]}: a press at ({places[row, 0]:g}, {places[row, 1]:g}) mm "
            f"is off the film, whose radius is {radius:g} mm; positions are in mm from the film's centre"
        )
    measured_places = places[np.isfinite(places[:, 0])]
    spread = np.ptp(measured_places, axis=0).max() if len(measured_places) else 0.0
    if 0.0 < spread < METRES_MM:
        raise PressError(
            f"all places lie within {spread:.3g} mm of each other; positions are in mm: were they written in metres?"
        )


def check_channels(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Raise an error if a channel has no charges, is dead or has the wrong sign.

    Args:
        presses: The measured presses.
        charges: Films of the calibration, which tell how small the charges of a channel may be.

    Raises:
        PressError: If there is such a channel.
    """
    charge = presses.charge_pC
    placed = presses.contact[presses.placed]
    for name, column in zip(presses.electrodes, charge.T, strict=True):
        if np.isnan(column).all():
            raise PressError(f"electrode {name!r}: no press has a charge of it; a calibration needs all electrodes")
    shares = _shares(charge)
    smallest_shares = np.ones_like(shares)
    if len(placed):
        film_shares = [_shares(film_charge) for film_charge in expected_charges(charges, placed)]
        smallest_shares = np.minimum(np.min(film_shares, axis=0), 1.0)
    for name, column, share, smallest in zip(presses.electrodes, charge.T, shares, smallest_shares, strict=True):
        if share < DEAD_SHARE * smallest:
            raise PressError(
                f"electrode {name!r} is dead: half of its charges are below {np.nanmedian(np.abs(column)):.3g} pC, "
                f"{100.0 * share:.2g} % of those of the others; check the channel, its cable and its amplifier"
            )
        negative = np.sum(column < 0.0)
        measured = np.sum(np.isfinite(column))
        # the charges of weak channels may be negative on taut uniaxial films
        if negative > REVERSED * measured and share > REVERSED_SHARE:
            raise PressError(
                f"electrode {name!r}: {negative} of its {measured} charges are negative; a press gives a positive "
                "charge: exchange its wires or its sign"
            )


def _shares(charge: Array) -> Array:
    """Return the ratio of the median charge of each channel to that of the other channels.

    Args:
        charge: Charges, shape (n, n_electrode), pC; NaN where none was measured.

    Returns:
        Shape (n_electrode,).
    """
    typical = np.nanmedian(np.abs(charge), axis=0)
    typical_of_others = [np.median(np.delete(typical, channel)) for channel in range(typical.size)]
    return np.asarray(typical / np.maximum(typical_of_others, 1e-9))


def expected_charges(charges: FilmCharges, contact: Array) -> Array:
    """Return charges on the prior's mean film with each of `PRETENSIONS`, shape (n_pretension, n, n_electrode), pC."""
    prior = charges.prior
    contact = charges.into_domain(contact)
    expected = []
    for share in PRETENSIONS:
        parameters = prior.mean.copy()
        parameters[prior.index("pretension")] = share * prior.spread.pretension
        expected.append(charges.charges(parameters, contact))
    return np.array(expected)


def find_mistakes(presses: MeasuredPresses, charges: FilmCharges) -> list[str]:
    """Find the mistakes that explain presses far better than the presses as they are written.

    Args:
        presses: The measured presses.
        charges: Films of the calibration.

    Returns:
        One sentence for each mistake, the best explanation first; empty if no mistake explains the presses.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return []
    sentences, contacts, measured = zip(*_corrected_presses(placed, charges), strict=True)
    # the charges of all corrected contacts are computed together, which is faster
    expected = np.split(expected_charges(charges, np.concatenate(contacts)), len(contacts), axis=1)
    misfits = [
        charge_misfit(charges, contact, charge, film_charges)
        for contact, charge, film_charges in zip(contacts, measured, expected, strict=True)
    ]
    limit = CLEARER * misfit(presses, charges)
    second_limit = AS_GOOD * min(misfits)
    ranked = sorted(zip(misfits, sentences, strict=True))
    return [sentence for its_misfit, sentence in ranked if its_misfit < limit and its_misfit <= second_limit]


def misfit(presses: MeasuredPresses, charges: FilmCharges) -> float:
    """Return the distance of presses with place and force from those of any film, dimensionless.

    A misfit of 1 is common, one of 20 is not.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return 0.0
    return charge_misfit(charges, placed.contact, placed.charge_pC, expected_charges(charges, placed.contact))


def charge_misfit(charges: FilmCharges, contact: Array, charge: Array, expected: Array) -> float:
    """Return the distance of measured charges from the nearest of several films, dimensionless.

    It is the mean squared logarithm of measured over expected charges, in units of the spread of films.

    Args:
        charges: The films of the calibration, whose domain the presses must not leave.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Measured charges, shape (n, n_electrode), pC.
        expected: Charges of each film, shape (n_film, n, n_electrode), pC.
    """
    is_outside = (charges.into_domain(contact) != contact).any(axis=1)
    if is_outside.mean() > 0.2:
        return np.inf
    # one offset and one mean squared deviation from it for each film; the limit of 4 bounds the effect of outliers
    log_ratio = np.log(np.maximum(charge, 1e-3)) - np.log(np.maximum(expected, 1e-3))
    offset = np.nanmedian(log_ratio, axis=(1, 2))
    squared_deviation = np.minimum((log_ratio - offset[:, None, None]) ** 2, 4.0)
    scatter = np.nanmean(squared_deviation, axis=(1, 2))
    return float(np.min(scatter / SCATTER**2 + (offset / OFFSET) ** 2))


def _corrected_presses(presses: MeasuredPresses, charges: FilmCharges) -> Iterator[tuple[str, Array, Array]]:
    """Generate the presses without each of the mistakes that are considered.

    Args:
        presses: The measured presses, with place and force.
        charges: Films of the calibration, which are used to find the orders of the columns.

    Yields:
        A sentence that describes the mistake, the corrected contacts, shape (n, 3), and charges, shape
        (n, n_electrode).
    """
    contact = presses.contact
    charge = presses.charge_pC
    electrodes = presses.electrodes
    for order in _fitting_orders(presses, charges):
        swapped = ", ".join(electrodes[number] for number in order)
        sentence = f"the charge columns are swapped: those named {', '.join(electrodes)} hold {swapped}"
        yield sentence, contact, charge[:, np.argsort(order)]
    for turned, matrix in AXES:
        rotated = np.column_stack([contact[:, :2] @ matrix.T, contact[:, 2]])
        yield f"the rig's axes are not the film's: {turned}", rotated, charge
    for what, unit, other, of_contact, of_charge in OTHER_UNITS:
        yield f"the {what} are in {other}, not {unit}", contact * of_contact, charge * of_charge


def _fitting_orders(presses: MeasuredPresses, charges: FilmCharges) -> set[tuple[int, ...]]:
    """Return other orders of the electrodes that fit the columns best, one for each of `PRETENSIONS` at most.

    The logarithms of every column are compared with those of every electrode, and the best assignment is taken.
    """
    orders = set()
    log_measured = np.log(np.maximum(presses.charge_pC, 1e-3))
    for expected in expected_charges(charges, presses.contact):
        log_expected = np.log(np.maximum(expected, 1e-3))
        log_ratio = log_measured[:, :, None] - log_expected[:, None]  # shape (n, n_column, n_electrode)
        squared_deviation = np.minimum((log_ratio - np.nanmedian(log_ratio)) ** 2, 4.0)
        distance = np.nansum(squared_deviation, axis=0)
        _, electrode_of_column = linear_sum_assignment(distance)
        orders.add(tuple(electrode_of_column.tolist()))
    as_written = tuple(range(len(presses.electrodes)))
    return orders - {as_written}


def explain(presses: MeasuredPresses, charges: FilmCharges, times_noise: float) -> PressError:
    """Return the error for presses that no film of this sensor explains.

    Args:
        presses: As they are written.
        charges: The films.
        times_noise: Root-mean-square residual of the best film over the noise; infinite if most presses lie
            outside, NaN if none was tried.
    """
    best = f"the best misses them by {times_noise:.2g} times the noise"
    if not np.isfinite(times_noise):
        best = "most of them lie outside the places and forces of a calibration"
    if np.isnan(times_noise):
        best = "as they are written, they are nothing like its charges"
    begin = f"no film of {charges.prior.sensor.name!r} explains these {len(presses)} presses: {best}"
    if mistakes := find_mistakes(presses, charges):
        sentences = "; or ".join(mistakes[:3])
        return PressError(f"{begin}, but it would explain them if {sentences}. Nothing was changed: put the file right")
    return PressError(
        f"{begin}; is it this layout and this probe ({charges.prior.probe.notation}), are places and forces those "
        "of these rows, and are charges touch charges (reading under load minus reading without)?"
    )
