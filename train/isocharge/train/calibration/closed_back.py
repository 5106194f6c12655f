"""Detection of a closed back, which traps air behind the film.

A calibration assumes a vented back, which lets air flow out of the space behind the film. If the back is closed, the
trapped air carries a part of the load. The electrodes away from the probe then collect much less charge than on any
film with a vented back. A calibration that does not examine the back would therefore estimate a large discrepancy, or
refuse the presses and not name the reason.

If no film with a vented back agrees with the presses, the presses are also compared with a few films that have a closed
back. The charges of the films with a closed back are simulated directly. This simulation takes a few seconds.
"""

from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError, SceneError, SolveError
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.simulate import SolveSettings, press, touch_charge
from isocharge.train.calibration.diagnosis import BETTER_MISFIT_RATIO, PRETENSIONS, charge_misfit, expected_charges
from isocharge.train.calibration.film_charges import FilmCharges

MAX_EXPLAINED_MISFIT = 0.5
"""Misfit of films with a vented back, as `charge_misfit` returns it, up to which a closed back is not considered."""

CAVITY_DEPTH_mm = 20.0
"""Depth of the cavity behind the simulated films with a closed back, mm.

Up to a depth of about 200 mm, the trapped air is so stiff that the depth hardly matters.
"""

INTERPOLATED_COUNT = 25
"""Number of pretensions for which charges are interpolated, from the first to the last of `PRETENSIONS`."""

MAX_EXAMINED = 8
"""Largest number of presses that are compared with the films with a closed back."""

ACCURACY = 5e-3
"""Relative error of the simulated charges, which is far below the effect of a closed back."""

CLOSED_BACK_CAUTION = (
    "films with a closed back explain the presses far better than films with a vented back: air is probably trapped "
    "behind the film and carries a part of the load; vent the back and press again"
)
"""Warning for presses that a calibration explains by a large discrepancy, although the back is probably closed."""


def has_closed_back(presses: MeasuredPresses, charges: FilmCharges) -> bool:
    """Return whether films with a closed back explain the presses much better than films with a vented back.

    At most `MAX_EXAMINED` presses are examined, because each press on a film with a closed back has to be simulated.
    Nothing is simulated if a film with a vented back explains the presses well. The result is then False.

    Args:
        presses: The presses. A press whose place or force is unknown is not used.
        charges: Model of the charges of all films of the calibration, which have a vented back.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return False
    # If there are fewer presses than `MAX_EXAMINED`, some rows are repeated. `np.unique` removes the repetitions.
    evenly_spaced_rows = np.linspace(0, len(placed) - 1, MAX_EXAMINED).round().astype(int)
    examined = placed[np.unique(evenly_spaced_rows)]

    # The charges are computed for the pretensions in `PRETENSIONS`, and interpolated for pretensions between them.
    vented_charges = _interpolate_pretensions(expected_charges(charges, examined.contact))
    vented_misfit = charge_misfit(charges, examined.contact, examined.charge_pC, vented_charges)
    is_explained = vented_misfit <= MAX_EXPLAINED_MISFIT
    is_comparable = vented_misfit < np.inf  # the misfit is infinite if many presses lie outside the domain
    if is_explained or not is_comparable:
        return False

    contact = charges.into_domain(examined.contact)  # as `expected_charges` moves the contacts for a vented back
    try:
        solved_charges = np.array([_simulate_closed_back(charges, share, contact) for share in PRETENSIONS])
    except (SceneError, SolveError):
        return False  # a film with a closed back cannot be simulated, so there is no evidence for a closed back
    closed_charges = _interpolate_pretensions(solved_charges)
    closed_misfit = charge_misfit(charges, examined.contact, examined.charge_pC, closed_charges)
    return closed_misfit < BETTER_MISFIT_RATIO * vented_misfit


def refuse_closed_back(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Raise an error if films with a closed back explain the presses much better than films with a vented back.

    Args:
        presses: The presses, which no film with a vented back explains.
        charges: Model of the charges of all films of the calibration, which have a vented back.

    Raises:
        PressError: If films with a closed back explain the presses much better; see `has_closed_back`.
    """
    if has_closed_back(presses, charges):
        raise PressError(
            f"no film of {charges.prior.sensor.name!r} with a vented back explains these {len(presses)} presses, but "
            "films with a closed back do: air is trapped behind the film; vent the back and press again"
        )


def _interpolate_pretensions(charge: Array) -> Array:
    """Interpolate charges linearly between the pretensions in `PRETENSIONS`.

    Args:
        charge: Charges for each pretension in `PRETENSIONS`, shape (n_pretension, n, n_electrode), pC.

    Returns:
        Charges for `INTERPOLATED_COUNT` pretensions, shape (INTERPOLATED_COUNT, n, n_electrode), pC.
    """
    interpolated_pretensions = np.linspace(PRETENSIONS[0], PRETENSIONS[-1], INTERPOLATED_COUNT)
    # Interpolation of the k-th unit vector gives the weight of pretension k at each interpolated pretension i. The
    # weights have the shape (n_pretension, INTERPOLATED_COUNT).
    unit_vectors = np.eye(len(PRETENSIONS))
    weights = np.array([np.interp(interpolated_pretensions, PRETENSIONS, vector) for vector in unit_vectors])
    # Sum over the pretensions k, for each press n and electrode e
    return np.asarray(np.einsum("ki,kne->ine", weights, charge))


def _simulate_closed_back(charges: FilmCharges, pretension_share: float, contact: Array) -> Array:
    """Simulate the charges of presses on the mean film of the prior, with a given pretension and a closed back.

    The back is closed by a cavity with the depth `CAVITY_DEPTH_mm` and the area of the film.

    Args:
        charges: Model of the charges of all films of the calibration, with their prior.
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
        solved_press = press(closed_sensor.film, probe, (x, y), force, settings)
        charge_rows.append(touch_charge(closed_sensor, solved_press))
    return np.array(charge_rows)
