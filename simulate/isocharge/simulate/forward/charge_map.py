"""Charge maps, which compute charges from contacts, and checks of contacts and charges."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import ChargeError, SceneError

STEPS = (0.05, 0.05, 1e-3)
"""Steps of the central differences in x and y (mm) and in ln F (dimensionless)."""

MIN_LOG_FORCE_HALF_WIDTH = 0.05
"""Lower bound for the half width of a domain in ln F, dimensionless. It allows a domain with a single force."""

LIMIT_TOLERANCE = 1.0 + 1e-9
"""Factor by which a contact may exceed the limits of a domain because of rounding."""


@dataclass(frozen=True)
class Domain:
    """Contacts for which a map is valid: a disk about the centre of the film, and a range of forces.

    Attributes:
        radius: Largest distance from the centre, mm.
        force_range: Smallest and largest force, N.
    """

    radius: float
    force_range: tuple[float, float]

    @property
    def centre(self) -> Array:
        """Centre of the domain in (x, y, ln F), shape (3,), mm and logarithm of N."""
        low, high = np.log(self.force_range)
        return np.array([0.0, 0.0, 0.5 * (low + high)])

    @property
    def scale(self) -> Array:
        """Half width of the domain in (x, y, ln F), shape (3,), mm and logarithm of N."""
        low, high = np.log(self.force_range)
        return np.array([self.radius, self.radius, max(0.5 * (high - low), MIN_LOG_FORCE_HALF_WIDTH)])

    def is_outside(self, contact: Array) -> Booleans:
        """Return which contacts are farther from the centre than the radius, or have a force outside the range.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N. A coordinate that is NaN counts as inside.

        Returns:
            Whether each contact lies outside, shape (n,).
        """
        x, y, force = contact.T
        low, high = self.force_range
        return np.asarray((np.hypot(x, y) > self.radius) | (force < low) | (force > high))

    def to_unit(self, contact: Array) -> Array:
        """Convert contacts into (x, y, ln F), scaled to the cube [-1, 1]^3.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Scaled contacts, shape (n, 3).
        """
        logs = np.stack([contact[:, 0], contact[:, 1], np.log(contact[:, 2])], axis=1)
        return np.asarray((logs - self.centre) / self.scale)

    def to_contact(self, unit: Array) -> Array:
        """Convert scaled contacts, shape (..., 3), into contacts (x, y, F), same shape.

        This is the inverse of `to_unit`.
        """
        contact: Array = unit * self.scale + self.centre
        contact[..., 2] = np.exp(contact[..., 2])
        return contact

    @property
    def places(self) -> str:
        """Description of the positions in the domain, which error messages contain."""
        return f"at most {self.radius:g} mm from the centre"

    def within(self, radius: float) -> "Domain":
        """Return the domain with the same forces and another radius, mm."""
        return Domain(radius, self.force_range)

    def contains(self, contact: Array) -> Booleans:
        """Return which contacts lie in the domain.

        The comparison allows for rounding errors. A contact with NaN lies outside.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Whether each contact lies in the domain, shape (n,).
        """
        inside = np.hypot(contact[:, 0], contact[:, 1]) <= self.radius * LIMIT_TOLERANCE
        return np.asarray(inside & _are_within(contact[:, 2], self.force_range))

    def check(self, contact: Array, source: str) -> Array:
        """Raise an error if a contact lies outside the domain.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            source: Name of the map in the error message, such as "forward map".

        Returns:
            The contacts as an array of floats.

        Raises:
            SceneError: If the array has another shape, or a contact lies outside the domain.
        """
        contact = as_contacts(contact, source)
        inside = self.contains(contact)
        if not inside.all():
            first_outside = int(np.argmin(inside))  # the first False
            x, y, force = contact[first_outside]
            low, high = self.force_range
            raise SceneError(
                f"press {first_outside} at ({x:.4g}, {y:.4g}) mm with {force:.4g} N is outside the {source}: expected "
                f"{self.places} and {low:g} to {high:g} N"
            )
        return contact


def as_contacts(contact: Array, source: str) -> Array:
    """Convert contacts into an array of floats, and check its shape.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        source: Name of the map in the error message.

    Raises:
        SceneError: If the array has another shape.
    """
    contact = np.asarray(contact, dtype=float)
    if contact.ndim != 2 or contact.shape[1] != 3:
        raise SceneError(
            f"{source}: expected contacts (x, y, F), shape (n, 3), mm and N, like [[3.0, -2.0, 1.0]], got shape "
            f"{contact.shape}"
        )
    return contact


class ChargeMap(Protocol):
    """Map from contacts (x, y, F) to touch charges."""

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""

    @property
    def domain(self) -> Domain:
        """Contacts for which the map is valid."""

    def charges(self, contact: Array) -> Array:
        """Compute the charges of contacts (x, y, F), shape (n, 3), mm and N. The result has the shape (n, n_electrode),
        pC."""

    def derivatives(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to x, y and ln F.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 3), pC/mm, pC/mm and pC.
        """


