"""Charges of presses on any film of a prior, with their derivatives by the contact and by the film's parameters."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior
from isocharge.simulate.sensor.probe import Circle

STEP = 0.005
"""Step of the differences by a parameter, in standard deviations of its prior: the map is smooth on that scale."""

STEPPED = ("pretension", "thickness", "shift_x", "shift_y", "rotation", "probe_radius")
"""Parameters whose derivatives are differences."""

CONTACT_STEPS = (5e-3, 5e-3, 1e-3)
"""Steps of the differences in x and y (mm) and in ln F."""

REMEMBERED = 8
"""Forward maps that are remembered."""

EDGE = 1.0 - 1e-6
"""Share of the family's radius and forces within which presses are evaluated: differences stay inside."""


@dataclass(frozen=True)
class FilmCharges:
    """The forward map of every film of a prior, at the edge's units: mm, N, pC.

    Attributes:
        prior: What the parameters are.
        family: The solved films.
    """

    prior: FilmPrior
    family: FilmFamily

    @cached_property
    def radius_mm(self) -> float:
        """Largest distance of a press from the film's centre, mm."""
        return EDGE * 1e3 * self.family.limits["distance"][1] * self.prior.sensor.film.radius - CONTACT_STEPS[0]

    def forward_map(self, parameters: Array) -> ForwardMap:
        """The forward map of one film, parameters of shape (n_parameter,).

        Films that differ in coefficients, gains and electrodes only share their stresses; the last few are remembered.
        """
        sensor, probe = self.prior.film(parameters)
        key = (sensor.film, probe)
        if key not in self._maps:
            if len(self._maps) >= REMEMBERED:
                del self._maps[next(iter(self._maps))]
            self._maps[key] = self.family.forward_map(sensor, probe)
        return replace(self._maps[key], sensor=sensor)

    @cached_property
    def _maps(self) -> dict[tuple[Film, Circle], ForwardMap]:
        return {}

    def charge_pC(self, parameters: Array, contact: Array) -> Array:
        """Charges of contacts (x_mm, y_mm, force_N), shape (n, 3), on one film: (n, n_electrode)."""
        return charges_of(self.forward_map(parameters), contact)

    def into_domain(self, contact: Array) -> Array:
        """Contacts moved to the nearest that every film of the prior can be asked for, shape (n, 3)."""
        low, high = self.force_range_N
        reach = np.maximum(np.hypot(contact[:, 0], contact[:, 1]) / self.radius_mm, 1.0)
        inside: Array = np.column_stack([contact[:, :2] / reach[:, None], np.clip(contact[:, 2], low, high)])
        return inside

    @cached_property
    def force_range_N(self) -> tuple[float, float]:
        """Smallest and largest force for which every film of the prior has a map, N."""
        film = self.prior.sensor.film
        low, high = (dict(zip(self.prior.names, bound, strict=True)) for bound in self.prior.bounds)
        load = film.young * film.thickness * film.radius
        stiff, soft = (load * np.exp(bound["young"] + bound["thickness"]) for bound in (high, low))
        least, most = self.family.limits["load"]
        return float(least * stiff) * (2.0 - EDGE) * 1.01, float(most * soft) * EDGE / 1.01

    def by_contact(self, forward_map: ForwardMap, contact: Array) -> Array:
        """Derivatives by (x_mm, y_mm, ln F) at contacts (n, 3): shape (n, n_electrode, 3), pC/mm, pC/mm and pC."""
        moved = []
        for axis, step in enumerate(CONTACT_STEPS):
            for sign in (1.0, -1.0):
                at = contact.copy()
                at[:, axis] = at[:, 2] * np.exp(sign * step) if axis == 2 else at[:, axis] + sign * step
                moved.append(at)
        charge_pC = charges_of(forward_map, np.concatenate(moved)).reshape(3, 2, len(contact), -1)
        change = (charge_pC[:, 0] - charge_pC[:, 1]) / (2.0 * np.array(CONTACT_STEPS))[:, None, None]
        return np.moveaxis(change, 0, 2)

    def by_parameter(self, parameters: Array, contact: Array, by_contact: Array) -> Array:
        """Derivatives by the parameters over their prior standard deviations.

        What scales is exact: charges are E q(F / (E h a), T / E, h / a) with T the pretension, and linear in d31 and
        d32. The others are differences of small steps.

        Args:
            parameters: The film, shape (n_parameter,).
            contact: Contacts (x_mm, y_mm, force_N), shape (n, 3).
            by_contact: Derivatives by the contacts, as `by_contact` gives them.

        Returns:
            Shape (n, n_electrode, n_parameter), pC.
        """
        names = self.prior.names
        charge_pC, by_force = self.charge_pC(parameters, contact), by_contact[:, :, 2]
        steps = {name: self._by_step(name, parameters, contact, charge_pC) for name in STEPPED}
        piezo = self.prior.sensor.piezo
        without = replace(self.prior.film(parameters)[0], piezo=replace(piezo, d31=0.0, d32=piezo.d32 or piezo.d31))
        of_d32 = np.zeros_like(charge_pC)
        if piezo.d32 != 0.0:
            scale = float(np.exp(parameters[names.index("d32")]))
            of_d32 = scale * charges_of(replace(self.forward_map(parameters), sensor=without), contact)
        columns = {
            **steps,
            "young": charge_pC - by_force - parameters[0] * steps["pretension"],
            "thickness": steps["thickness"] - by_force,
            "d31": charge_pC - of_d32,
            "d32": of_d32,
        }
        gains = charge_pC[:, :, None] * np.eye(charge_pC.shape[1])
        shared = np.stack([columns[name] for name in SHARED], axis=2)
        by_parameter: Array = np.concatenate([shared, gains], axis=2) * self.prior.std
        return by_parameter

    def _by_step(self, name: str, parameters: Array, contact: Array, charge_pC: Array) -> Array:
        """Derivative by one parameter; by the thickness at one load F / (E h a), which is bending's part alone."""
        number = self.prior.names.index(name)
        step, high = STEP * self.prior.std[number], self.prior.bounds[1]
        moved = parameters.copy()
        moved[number] += step if parameters[number] + step <= high[number] else -step
        at, change = contact, moved[number] - parameters[number]
        if name == "thickness":
            at = contact * [1.0, 1.0, np.exp(change)]
        derivative: Array = (self.charge_pC(moved, at) - charge_pC) / change
        return derivative


def charges_of(forward_map: ForwardMap, contact: Array) -> Array:
    """Charges of contacts (x_mm, y_mm, force_N), shape (n, 3), pC, shape (n, n_electrode)."""
    charge_pC: Array = 1e12 * forward_map.forward(1e-3 * contact[:, 0], 1e-3 * contact[:, 1], contact[:, 2])
    return charge_pC
