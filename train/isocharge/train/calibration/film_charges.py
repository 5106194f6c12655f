"""Charges of presses on any film of a prior, with their derivatives by the contact and by the unknowns of the film.

A film is given by the parameters of `FilmPrior`, after which the coefficients of what it has besides may stand: modes
of its imperfections in units of their standard deviations, traces, and the terms of its discrepancy. `UnknownLayout`
gives the places of all of them.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate import Circle, Film, ForwardMap, Probe, Sensor
from isocharge.simulate.forward.charge_map import Domain, FunctionMap, differences
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.film_modes import MODES, ModeMap
from isocharge.simulate.forward.forward_map import EVEN_FIELD
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.numerics.disk import onto_disk
from isocharge.simulate.numerics.polygon import area_of
from isocharge.simulate.sensor.film_prior import PARAMETERS, SHARED, FilmPrior
from isocharge.train.calibration.discrepancy import TRACE_ANGLES, term_count, terms
from isocharge.train.calibration.unknowns import UnknownLayout

STEP = 0.005
"""Step of the differences by a parameter, in standard deviations of its prior: the map is smooth on that scale."""

LOAD_PARAMETERS = ("pretension", "young", "thickness")
"""Parameters by which the stress of the film depends on the load; the others move electrodes or scale charges."""

STEPPED = tuple(parameter.name for parameter in PARAMETERS if parameter.derivative == "difference")
"""Parameters whose derivatives are differences."""

CONTACT_STEPS = (5e-3, 5e-3, 1e-3)
"""Steps of the differences in x and y (mm) and in ln F: small, so that they cost little of the films' domain."""

CACHED_MAPS = 8
"""Number of forward maps that are cached."""

TRACE_STD_MM = 0.5
"""Standard deviation of the width of a trace that is not described, mm."""

TRACE_END = 0.93
"""Distance from the centre at which such traces end, over the film's radius: four millimetres matter little."""

LARGEST_UNEVENNESS = 0.9
"""Largest square of the uneven tension over that of the mean tension.

Modes with `is_uneven_tension` act on all charges alike to second order: a membrane with tensions T +- e along two axes
sags as one of sqrt(T^2 - e^2) all round, the less the more the press itself stretches it: ln Q grows by
(1 - sqrt(1 - (e / T)^2)) x (1 - (1 - x / 2)^SLACKENING), x = -d ln Q / d ln T."""

SLACKENING = 1.75
"""Fitted to full solves of 0.6 to 2 MPa, 0.05 to 1.6 N, two places, which it meets to 5 % where x is above 0.1."""

NEGLIGIBLE = 1e-3
"""Largest coefficient of the modes that counts as none: it changes charges by some 3e-5, and they take long."""

LARGEST_LOCAL_COEFFICIENT = 0.1
"""Largest coefficient of modes and traces whose effect is taken for the same on neighbouring films."""

LEAST_TENSION = 1e-3
"""Least pretension over which the uneven part is taken, MPa."""

LEAST_FACTOR = 0.05
"""Least factor of the modes: first order ends before charges change their sign."""

EDGE = 1.0 - 1e-6
"""Share of the family's radius and forces within which presses are evaluated: differences stay inside."""


class _ModeCharges(NamedTuple):
    """Charges of the modes of a film under the last presses.

    Attributes:
        modes: The modes of the film; None in a family without modes.
        sensor: The sensor that they belong to.
        contact: The presses.
        by_mode: Derivatives of the charges by the coefficients of the modes, shape (n, n_electrode, n_mode), pC.
        by_unevenness: What an uneven tension adds to ln Q, for each unit of its share; see `_unevenness`.
    """

    modes: ModeMap | None
    sensor: Sensor
    contact: Array
    by_mode: Array
    by_unevenness: Array


