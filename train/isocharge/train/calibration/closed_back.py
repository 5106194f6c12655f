"""Detection of a closed back, behind which air is trapped, from the presses of a film.

A calibration assumes that air can flow out of the space behind the film (a vented back). If the back is closed, the
trapped air carries a part of the load, and the charges of the electrodes away from the probe are much smaller. No film
of the prior has such charges, so a calibration describes them by a large discrepancy or refuses the presses. The
presses are therefore also compared with a few films with a closed back, which are solved directly. This comparison
takes a few seconds. This comparison is made only if no film with a vented back agrees with the presses.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError, SceneError, SolveError
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.simulate import SolveSettings, press, touch_charge
from isocharge.train.calibration.diagnosis import CLEARER, PRETENSIONS, charge_misfit, expected_charges
from isocharge.train.calibration.film_charges import FilmCharges

MIN_VENTED_MISFIT = 0.5
"""Misfit of films with a vented back, as `charge_misfit` returns it, below which the back is not examined."""

CAVITY_DEPTH_mm = 20.0
"""Depth of the cavity behind the films that are compared.

Up to a depth of about 200 mm, the trapped air is so stiff that the depth hardly matters.
"""

INTERPOLATED_COUNT = 25
"""Number of pretensions between those of `PRETENSIONS` for which charges are interpolated."""

MAX_EXAMINED = 8
"""Largest number of presses that are compared."""

ACCURACY = 5e-3
"""Relative error of the solved charges, which is far below the effect of a closed back."""

CLOSED_BACK_CAUTION = (
    "films with a closed back explain the presses far better than films with a vented back: air is probably trapped "
    "behind the film and carries a part of the load; vent the back and press again"
)
"""Warning for presses that a calibration describes by a large discrepancy."""


def has_closed_back(presses: MeasuredPresses, charges: FilmCharges) -> bool:
    """Return whether films with a closed back explain the presses much better than films with a vented back.

    At most `MAX_EXAMINED` presses are examined, because every press on a film with a closed back needs a solve. The
    solves are omitted if a film with a vented back explains the presses well.

    Args:
        presses: The presses. Those without a place or a force are not used.
        charges: Charges of the films of the calibration.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return False
    # If there are fewer presses than rows, some rows are equal, and each press is examined only once.
    evenly_spaced_rows = np.linspace(0, len(placed) - 1, MAX_EXAMINED).round().astype(int)
    examined = placed[np.unique(evenly_spaced_rows)]

    # The charges are computed for a few pretensions, and interpolated between them.
    vented_charges = _interpolated(expected_charges(charges, examined.contact))
    vented_misfit = charge_misfit(charges, examined.contact, examined.charge_pC, vented_charges)
    is_explained = vented_misfit <= MIN_VENTED_MISFIT
    is_comparable = vented_misfit < np.inf  # the misfit is infinite if many presses lie outside the domain
    if is_explained or not is_comparable:
        return False

    contact = charges.into_domain(examined.contact)
    try:
        solved_charges = np.array([_closed_charges(charges, share, contact) for share in PRETENSIONS])
    except (SceneError, SolveError):  # a film with a closed back cannot be solved, so nothing is known about the back
        return False
    closed_charges = _interpolated(solved_charges)
    closed_misfit = charge_misfit(charges, examined.contact, examined.charge_pC, closed_charges)
    return closed_misfit < CLEARER * vented_misfit


def refuse_closed_back(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Raise an error if films with a closed back explain presses that no film with a vented back explains.

    Args:
        presses: The presses.
        charges: Charges of the films of the calibration.

    Raises:
        PressError: If films with a closed back explain the presses.
    """
    if has_closed_back(presses, charges):
        raise PressError(
            f"no film of {charges.prior.sensor.name!r} with a vented back explains these {len(presses)} presses, but "
            "films with a closed back do: air is trapped behind the film; vent the back and press again"
        )


def _interpolated(charge: Array) -> Array:
    """Interpolate charges between the pretensions of `PRETENSIONS`.

    Args:
        charge: Charges for each of `PRETENSIONS`, shape (n_pretension, n, n_electrode), pC.

    Returns:
        Charges for `INTERPOLATED_COUNT` pretensions, shape (INTERPOLATED_COUNT, n, n_electrode), pC.
    """
    shares = np.linspace(PRETENSIONS[0], PRETENSIONS[-1], INTERPOLATED_COUNT)
    # Interpolating the unit vectors gives the weight of each pretension k for each interpolated pretension i.
    weights = np.array([np.interp(shares, PRETENSIONS, unit_vector) for unit_vector in np.eye(len(PRETENSIONS))])
    return np.asarray(np.einsum("ki,kne->ine", weights, charge))


def _closed_charges(charges: FilmCharges, pretension_share: float, contact: Array) -> Array:
    """Compute the charges of the mean film of the prior with a closed back and a given pretension.

    Args:
        charges: Charges of the films of the calibration.
        pretension_share: Pretension divided by the largest pretension of the prior.
        contact: Presses (x, y, F), shape (n, 3), mm and N.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    prior = charges.prior
    parameters = prior.mean.copy()
    parameters[prior.index("pretension")] = pretension_share * prior.spread.pretension
    sensor, probe = prior.film(parameters)
    back_volume = CAVITY_DEPTH_mm * np.pi * sensor.film.radius**2
    closed_sensor = replace(sensor, film=replace(sensor.film, back_volume=back_volume))
    settings = SolveSettings(accuracy=ACCURACY)
    charge_rows = []
    for x, y, force in contact.tolist():
        solved_press = press(closed_sensor.coated_film, probe, (x, y), force, settings)
        charge_rows.append(touch_charge(closed_sensor, solved_press))
    return np.array(charge_rows)
