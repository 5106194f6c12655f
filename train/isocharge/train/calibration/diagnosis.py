"""Why presses fit no film: columns swapped, axes turned or mirrored, units mixed up, a dead channel, another layout.

Presses that no film explains are tried again as what they may be by mistake: other orders of the columns, other axes,
other units. What then explains them is named; the data are never mended silently.
"""

from collections.abc import Iterator
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.train.calibration.film_charges import FilmCharges

DEAD_SHARE = 0.02
"""Typical charge of a channel over that of the others, below which it counts as dead; less where films give less."""

REVERSED_SHARE = 0.3
"""Typical charge of a channel over that of the others, above which a negative one is reversed."""

REVERSED = 0.8
"""Share of negative charges above which a channel counts as reversed."""

FEWEST_TO_TELL = 3
"""Charges of a channel below which nothing is said of its sign."""

MOST_PERMUTED = 5
"""Electrodes up to which all orders of the columns are tried; beyond, only two are exchanged."""

METRES_MM = 0.05
"""Positions that differ, but by less than this in all, were hardly meant as mm."""

FORCE_UNITS = {"g": 9.80665e-3, "mN": 1e-3, "kg": 9.80665, "lbf": 4.4482216}
"""Unit to newtons."""

PLACE_UNITS = {"m": 1e3, "cm": 10.0, "inch": 25.4, "um": 1e-3}
"""Unit to millimetres."""

CHARGE_UNITS = {"nC": 1e3, "C": 1e12, "fC": 1e-3}
"""Unit to picocoulombs."""

PRETENSIONS = (0.03, 0.25, 0.5, 1.0)
"""Pretensions that are tried, over the largest of the prior."""

SCATTER, OFFSET = 0.1, 0.6
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


class Mistake(NamedTuple):
    """One way in which presses may have been written wrongly, and the presses put right."""

    sentence: str
    contact: Array
    charge: Array


