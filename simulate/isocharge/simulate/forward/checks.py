"""Checks of radii, forces and charges that a user gives."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, SceneError
from isocharge.simulate.forward.charge_map import SLACK


def check_forces(force: Array | float, force_range: tuple[float, float], source: str) -> None:
    """Refuse forces outside a range (N); `source` says what has it.

    Raises:
        SceneError: If a force lies outside.
    """
    forces = np.asarray(force)
    outside = np.flatnonzero(~_within(forces, force_range))
    if outside.size:
        i, (low, high) = outside[0], force_range
        which = f"force of press {i}" if forces.ndim else "force"
        raise SceneError(
            f"{which}: expected {low:g} to {high:g} N, which the {source} covers, got {forces.flat[i]:g} N"
        )


def check_radius(radius: float, largest: float, source: str) -> None:
    """Refuse a radius (mm) that is not positive or larger than `largest`; `source` says what has that limit.

    Raises:
        SceneError: If the radius lies outside.
    """
    if not 0.0 < radius <= largest * SLACK:
        raise SceneError(f"radius: expected up to the {source}'s {largest:g} mm, got {radius:g} mm")


def check_determined(electrodes: int) -> None:
    """Refuse sensors whose charges cannot determine a contact anywhere.

    Raises:
        SceneError: If there are fewer than three electrodes.
    """
    if electrodes < 3:
        raise SceneError(
            f"expected at least three electrodes, got {electrodes}: x, y and the force are three unknowns, so with "
            "fewer charges a whole line of contacts has the same ones; add an electrode"
        )


def as_charges(charge: Array, electrode_names: tuple[str, ...]) -> Array:
    """Charges of presses as float64, one for each electrode.

    Args:
        charge: Charges, shape (n, n_electrode), pC.
        electrode_names: In the order of the charges.

    Raises:
        ChargeError: If the charges are not finite or not one for each electrode.
    """
    charge = np.asarray(charge, dtype=float)
    count = len(electrode_names)
    if charge.ndim != 2 or charge.shape[1] != count:
        raise ChargeError(f"expected charges of shape (n, {count}) for {electrode_names}, got shape {charge.shape}")
    if not np.isfinite(charge).all():
        row, column = np.argwhere(~np.isfinite(charge))[0]
        raise ChargeError(
            f"charge of {electrode_names[column]!r} in press {row}: expected a finite number, got {charge[row, column]}"
        )
    return charge


def _within(force: Array, force_range: tuple[float, float]) -> np.ndarray:
    """Which forces lie in a range; NaN does not."""
    low, high = force_range
    return np.asarray((force >= low / SLACK) & (force <= high * SLACK))