@dataclass(frozen=True)
class FilmCharges:
    """The forward map of every film of a prior.

    Attributes:
        prior: What the parameters are.
        family: The solved films.
    """

    prior: FilmPrior
    family: FilmFamily

    @cached_property
    def domain(self) -> Domain:
        """Contacts for which every film of the prior has charges, including those a step of the differences away."""
        film = self.prior.sensor.film
        young = self.prior.index("young")
        thickness = self.prior.index("thickness")
        load = film.young * film.thickness * film.radius
        softest, stiffest = (load * np.exp(bound[young] + bound[thickness]) for bound in self.prior.bounds)
        smallest_load, largest_load = self.family.limits["load"]
        return Domain(
            EDGE * self.family.limits["distance"][1] * film.radius - CONTACT_STEPS[0],
            (float(smallest_load * stiffest) * (2.0 - EDGE) * 1.01, float(largest_load * softest) * EDGE / 1.01),
        )

    @cached_property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes that these films have; none in a family without solved modes."""
        return tuple(MODES) if self.family.imperfections else ()

    @cached_property
    def layout(self) -> UnknownLayout:
        """Places of parameters, coefficients and nuisances in the vector of unknowns."""
        return UnknownLayout(self.prior.names, self.modes, self.prior.sensor.electrode_names)

    @cached_property
    def _mode_stds(self) -> Array:
        """Standard deviations of the modes, in their units, shape (n_mode,)."""
        return np.array([MODES[name].std for name in self.modes])

    @cached_property
    def _is_uneven_tension(self) -> Booleans:
        """Which modes lower the tension to second order, shape (n_mode,)."""
        return np.array([MODES[name].is_uneven_tension for name in self.modes], dtype=bool)

    @property
    def n_coefficient(self) -> int:
        """Number of coefficients after the parameters."""
        return self.layout.coefficient_count

    @cached_property
    def _trace_lines(self) -> Array:
        """Ends of the lines along which traces may lie, shape (n_electrode, n_line, 2, 2), mm."""
        electrodes = self.prior.sensor.electrodes
        end_radius = TRACE_END * self.prior.sensor.film.radius
        centre = np.array([complex(*electrode.centre) for electrode in electrodes])[:, None]
        areas = [area_of(np.array(electrode.corners)) for electrode in electrodes]
        pad_radius = np.sqrt(np.array(areas) / np.pi)[:, None]
        direction = np.exp(1j * (np.angle(centre) + np.deg2rad(TRACE_ANGLES)))
        along = (centre.conj() * direction).real
        to_rim = np.sqrt(along**2 + end_radius**2 - np.abs(centre) ** 2) - along
        ends = centre[:, :, None] + np.stack([pad_radius * direction, to_rim * direction], axis=2)
        return np.stack([ends.real, ends.imag], axis=3)

    def _trace_charges(self, forward_map: ForwardMap, contact: Array) -> Array:
        """Return the charges of the lines, `TRACE_STD_MM` wide, shape (n, n_electrode, n_electrode * n_line), pC."""
        n = len(contact)
        electrode_count = len(self.prior.sensor.electrodes)
        points = ReadoutPoints.along(forward_map.sensor, self._trace_lines)
        charge_per_mm = forward_map.field_charges(contact, EVEN_FIELD, points).reshape(n, electrode_count, 1, -1)
        own_electrode = np.eye(electrode_count)[:, :, None]
        return np.asarray((TRACE_STD_MM * charge_per_mm * own_electrode).reshape(n, electrode_count, -1))

    def trace_widths(self, unknowns: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Return the width of each electrode's trace beyond the described one, and its standard deviation, mm.

        Args:
            unknowns: Unknowns of a film, shape (n_parameter + n_coefficient,).
            covariance: Their covariance, parameters over their prior standard deviations.
        """
        names = self.prior.sensor.electrode_names
        traces = self.layout.traces
        width_of_lines = TRACE_STD_MM * np.eye(len(names)).repeat(len(TRACE_ANGLES), axis=1)
        widths = width_of_lines @ unknowns[traces]
        stds = np.sqrt(np.diag(width_of_lines @ covariance[traces, traces] @ width_of_lines.T))
        return {name: (float(width), float(std)) for name, width, std in zip(names, widths, stds, strict=True)}

    def forward_map(self, parameters: Array) -> ForwardMap:
        """Return the forward map of one film without a discrepancy, parameters of shape (n_parameter,).

        Films that differ in coefficients, gains and electrodes only share their stresses; the last few are cached.
        """
        sensor, probe = self.prior.film(parameters)
        key = (sensor.film, probe)
        if key not in self._maps:
            if len(self._maps) >= CACHED_MAPS:
                del self._maps[next(iter(self._maps))]
            self._maps[key] = self.family.forward_map(sensor, probe)
        return replace(self._maps[key], sensor=sensor)

    @cached_property
    def _maps(self) -> dict[tuple[Film, Circle], ForwardMap]:
        return {}

    def film(self, unknowns: Array) -> FunctionMap:
        """Return the charges of one film, shape (n_parameter,), or (n_parameter + n_coefficient,) with coefficients."""
        forward_map = self.forward_map(unknowns[self.layout.parameters])

        def charges(contact: Array) -> Array:
            charge = forward_map.charges(contact)
            return charge * self.factor(unknowns, contact, charge)

        return FunctionMap(charges, forward_map.electrodes, self.domain)

    def factor(self, unknowns: Array, contact: Array, charge: Array | None = None) -> Array:
        """Return the factors of modes, traces and discrepancy on a film's charges, shape (n, n_electrode).

        Args:
            unknowns: As `film` takes them.
            contact: (x, y, F), shape (n, 3), mm and N.
            charge: Charges without the coefficients; computed if absent.
        """
        layout = self.layout
        parameters = unknowns[layout.parameters]
        mode_coefficients = unknowns[layout.modes]
        trace_coefficients = unknowns[layout.traces]
        term_coefficients = unknowns[layout.terms]
        factor = np.ones((len(contact), len(self.prior.sensor.electrodes)))
        if np.abs(unknowns[layout.imperfections]).max(initial=0.0) > NEGLIGIBLE:
            forward_map = self.forward_map(parameters)
            charge = forward_map.charges(contact) if charge is None else charge
            if np.abs(trace_coefficients).max() > NEGLIGIBLE:
                factor += self._trace_charges(forward_map, contact) @ trace_coefficients / charge
            if np.abs(mode_coefficients).max(initial=0.0) > NEGLIGIBLE:
                modes = self._mode_charges(parameters, contact, charge)
                unevenness, _ = self._unevenness(self._pretension(parameters), mode_coefficients)
                factor += modes.by_mode @ mode_coefficients / charge
                factor *= np.exp(unevenness * modes.by_unevenness)
            factor = np.maximum(factor, LEAST_FACTOR)
        if term_coefficients.any():
            log_factor = terms(contact, self.domain) @ term_coefficients.reshape(term_count(), -1)
            factor = factor * np.exp(log_factor)
        return factor

    def _pretension(self, unknowns: Array) -> float:
        """Return the pretension of a film, MPa."""
        return float(unknowns[self.layout.parameter("pretension")])

    def _mode_charges(self, parameters: Array, contact: Array, charge: Array) -> _ModeCharges:
        """Return what the modes do to presses with these charges."""
        forward_map = self.forward_map(parameters)
        sensor = forward_map.sensor
        family = self.family.imperfections
        if family is None:
            zeros = np.zeros_like(charge)
            return _ModeCharges(None, sensor, contact, by_mode=np.zeros((*charge.shape, 0)), by_unevenness=zeros)
        key = (sensor.film, forward_map.probe)
        cached = self._cached_modes.get(key)
        if cached is not None and cached.sensor == sensor and np.array_equal(cached.contact, contact):
            return cached
        modes = cached.modes if cached is not None else None
        if modes is None:
            modes = family.mode_map(forward_map, self.modes)
        fields = replace(modes.fields, sensor=sensor) if modes.fields is not None else None
        by_mode = replace(modes, film=forward_map, fields=fields).mode_jacobian(contact)
        by_pretension = self._difference("pretension", parameters, contact, charge)
        fall = -self._pretension(parameters) * by_pretension / charge
        by_unevenness = fall * (1.0 - np.clip(1.0 - 0.5 * fall, 0.0, 1.0) ** SLACKENING)
        computed = _ModeCharges(modes, sensor, contact, by_mode * self._mode_stds, by_unevenness)
        if key not in self._cached_modes and len(self._cached_modes) > 1:
            del self._cached_modes[next(iter(self._cached_modes))]
        self._cached_modes[key] = computed
        return computed

    @cached_property
    def _cached_modes(self) -> dict[tuple[Film, Probe], _ModeCharges]:
        return {}

    def _unevenness(self, pretension: float, mode_coefficients: Array) -> tuple[float, Array]:
        """Return the share by which an uneven tension acts as a lower one, and its derivatives by the coefficients."""
        tension_stds = np.where(self._is_uneven_tension, self._mode_stds, 0.0)
        relative_stds = tension_stds / max(pretension, LEAST_TENSION)
        square = float(((relative_stds * mode_coefficients) ** 2).sum())
        root = np.sqrt(1.0 - min(square, LARGEST_UNEVENNESS))
        if square >= LARGEST_UNEVENNESS:
            return 1.0 - root, np.zeros_like(mode_coefficients)
        return 1.0 - root, relative_stds**2 * mode_coefficients / root

    def charges(self, unknowns: Array, contact: Array) -> Array:
        """Return the charges of contacts (x, y, F), shape (n, 3), mm and N, on one film: (n, n_electrode), pC."""
        return self.film(unknowns).charges(contact)

    def by_contact(self, unknowns: Array, contact: Array) -> Array:
        """Return the derivatives by (x, y, ln F) on one film, shape (n, n_electrode, 3), pC/mm, pC/mm and pC."""
        return differences(self.film(unknowns).charges, contact, CONTACT_STEPS)

    def into_domain(self, contact: Array) -> Array:
        """Return contacts moved to the nearest contact of the domain, shape (n, 3)."""
        place = onto_disk(contact[:, :2], self.domain.radius)
        return np.column_stack([place, np.clip(contact[:, 2], *self.domain.force_range)])

    def by_parameter(self, unknowns: Array, contact: Array, by_contact: Array) -> Array:
        """Return the derivatives by the parameters over their prior standard deviations, and by given coefficients.

        What scales is exact: charges are E q(F / (E h a), T / E, h / a) with T the pretension, and linear in d31 and
        d32. The others are differences of small steps. The modes are taken for the same share of the charges where
        electrodes, coefficients and probe differ a little.

        Args:
            unknowns: The film, shape (n_parameter,) or (n_parameter + n_coefficient,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            by_contact: Derivatives by the contacts, as `by_contact` gives them.

        Returns:
            Shape (n, n_electrode, n_parameter) or (n, n_electrode, n_parameter + n_coefficient), pC.
        """
        layout = self.layout
        parameters = unknowns[layout.parameters]
        coefficients = unknowns[layout.coefficients]
        film = self.forward_map(parameters)
        charge = film.charges(contact)
        by_force = by_contact[:, :, 2]
        if coefficients.any():  # the derivative of the charges without them
            force_factor = np.array([1.0, 1.0, np.exp(CONTACT_STEPS[2])])
            harder = film.charges(contact * force_factor)
            softer = film.charges(contact / force_factor)
            by_force = (harder - softer) / (2.0 * CONTACT_STEPS[2])
        film_jacobian = self._parameter_jacobian(film, parameters, contact, charge, by_force) * self.prior.std
        if not coefficients.size:
            return np.asarray(film_jacobian)
        factor = self.factor(unknowns, contact, charge)[:, :, None]
        for name, slope in self._load_slopes(unknowns, contact).items():
            number = layout.parameter(name)
            film_jacobian[:, :, number] += charge * slope * self.prior.std[number]
        if np.abs(unknowns[layout.traces]).max() > LARGEST_LOCAL_COEFFICIENT:
            for name, slope in self._trace_slopes(unknowns, contact).items():
                film_jacobian[:, :, layout.parameter(name)] += charge * slope
        film_jacobian *= factor
        modes = self._mode_charges(parameters, contact, charge)
        trace_jacobian = self._trace_charges(film, contact)
        _, unevenness_slopes = self._unevenness(self._pretension(parameters), unknowns[layout.modes])
        mode_jacobian = modes.by_mode + factor * (charge * modes.by_unevenness)[:, :, None] * unevenness_slopes
        tension_coefficients = unknowns[layout.modes] * self._is_uneven_tension  # as the pretension, they count over E
        young = layout.parameter("young")
        film_jacobian[:, :, young] -= mode_jacobian @ tension_coefficients * self.prior.std[young]
        own_charge = charge[:, :, None] * np.eye(charge.shape[1])
        term_jacobian = (factor * own_charge)[:, :, None, :] * terms(contact, self.domain)[:, None, :, None]
        return np.concatenate(
            [film_jacobian, mode_jacobian, trace_jacobian, term_jacobian.reshape(*charge.shape, -1)], axis=2
        )

    def _parameter_jacobian(
        self, film: ForwardMap, parameters: Array, contact: Array, charge: Array, by_force: Array
    ) -> Array:
        """Return the derivatives of the charges by the parameters, without coefficients."""
        columns = {name: self._difference(name, parameters, contact, charge) for name in STEPPED}
        columns["young"] = charge - by_force - self._pretension(parameters) * columns["pretension"]
        columns["thickness"] = columns["thickness"] - by_force
        piezo = film.sensor.piezo
        columns["d32"] = np.zeros_like(charge)
        if piezo.d32 != 0.0:
            d32_alone = replace(film, sensor=replace(film.sensor, piezo=replace(piezo, d31=0.0)))
            columns["d32"] = d32_alone.charges(contact)
        columns["d31"] = charge - columns["d32"]
        shared = np.stack([columns[name] for name in SHARED], axis=2)
        gain_jacobian = charge[:, :, None] * np.eye(charge.shape[1])
        return np.concatenate([shared, gain_jacobian], axis=2)

    def _without_terms(self, unknowns: Array) -> Array:
        """Return a film without the terms of its discrepancy."""
        film = unknowns.copy()
        film[self.layout.terms] = 0.0
        return film

    def _stepped(self, unknowns: Array, name: str) -> tuple[Array, float]:
        """Return a film with a small step of one parameter towards its mean, and the step in standard deviations."""
        number = self.layout.parameter(name)
        step = -STEP if unknowns[number] > self.prior.mean[number] else STEP
        stepped = unknowns.copy()
        stepped[number] += step * self.prior.std[number]
        return stepped, step

    def _load_slopes(self, unknowns: Array, contact: Array) -> dict[str, Array]:
        """Return the derivatives of ln Q of modes and traces by pretension, ln E and ln h, each (n, n_electrode).

        Modes and traces are functions of F / (E h a) and T / E, as the charges are.
        """
        film = self._without_terms(unknowns)
        if np.abs(film[self.layout.imperfections]).max() < LARGEST_LOCAL_COEFFICIENT:
            return {}
        tauter, step = self._stepped(film, "pretension")
        tension_change = step * self.prior.std[self.layout.parameter("pretension")]
        factor = self.factor(film, contact)
        harder = self.factor(film, contact * [1.0, 1.0, np.exp(CONTACT_STEPS[2])])
        by_force = (harder - factor) / CONTACT_STEPS[2]
        by_tension = (self.factor(tauter, contact) - factor) / tension_change
        slopes = {
            "pretension": by_tension,
            "young": -by_force - self._pretension(film) * by_tension,
            "thickness": -by_force,
        }
        return {name: slope / np.maximum(factor, LEAST_FACTOR) for name, slope in slopes.items()}

    def _trace_slopes(self, unknowns: Array, contact: Array) -> dict[str, Array]:
        """Return the derivatives of ln Q of traces by coefficients, place and probe over their prior's deviations.

        Each has the shape (n, n_electrode). A trace is not where its electrode is, so it answers otherwise.
        """
        film = self._without_terms(unknowns)
        film[self.layout.modes] = 0.0
        factor = self.factor(film, contact)
        slopes = {}
        for name in SHARED:
            if name in LOAD_PARAMETERS:
                continue
            stepped, step = self._stepped(film, name)
            slopes[name] = (self.factor(stepped, contact) - factor) / step / np.maximum(factor, LEAST_FACTOR)
        return slopes

    def _difference(self, name: str, parameters: Array, contact: Array, charge: Array) -> Array:
        """Return the derivative by one parameter, by a small step.

        The derivative by the thickness is at one load F / (E h a), which is the part of bending alone.
        """
        number = self.prior.index(name)
        _, upper_bounds = self.prior.bounds
        step = STEP * self.prior.std[number]
        stepped = parameters.copy()
        stepped[number] += step if parameters[number] + step <= upper_bounds[number] else -step
        change = stepped[number] - parameters[number]
        at = contact * [1.0, 1.0, np.exp(change)] if name == "thickness" else contact
        return np.asarray((self.forward_map(stepped).charges(at) - charge) / change)