def check_before(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Refuse presses that cannot be what they say, before anything is fitted.

    Raises:
        PressError: If a place is off the film, places are in metres, or a channel is dead or has the wrong sign.
    """
    _check_places(presses, charges.prior.sensor.film.radius)
    _check_channels(presses, charges)


def _check_places(presses: MeasuredPresses, radius: float) -> None:
    distance = np.hypot(presses.contact[:, 0], presses.contact[:, 1])
    known = np.isfinite(distance)
    if not known.any():
        return
    worst = int(np.nanargmax(distance))
    if distance[worst] >= radius:
        x, y, _ = presses.contact[worst]
        raise PressError(
            f"line {presses.lines[worst]}: a press at ({x:g}, {y:g}) mm "
            f"is off the film, whose radius is {radius:g} mm; positions are in mm from the film's centre"
        )
    spread = np.ptp(presses.contact[known, :2], axis=0).max()
    if 0.0 < spread < METRES_MM:
        raise PressError(
            f"all places lie within {spread:.3g} mm of each other; positions are in mm: were they written in metres?"
        )


def _check_channels(presses: MeasuredPresses, charges: FilmCharges) -> None:
    typical = np.array([_median(np.abs(column)) for column in presses.charge_pC.T])
    expected = _smallest_shares(presses, charges)
    for number, name in enumerate(presses.electrodes):
        others = _median(np.delete(typical, number))
        if np.isnan(typical[number]):
            raise PressError(f"electrode {name!r}: no press has a charge of it; a calibration needs all electrodes")
        if typical[number] < DEAD_SHARE * min(expected[number], 1.0) * others:
            raise PressError(
                f"electrode {name!r} is dead: half of its charges are below {typical[number]:.3g} pC where those of "
                f"the others are {others:.3g} pC; check the channel, its cable and its amplifier"
            )
        known = presses.charge_pC[~np.isnan(presses.charge_pC[:, number]), number]
        large = typical[number] > REVERSED_SHARE * others  # weak ones may be negative, on taut uniaxial films
        if known.size >= FEWEST_TO_TELL and np.mean(known < 0.0) > REVERSED and large:
            raise PressError(
                f"electrode {name!r}: {np.sum(known < 0.0)} of its {known.size} charges are negative; a press gives a "
                "positive charge: exchange its wires or its sign"
            )


def _smallest_shares(presses: MeasuredPresses, charges: FilmCharges) -> Array:
    """Typical charge of each channel over that of the others, the smallest that films of some pretension give."""
    placed = presses.contact[presses.placed]
    if not len(placed):
        return np.ones(len(presses.electrodes))
    typical = np.median(np.abs(_expected(charges, placed)), axis=1)
    others = [np.median(np.delete(typical, number, axis=1), axis=1) for number in range(typical.shape[1])]
    smallest: Array = np.min(typical / np.transpose(others), axis=0)
    return smallest


def _expected(charges: FilmCharges, contact: Array) -> Array:
    """Charges of contacts on the prior's mean film with `PRETENSIONS`, shape (n_pretension, n, n_electrode), pC."""
    contact, films = charges.into_domain(contact), []
    for share in PRETENSIONS:
        parameters = charges.prior.mean.copy()
        parameters[0] = share * charges.prior.spread.pretension
        films.append(charges.charges(parameters, contact))
    return np.array(films)


def _median(values: Array) -> float:
    """The median of what is known; NaN if nothing is."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else np.nan


def outside(presses: MeasuredPresses, charges: FilmCharges) -> Booleans:
    """Which presses lie beyond the radius or the forces that films are solved for, shape (n,)."""
    x, y, force = presses.contact.T
    low, high = charges.domain.force_range
    return np.asarray((np.hypot(x, y) > charges.domain.radius) | (force < low) | (force > high))


def find_mistakes(presses: MeasuredPresses, charges: FilmCharges) -> list[Mistake]:
    """The mistakes that would explain presses far better than as they are written, best first; none if nothing does."""
    placed = presses[presses.placed]
    if not len(placed):
        return []
    as_written = _misfit(charges, placed.contact, placed.charge_pC)
    tried = [(_misfit(charges, mistake.contact, mistake.charge), mistake) for mistake in _mistakes(placed)]
    tried = sorted((pair for pair in tried if pair[0] < CLEARER * as_written), key=lambda pair: pair[0])
    return [mistake for misfit, mistake in tried if misfit <= AS_GOOD * tried[0][0]]


def _misfit(charges: FilmCharges, contact: Array, charge: Array) -> float:
    """Mean squared logarithm of measured over expected charges, in units of what films differ by."""
    if (charges.into_domain(contact) != contact).any(axis=1).mean() > 0.2:
        return np.inf
    logs = np.log(np.maximum(charge, 1e-3)) - np.log(np.maximum(_expected(charges, contact), 1e-3))
    common = np.nanmedian(logs, axis=(1, 2))
    own = np.nanmean(np.minimum((logs - common[:, None, None]) ** 2, 4.0), axis=(1, 2))
    return float(np.min(own / SCATTER**2 + (common / OFFSET) ** 2))


def _mistakes(presses: MeasuredPresses) -> Iterator[Mistake]:
    """Every mistake that is tried, one at a time."""
    contact, charge, electrodes = presses.contact, presses.charge_pC, presses.electrodes
    for order in _orders(len(electrodes)):
        swapped = f"those named {', '.join(electrodes)} hold {', '.join(electrodes[number] for number in order)}"
        yield Mistake(f"the charge columns are swapped: {swapped}", contact, charge[:, np.argsort(order)])
    for sentence, matrix in AXES:
        rotated = np.column_stack([contact[:, :2] @ matrix.T, contact[:, 2]])
        yield Mistake(f"the rig's axes are not the film's: {sentence}", rotated, charge)
    for unit, factor in FORCE_UNITS.items():
        yield Mistake(f"the forces are in {unit}, not N", contact * [1.0, 1.0, factor], charge)
    for unit, factor in PLACE_UNITS.items():
        yield Mistake(f"the positions are in {unit}, not mm", contact * [factor, factor, 1.0], charge)
    for unit, factor in CHARGE_UNITS.items():
        yield Mistake(f"the charges are in {unit}, not pC", contact, charge * factor)


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    """Orders of the columns other than the right one: all of them for a few electrodes, exchanges of two for more."""
    identity = tuple(range(count))
    if count <= MOST_PERMUTED:
        yield from (order for order in permutations(identity) if order != identity)
        return
    for pair in combinations(identity, 2):
        exchanged = dict(zip(pair, pair[::-1], strict=True))
        yield tuple(exchanged.get(number, number) for number in identity)


def explain(presses: MeasuredPresses, charges: FilmCharges, times_noise: float) -> PressError:
    """The error for presses that no film of this sensor explains.

    Args:
        presses: As they are written.
        charges: The films.
        times_noise: Root-mean-square residual of the best film over the noise; infinite if none was tried.
    """
    best = f"the best misses them by {times_noise:.2g} times the noise"
    if not np.isfinite(times_noise):
        best = "most of them lie outside the places and forces of a calibration"
    begin = f"no film of {charges.prior.sensor.name!r} explains these {len(presses)} presses: {best}"
    if mistakes := find_mistakes(presses, charges):
        sentences = "; or ".join(mistake.sentence for mistake in mistakes[:3])
        return PressError(f"{begin}, but it would explain them if {sentences}. Nothing was changed: put the file right")
    return PressError(
        f"{begin}; is it this layout and this probe ({charges.prior.probe.notation}), are places and forces those "
        "of these rows, and are charges touch charges (reading under load minus reading without)?"
    )
