"""The map from contacts to charges: one protocol that everything speaks that gives or needs charges; its checks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import ChargeError, SceneError

STEPS = (0.05, 0.05, 1e-3)
"""Steps of the central differences in x and y (mm) and in ln F (dimensionless)."""

SLACK = 1.0 + 1e-9
"""Factor by which rounding may carry a contact out of a domain."""


@dataclass(frozen=True)
class Domain:
    """Contacts for which a map holds: a disk about the film's centre, and a range of forces.

    Attributes:
        radius: Largest distance from the centre, mm.
        force_range: Smallest and largest force, N.
    """

    radius: float
    force_range: tuple[float, float]

    @property
    def centre(self) -> Array:
        """Middle of (x, y, ln F), shape (3,), mm and logarithm of N."""
        low, high = np.log(self.force_range)
        return np.array([0.0, 0.0, 0.5 * (low + high)])

    @property
    def scale(self) -> Array:
        """Half width of (x, y, ln F), shape (3,), mm and logarithm of N."""
        low, high = np.log(self.force_range)
        return np.array([self.radius, self.radius, max(0.5 * (high - low), 0.05)])

    def to_unit(self, contact: Array) -> Array:
        """Contacts (x, y, F), shape (n, 3), to [-1, 1]^3: (x, y, ln F), centred and scaled."""
        logs = np.stack([contact[:, 0], contact[:, 1], np.log(contact[:, 2])], axis=1)
        return np.asarray((logs - self.centre) / self.scale)

    def to_contact(self, unit: Array) -> Array:
        """The inverse of `to_unit`: shape (..., 3) to (x, y, F), shape (..., 3)."""
        contact: Array = unit * self.scale + self.centre
        contact[..., 2] = np.exp(contact[..., 2])
        return contact

    @property
    def places(self) -> str:
        """Words that say where contacts may lie."""
        return f"at most {self.radius:g} mm from the centre"

    def within(self, radius: float) -> "Domain":
        """Return the domain of the same forces on a disk about the origin of this radius, mm."""
        return Domain(radius, self.force_range)

    def contains(self, contact: Array) -> Booleans:
        """Return which contacts (x, y, F), shape (n, 3), mm and N, lie in the domain, shape (n,); NaN does not."""
        inside = np.hypot(contact[:, 0], contact[:, 1]) <= self.radius * SLACK
        return np.asarray(inside & _are_within(contact[:, 2], self.force_range))

    def check(self, contact: Array, source: str) -> Array:
        """Return the contacts as an array of floats, and refuse contacts outside the domain.

        Args:
            contact: (x, y, F), shape (n, 3), mm and N.
            source: The map that is asked, for the message: "forward map".

        Raises:
            SceneError: If they are of another shape, or with the first contact that lies outside.
        """
        contact = as_contacts(contact, source)
        inside = self.contains(contact)
        if not inside.all():
            first_outside = int(np.argmin(inside))
            x, y, force = contact[first_outside]
            low, high = self.force_range
            raise SceneError(
                f"press {first_outside} at ({x:.4g}, {y:.4g}) mm with {force:.4g} N is outside the {source}: expected "
                f"{self.places} and {low:g} to {high:g} N"
            )
        return contact


def as_contacts(contact: Array, source: str) -> Array:
    """Contacts (x, y, F) as an array of floats, shape (n, 3).

    Raises:
        SceneError: If they are of another shape.
    """
    contact = np.asarray(contact, dtype=float)
    if contact.ndim != 2 or contact.shape[1] != 3:
        raise SceneError(
            f"{source}: expected contacts (x, y, F), shape (n, 3), mm and N, like [[3.0, -2.0, 1.0]], got shape "
            f"{contact.shape}"
        )
    return contact


class ChargeMap(Protocol):
    """Charges as a function of the contact (x, y, F), mm and N."""

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""

    @property
    def domain(self) -> Domain:
        """The contacts for which it holds."""

    def charges(self, contact: Array) -> Array:
        """Touch charges, shape (n, n_electrode), pC, of contacts (x, y, F), shape (n, 3), mm and N."""

    def derivatives(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F) at contacts, shape (n, 3): (n, n_electrode, 3), pC/mm, pC/mm and pC."""


@runtime_checkable
class LinearisedMap(ChargeMap, Protocol):
    """A charge map that gives charges and derivatives at once, in less time."""

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """What `charges` and `derivatives` give."""


def linearised(charge_map: ChargeMap, contact: Array) -> tuple[Array, Array]:
    """Charges and derivatives of contacts, at once where the map can; see `ChargeMap`."""
    if isinstance(charge_map, LinearisedMap):
        return charge_map.linearised(contact)
    return charge_map.charges(contact), charge_map.derivatives(contact)


@dataclass(frozen=True)
class FunctionMap:
    """Any function of contacts as a map, with derivatives by central differences.

    Attributes:
        function: Contacts (x, y, F), shape (n, 3), mm and N, to charges, shape (n, n_electrode), pC.
        electrodes: Names of the electrodes.
        domain: Where the function holds. Differences call it up to `STEPS` outside; state a slightly smaller domain if
            it does not hold there.
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
class _Within:
    """A map on a smaller domain; see `ChargeMap`."""

    whole: ChargeMap
    domain: Domain

    @property
    def electrodes(self) -> tuple[str, ...]:
        return self.whole.electrodes

    def charges(self, contact: Array) -> Array:
        return self.whole.charges(contact)

    def derivatives(self, contact: Array) -> Array:
        return self.whole.derivatives(contact)

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        return linearised(self.whole, contact)


def within(charge_map: ChargeMap, radius: float) -> ChargeMap:
    """The same charges on a smaller disk, radius in mm."""
    return _Within(charge_map, charge_map.domain.within(radius))


def differences(function: Callable[[Array], Array], contact: Array, steps: tuple[float, float, float] = STEPS) -> Array:
    """Central differences of a function of contacts: the only ones of the project.

    Args:
        function: Contacts (x, y, F), shape (n, 3), mm and N, to values, shape (n, k). Called once, with all steps.
        contact: Where to differentiate, shape (n, 3).
        steps: In x and y, mm, and in ln F.

    Returns:
        Derivatives by (x, y, ln F), shape (n, k, 3), in the values' unit per mm, per mm, and by ln F.
    """
    moved = []
    for axis, step in enumerate(steps):
        for sign in (1.0, -1.0):
            at = contact.copy()
            at[:, axis] = at[:, 2] * np.exp(sign * step) if axis == 2 else at[:, axis] + sign * step
            moved.append(at)
    values = np.asarray(function(np.concatenate(moved))).reshape(3, 2, len(contact), -1)
    slopes = (values[:, 0] - values[:, 1]) / (2.0 * np.array(steps))[:, None, None]
    return np.moveaxis(slopes, 0, 2)


def check_forces(force: Array | float, force_range: tuple[float, float], source: str) -> None:
    """Refuse forces outside a range (N); `source` says what has it.

    Raises:
        SceneError: If a force lies outside.
    """
    forces = np.atleast_1d(force)
    inside = _are_within(forces, force_range)
    if not inside.all():
        i, (low, high) = int(np.argmin(inside)), force_range
        which = f"force of press {i}" if forces.size > 1 else "force"
        raise SceneError(f"{which}: expected {low:g} to {high:g} N, which the {source} covers, got {forces[i]:g} N")


def _are_within(force: Array, force_range: tuple[float, float]) -> Booleans:
    """Which forces lie in a range; NaN does not."""
    return np.asarray((force >= force_range[0] / SLACK) & (force <= force_range[1] * SLACK))


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
