"""Why presses fit no film: columns swapped, axes turned or mirrored, units mixed up, a dead channel, another layout.

Presses that no film explains are tried again as what they may be by mistake: other orders of the columns, other axes,
other units. What then explains them is named; the data are never mended silently.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from isocharge.common.arrays import Array
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


@dataclass(frozen=True)
class Mistake:
    """One way in which presses may have been written wrongly, and the presses put right."""

    words: str
    contact: Array
    charge_pC: Array


def check_before(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Refuse presses that cannot be what they say, before anything is fitted.

    Raises:
        PressError: If a place is off the film, places are in metres, or a channel is dead or has the wrong sign.
    """
    _check_places(presses, charges)
    _check_channels(presses, charges)


def _check_places(presses: MeasuredPresses, charges: FilmCharges) -> None:
    distance = np.hypot(presses.contact[:, 0], presses.contact[:, 1])
    known = np.isfinite(distance)
    if not known.any():
        return
    radius_mm = 1e3 * charges.prior.sensor.film.radius
    worst = int(np.nanargmax(distance))
    if distance[worst] >= radius_mm:
        x_mm, y_mm, _ = presses.contact[worst]
        raise PressError(
            f"line {presses.lines[worst]}: a press at ({x_mm:g}, {y_mm:g}) mm "
            f"is off the film, whose radius is {radius_mm:g} mm; positions are in mm from the film's centre"
        )
    spread = np.ptp(presses.contact[known, :2], axis=0).max()
    if 0.0 < spread < METRES_MM and known.sum() > 1:
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
    placed = np.isfinite(presses.contact).all(axis=1)
    shares = []
    for share in PRETENSIONS if placed.any() else ():
        typical = np.median(np.abs(_expected(charges, presses.contact[placed], share)), axis=0)
        others = np.array([np.median(np.delete(typical, number)) for number in range(typical.size)])
        shares.append(typical / others)
    smallest: Array = np.min(shares, axis=0) if shares else np.ones(len(presses.electrodes))
    return smallest


def _expected(charges: FilmCharges, contact: Array, share: float) -> Array:
    """Charges of contacts, (n, n_electrode), pC, on the prior's mean film with a share of its largest pretension."""
    parameters = charges.prior.mean.copy()
    parameters[0] = share * charges.prior.spread.pretension
    return charges.charge_pC(parameters, charges.into_domain(contact))


def _median(values: Array) -> float:
    """The median of what is known; NaN if nothing is."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else np.nan


def outside(presses: MeasuredPresses, charges: FilmCharges) -> np.ndarray:
    """Which presses lie beyond the radius or the forces that films are solved for, shape (n,)."""
    low, high = charges.force_range_N
    far = np.hypot(presses.contact[:, 0], presses.contact[:, 1]) > charges.radius_mm
    beyond: np.ndarray = far | (presses.contact[:, 2] < low) | (presses.contact[:, 2] > high)
    return beyond


def find_mistakes(presses: MeasuredPresses, charges: FilmCharges) -> list[Mistake]:
    """The mistakes that would explain presses far better than as they are written, best first; none if nothing does."""
    placed = np.isfinite(presses.contact).all(axis=1)
    if not placed.any():
        return []
    some = presses[np.flatnonzero(placed)]
    as_written = _misfit(charges, some.contact, some.charge_pC)
    tried = [(mistake, _misfit(charges, mistake.contact, mistake.charge_pC)) for mistake in _mistakes(some)]
    tried = sorted((pair for pair in tried if pair[1] < CLEARER * as_written), key=lambda pair: pair[1])
    return [mistake for mistake, misfit in tried if misfit <= AS_GOOD * tried[0][1]]


def _misfit(charges: FilmCharges, contact: Array, charge_pC: Array) -> float:
    """Mean squared logarithm of measured over expected charges, in units of what films differ by."""
    if (charges.into_domain(contact) != contact).any(axis=1).mean() > 0.2:
        return np.inf
    misfits = []
    for share in PRETENSIONS:
        expected = _expected(charges, contact, share)
        logs = np.log(np.maximum(charge_pC, 1e-3)) - np.log(np.maximum(expected, 1e-3))
        common = np.nanmedian(logs)
        misfits.append(np.nanmean(np.minimum((logs - common) ** 2, 4.0)) / SCATTER**2 + (common / OFFSET) ** 2)
    return float(min(misfits))


def _mistakes(presses: MeasuredPresses) -> Iterator[Mistake]:
    """Every mistake that is tried, one at a time."""
    contact, charge_pC = presses.contact, presses.charge_pC
    for order in _orders(len(presses.electrodes)):
        names = ", ".join(presses.electrodes[number] for number in order)
        yield Mistake(
            f"the charge columns are swapped: those named {', '.join(presses.electrodes)} hold {names}",
            contact,
            charge_pC[:, np.argsort(order)],
        )
    for words, matrix in AXES:
        turned = contact.copy()
        turned[:, :2] = contact[:, :2] @ matrix.T
        yield Mistake(f"the rig's axes are not the film's: {words}", turned, charge_pC)
    for unit, factor in FORCE_UNITS.items():
        yield Mistake(f"the forces are in {unit}, not N", contact * [1.0, 1.0, factor], charge_pC)
    for unit, factor in PLACE_UNITS.items():
        yield Mistake(f"the positions are in {unit}, not mm", contact * [factor, factor, 1.0], charge_pC)
    for unit, factor in CHARGE_UNITS.items():
        yield Mistake(f"the charges are in {unit}, not pC", contact, charge_pC * factor)


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    """Orders of the columns other than the right one: all of them for a few electrodes, exchanges of two for more."""
    identity = tuple(range(count))
    if count <= MOST_PERMUTED:
        yield from (order for order in permutations(identity) if order != identity)
        return
    for first in range(count):
        for second in range(first + 1, count):
            order = list(identity)
            order[first], order[second] = second, first
            yield tuple(order)


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


def explain(presses: MeasuredPresses, charges: FilmCharges, times_noise: float) -> PressError:
    """The error for presses that no film of this sensor explains.

    Args:
        presses: As they are written.
        charges: The films.
        times_noise: Root-mean-square miss of the best film over the noise; infinite if none was tried.
    """
    best = f"the best misses them by {times_noise:.2g} times the noise"
    if not np.isfinite(times_noise):
        best = "most of them lie outside the places and forces of a calibration"
    begin = f"no film of {charges.prior.sensor.name!r} explains these {len(presses)} presses: {best}"
    mistakes = find_mistakes(presses, charges)
    if not mistakes:
        return PressError(
            f"{begin}; is it this layout and this probe ({charges.prior.probe.notation}), are places and forces those "
            "of these rows, and are charges touch charges (reading under load minus reading without)?"
        )
    words = "; or ".join(mistake.words for mistake in mistakes[:3])
    return PressError(f"{begin}, but it would explain them if {words}. Nothing was changed: put the file right")


def without(presses: MeasuredPresses, rows: np.ndarray) -> MeasuredPresses:
    """The presses but for those of a mask, shape (n,)."""
    return replace(presses[np.flatnonzero(~rows)])