@runtime_checkable
class LinearisedMap(ChargeMap, Protocol):
    """A charge map that computes charges and derivatives together in less time than one after the other."""

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Return the results of `charges` and `derivatives` for contacts (x, y, F), shape (n, 3), mm and N."""


def linearised(charge_map: ChargeMap, contact: Array) -> tuple[Array, Array]:
    """Return the results of `ChargeMap.charges` and `ChargeMap.derivatives`.

    If the map supports it, both are computed together.

    Args:
        charge_map: The map.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
    """
    if isinstance(charge_map, LinearisedMap):
        return charge_map.linearised(contact)
    return charge_map.charges(contact), charge_map.derivatives(contact)


@dataclass(frozen=True)
class FunctionMap:
    """A charge map that evaluates a function, with derivatives by central differences.

    Attributes:
        function: Function of contacts (x, y, F), shape (n, 3), mm and N. It returns charges, shape (n, n_electrode),
            pC.
        electrodes: Names of the electrodes.
        domain: Contacts for which the function is valid. The differences evaluate it up to `STEPS` outside the domain.
    """

    function: Callable[[Array], Array]
    electrodes: tuple[str, ...]
    domain: Domain

    def charges(self, contact: Array) -> Array:
        """See `ChargeMap`."""
        return np.asarray(self.function(contact))

    def derivatives(self, contact: Array) -> Array:
        """See `ChargeMap`."""
        return differences(self.function, contact)


@dataclass(frozen=True)
class _RestrictedMap:
    """A charge map that is restricted to a smaller domain; see `ChargeMap`."""

    unrestricted: ChargeMap
    domain: Domain

    @property
    def electrodes(self) -> tuple[str, ...]:
        return self.unrestricted.electrodes

    def charges(self, contact: Array) -> Array:
        return self.unrestricted.charges(contact)

    def derivatives(self, contact: Array) -> Array:
        return self.unrestricted.derivatives(contact)

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        return linearised(self.unrestricted, contact)


def within(charge_map: ChargeMap, radius: float) -> ChargeMap:
    """Restrict a charge map to a disk with a smaller radius (mm)."""
    return _RestrictedMap(charge_map, charge_map.domain.within(radius))


def differences(function: Callable[[Array], Array], contact: Array, steps: tuple[float, float, float] = STEPS) -> Array:
    """Compute the derivatives of a function of contacts by central differences.

    Args:
        function: Function of contacts (x, y, F), shape (n, 3), mm and N. It returns values, shape (n, k). It is
            called only once, with the contacts of all steps.
        contact: Contacts at which the derivatives are computed, shape (n, 3), mm and N.
        steps: Steps in x and y, mm, and in ln F.

    Returns:
        Derivatives with respect to (x, y, ln F), shape (n, k, 3), in the unit of the values per mm, per mm and per 1.
    """
    contact = np.asarray(contact, dtype=float)
    variable_steps = np.array(steps)
    contacts_up = _step_each_variable(contact, variable_steps)  # shape (3, n, 3), the first axis is the variable
    contacts_down = _step_each_variable(contact, -variable_steps)

    # Evaluate the function once, for the stepped contacts in the order (variable, up or down, contact).
    stepped_contacts = np.stack([contacts_up, contacts_down], axis=1)
    values = np.asarray(function(stepped_contacts.reshape(-1, 3))).reshape(3, 2, len(contact), -1)
    values_up = values[:, 0]
    values_down = values[:, 1]
    derivatives = (values_up - values_down) / (2.0 * variable_steps)[:, None, None]  # shape (3, n, k)
    return np.moveaxis(derivatives, 0, 2)


def _step_each_variable(contact: Array, steps: Array) -> Array:
    """Return three copies of contacts: one after a step in x, one after a step in y, and one after a step in ln F.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        steps: Steps in x and y, mm, and in ln F, shape (3,).

    Returns:
        Contacts (x, y, F), shape (3, n, 3), mm and N.
    """
    x_step, y_step, log_force_step = steps
    x_stepped = contact.copy()
    x_stepped[:, 0] += x_step
    y_stepped = contact.copy()
    y_stepped[:, 1] += y_step
    force_stepped = contact.copy()
    force_stepped[:, 2] *= np.exp(log_force_step)
    return np.stack([x_stepped, y_stepped, force_stepped])


def check_forces(force: Array | float, force_range: tuple[float, float], source: str) -> None:
    """Raise an error if a force lies outside a range.

    Args:
        force: Forces, a number or shape (n,), N.
        force_range: Smallest and largest force, N.
        source: Name of the map with this range in the error message.

    Raises:
        SceneError: If a force lies outside.
    """
    forces = np.atleast_1d(force)
    inside = _are_within(forces, force_range)
    if not inside.all():
        low, high = force_range
        first_outside = int(np.argmin(inside))  # the first False
        name = f"force of press {first_outside}" if forces.size > 1 else "force"
        raise SceneError(
            f"{name}: expected {low:g} to {high:g} N, which the {source} covers, got {forces[first_outside]:g} N"
        )


def _are_within(force: Array, force_range: tuple[float, float]) -> Booleans:
    """Return which forces (N) lie in a range (N). The comparison allows for rounding errors. NaN lies outside."""
    low, high = force_range
    return np.asarray((force >= low / LIMIT_TOLERANCE) & (force <= high * LIMIT_TOLERANCE))


def check_radius(radius: float, largest: float, source: str) -> None:
    """Raise an error if a radius is not positive or too large.

    Args:
        radius: Radius, mm.
        largest: Largest accepted radius, mm.
        source: Name of the map with this limit in the error message.

    Raises:
        SceneError: If the radius lies outside.
    """
    if not 0.0 < radius <= largest * LIMIT_TOLERANCE:
        raise SceneError(f"radius: expected up to the {source}'s {largest:g} mm, got {radius:g} mm")


def check_determined(electrodes: int) -> None:
    """Raise an error if a sensor has too few electrodes to determine a contact.

    Raises:
        SceneError: If there are fewer than three electrodes.
    """
    if electrodes < 3:
        raise SceneError(
            f"expected at least three electrodes, got {electrodes}: x, y and the force are three unknowns, so with "
            "fewer charges a whole line of contacts has the same charges; add an electrode"
        )


def as_charges(charge: Array, electrode_names: tuple[str, ...]) -> Array:
    """Convert charges into an array of floats, and check its shape and values.

    Args:
        charge: Charges, shape (n, n_electrode), pC.
        electrode_names: Names of the electrodes, in the order of the charges.

    Returns:
        The charges, shape (n, n_electrode), pC.

    Raises:
        ChargeError: If the charges are not finite or not one for each electrode.
    """
    charge = np.asarray(charge, dtype=float)
    n_electrode = len(electrode_names)
    if charge.ndim != 2 or charge.shape[1] != n_electrode:
        raise ChargeError(
            f"expected charges of shape (n, {n_electrode}) for {electrode_names}, got shape {charge.shape}"
        )
    if not np.isfinite(charge).all():
        row, column = np.argwhere(~np.isfinite(charge))[0]  # the first such charge
        raise ChargeError(
            f"charge of {electrode_names[column]!r} in press {row}: expected a finite number, got {charge[row, column]}"
        )
    return charge
