"""Charges of presses on any film of a prior, with their derivatives by the contact and by what is unknown of the film.

A film is given by the parameters of `FilmPrior`, after which the coefficients of what it has besides may stand: of the
modes of its imperfections in units of their standard deviations, and of its discrepancy.
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
from isocharge.simulate.forward.forward_map import EVEN
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.numerics.disk import onto_disk
from isocharge.simulate.numerics.polygon import area_of
from isocharge.simulate.sensor.film_prior import PARAMETERS, SHARED, FilmPrior
from isocharge.train.calibration.discrepancy import TRACE_ANGLES, term_count, terms

STEP = 0.005
"""Step of the differences by a parameter, in standard deviations of its prior: the map is smooth on that scale."""

STEPPED = tuple(parameter.name for parameter in PARAMETERS if parameter.derivative == "difference")
"""Parameters whose derivatives are differences."""

CONTACT_STEPS = (5e-3, 5e-3, 1e-3)
"""Steps of the differences in x and y (mm) and in ln F: small, so that they cost little of the films' domain."""

REMEMBERED = 8
"""Forward maps that are remembered."""

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

LITTLE = 0.1
"""Largest coefficient of the modes below which what they do is taken for the same on neighbouring films."""

LEAST_TENSION = 1e-3
"""Least pretension over which the uneven part is taken, MPa."""

LEAST_FACTOR = 0.05
"""Least factor of the modes: first order ends before charges change their sign."""

EDGE = 1.0 - 1e-6
"""Share of the family's radius and forces within which presses are evaluated: differences stay inside."""


class _Modes(NamedTuple):
    """The modes of a film, their charges under the last presses, and what an uneven tension adds to ln Q."""

    modes: ModeMap | None
    sensor: Sensor
    contact: Array
    by_mode: Array
    of_uneven: Array


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
        """Contacts for which every film of the prior has charges, those a step of the differences away included."""
        film, names = self.prior.sensor.film, self.prior.names
        young, thickness = names.index("young"), names.index("thickness")
        load = film.young * film.thickness * film.radius
        soft, stiff = (load * np.exp(bound[young] + bound[thickness]) for bound in self.prior.bounds)
        least, most = self.family.limits["load"]
        return Domain(
            EDGE * self.family.limits["distance"][1] * film.radius - CONTACT_STEPS[0],
            (float(least * stiff) * (2.0 - EDGE) * 1.01, float(most * soft) * EDGE / 1.01),
        )

    @cached_property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes that these films have; none in a family of before they were solved."""
        return tuple(MODES) if self.family.imperfections else ()

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
        return self.n_mode + term_count() * len(self.prior.sensor.electrodes)

    @property
    def n_mode(self) -> int:
        """Number of modes and of lines of traces, the first of the coefficients."""
        return len(self.modes) + len(TRACE_ANGLES) * len(self.prior.sensor.electrodes)

    @cached_property
    def _lines(self) -> Array:
        """Ends of the lines along which traces may lie, shape (n_electrode, n_line, 2, 2), mm."""
        electrodes, end = self.prior.sensor.electrodes, TRACE_END * self.prior.sensor.film.radius
        centre = np.array([complex(*e.centre) for e in electrodes])[:, None]
        reach = np.sqrt([area_of(np.array(e.corners)) / np.pi for e in electrodes])[:, None]
        direction = np.exp(1j * (np.angle(centre) + np.deg2rad(TRACE_ANGLES)))
        along = (centre.conj() * direction).real
        to_rim = np.sqrt(along**2 + end**2 - np.abs(centre) ** 2) - along
        ends = centre[:, :, None] + np.stack([reach * direction, to_rim * direction], axis=2)
        return np.stack([ends.real, ends.imag], axis=3)

    def _by_trace(self, forward_map: ForwardMap, contact: Array) -> Array:
        """Charges of the lines, `TRACE_STD_MM` wide, shape (n, n_electrode, n_electrode * n_line), pC."""
        n, count = len(contact), len(self.prior.sensor.electrodes)
        of_width = forward_map.by_field(contact, EVEN, ReadoutPoints.along(forward_map.sensor, self._lines))
        own = TRACE_STD_MM * of_width.reshape(n, count, 1, -1) * np.eye(count)[:, :, None]
        return np.asarray(own.reshape(n, count, -1))

    def trace_widths(self, unknowns: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Width of the trace of each electrode beyond what is described of it, and its standard deviation, mm.

        Args:
            unknowns: Of a film, shape (n_parameter + n_coefficient,).
            covariance: Of them, parameters over their prior standard deviations.
        """
        n, names = len(self.prior.names), self.prior.sensor.electrode_names
        lines = slice(n + len(self.modes), n + self.n_mode)
        of_each = TRACE_STD_MM * np.eye(len(names)).repeat(len(TRACE_ANGLES), axis=1)
        std = np.sqrt(np.diag(of_each @ covariance[lines, lines] @ of_each.T))
        return dict(zip(names, zip((of_each @ unknowns[lines]).tolist(), std.tolist(), strict=True), strict=True))

    def forward_map(self, parameters: Array) -> ForwardMap:
        """The forward map of one film without a discrepancy, parameters of shape (n_parameter,).

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

    def film(self, unknowns: Array) -> FunctionMap:
        """The charges of one film, shape (n_parameter,), or (n_parameter + n_coefficient,) with what it has besides."""
        forward_map = self.forward_map(unknowns[: len(self.prior.names)])

        def charges(contact: Array) -> Array:
            charge = forward_map.charges(contact)
            return charge * self.factor(unknowns, contact, charge)

        return FunctionMap(charges, forward_map.electrodes, self.domain)

    def factor(self, unknowns: Array, contact: Array, charge: Array | None = None) -> Array:
        """Factors of modes, traces and discrepancy on a film's charges, shape (n, n_electrode).

        Args:
            unknowns: As `film` takes them.
            contact: (x, y, F), shape (n, 3), mm and N.
            charge: Charges without them, if they are known.
        """
        n = len(self.prior.names)
        of_modes, of_traces, shares = np.split(unknowns[n:], [len(self.modes), self.n_mode])
        factor = np.ones((len(contact), len(self.prior.sensor.electrodes)))
        if np.abs(unknowns[n : n + self.n_mode]).max(initial=0.0) > NEGLIGIBLE:
            forward_map = self.forward_map(unknowns[:n])
            charge = forward_map.charges(contact) if charge is None else charge
            if np.abs(of_traces).max() > NEGLIGIBLE:
                factor += self._by_trace(forward_map, contact) @ of_traces / charge
            if np.abs(of_modes).max(initial=0.0) > NEGLIGIBLE:
                modes = self._by_mode(unknowns[:n], contact, charge)
                factor += modes.by_mode @ of_modes / charge
                factor *= np.exp(self._unevenness(unknowns[0], of_modes)[0] * modes.of_uneven)
        if shares.any():
            factor = np.maximum(factor, LEAST_FACTOR) * np.exp(
                terms(contact, self.domain) @ shares.reshape(term_count(), -1)
            )
        return factor

    def _by_mode(self, parameters: Array, contact: Array, charge: Array) -> _Modes:
        """What the modes do to presses with these charges."""
        forward_map, family = self.forward_map(parameters), self.family.imperfections
        sensor, key = forward_map.sensor, (forward_map.sensor.film, forward_map.probe)
        if family is None:
            none = np.zeros_like(charge)
            return _Modes(None, sensor, contact, none[:, :, None][:, :, :0], none)
        last = self._last_modes.get(key)
        known = last.modes if last and last.modes else family.mode_map(forward_map, self.modes)
        if not last or last.sensor != sensor or not np.array_equal(last.contact, contact):
            fields = known.fields and replace(known.fields, sensor=sensor)
            by_mode = replace(known, film=forward_map, fields=fields).by_mode(contact)
            falls = -parameters[0] * self._by_step("pretension", parameters, contact, charge) / charge
            of_uneven = falls * (1.0 - np.clip(1.0 - 0.5 * falls, 0.0, 1.0) ** SLACKENING)
            last = _Modes(known, sensor, contact, by_mode * self._mode_stds, of_uneven)
            if key not in self._last_modes and len(self._last_modes) > 1:
                del self._last_modes[next(iter(self._last_modes))]
            self._last_modes[key] = last
        return last

    def _unevenness(self, pretension: float, of_modes: Array) -> tuple[float, Array]:
        """Return the share by which an uneven tension acts as a lower one, and its derivatives by the coefficients."""
        share = np.where(self._is_uneven_tension, self._mode_stds, 0.0) / max(pretension, LEAST_TENSION)
        square = float(((share * of_modes) ** 2).sum())
        root = np.sqrt(1.0 - min(square, LARGEST_UNEVENNESS))
        return 1.0 - root, share**2 * of_modes / root * (square < LARGEST_UNEVENNESS)

    @cached_property
    def _last_modes(self) -> dict[tuple[Film, Probe], "_Modes"]:
        return {}

    def charges(self, unknowns: Array, contact: Array) -> Array:
        """Charges of contacts (x, y, F), shape (n, 3), mm and N, on one film: (n, n_electrode), pC."""
        return self.film(unknowns).charges(contact)

    def by_contact(self, unknowns: Array, contact: Array) -> Array:
        """Derivatives by (x, y, ln F) on one film, shape (n, n_electrode, 3), pC/mm, pC/mm and pC."""
        return differences(self.film(unknowns).charges, contact, CONTACT_STEPS)

    def into_domain(self, contact: Array) -> Array:
        """Contacts moved to the nearest of the domain, shape (n, 3)."""
        place = onto_disk(contact[:, :2], self.domain.radius)
        return np.column_stack([place, np.clip(contact[:, 2], *self.domain.force_range)])

    def by_parameter(self, unknowns: Array, contact: Array, by_contact: Array) -> Array:
        """Derivatives by the parameters over their prior standard deviations, and by coefficients if they are given.

        What scales is exact: charges are E q(F / (E h a), T / E, h / a) with T the pretension, and linear in d31 and
        d32. The others are differences of small steps.

        Args:
            unknowns: The film, shape (n_parameter,) or (n_parameter + n_coefficient,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            by_contact: Derivatives by the contacts, as `by_contact` gives them.

        Returns:
            Shape (n, n_electrode, n_parameter) or (n, n_electrode, n_parameter + n_coefficient), pC. The modes are
            taken for the same share of the charges where electrodes, coefficients and probe differ a little.
        """
        parameters, coefficients = np.split(unknowns, [len(self.prior.names)])
        film, by_force = self.forward_map(parameters), by_contact[:, :, 2]
        charge = film.charges(contact)
        if coefficients.any():
            more = np.array([1.0, 1.0, np.exp(CONTACT_STEPS[2])])
            by_force = (film.charges(contact * more) - film.charges(contact / more)) / (2.0 * CONTACT_STEPS[2])
        columns = {name: self._by_step(name, parameters, contact, charge) for name in STEPPED}
        columns["young"] = charge - by_force - parameters[0] * columns["pretension"]
        columns["thickness"] = columns["thickness"] - by_force
        piezo = film.sensor.piezo
        d32_alone = replace(film, sensor=replace(film.sensor, piezo=replace(piezo, d31=0.0)))
        columns["d32"] = d32_alone.charges(contact) if piezo.d32 != 0.0 else np.zeros_like(charge)
        columns["d31"] = charge - columns["d32"]
        shared = np.stack([columns[name] for name in SHARED], axis=2)
        own = charge[:, :, None] * np.eye(charge.shape[1])
        of_film = np.concatenate([shared, own], axis=2) * self.prior.std
        if not coefficients.size:
            return np.asarray(of_film)
        factor = self.factor(unknowns, contact, charge)[:, :, None]
        of_film[:, :, :3] += charge[:, :, None] * self._by_load(unknowns, contact) * self.prior.std[:3]
        if np.abs(coefficients[len(self.modes) : self.n_mode]).max() > LITTLE:
            of_film[:, :, 3 : len(SHARED)] += charge[:, :, None] * self._by_place(unknowns, contact)
        of_film *= factor
        modes = self._by_mode(parameters, contact, charge)
        by_trace = self._by_trace(film, contact)
        by_uneven = self._unevenness(parameters[0], coefficients[: len(self.modes)])[1]
        of_tension = self._is_uneven_tension  # as the pretension, they count over E
        of_modes = modes.by_mode + factor * (charge * modes.of_uneven)[:, :, None] * by_uneven
        of_film[:, :, 1] -= of_modes @ (coefficients[: len(self.modes)] * of_tension) * self.prior.std[1]
        of_terms = (factor * own)[:, :, None, :] * terms(contact, self.domain)[:, None, :, None]
        return np.asarray(np.concatenate([of_film, of_modes, by_trace, of_terms.reshape(*charge.shape, -1)], axis=2))

    def _by_load(self, unknowns: Array, contact: Array) -> Array:
        """Derivatives of ln Q of what the modes do by pretension, ln E and ln h, shape (n, n_electrode, 3).

        They are functions of F / (E h a) and T / E, as the charges are.
        """
        film = np.where(np.arange(unknowns.size) < len(self.prior.names) + self.n_mode, unknowns, 0.0)
        if np.abs(film[len(self.prior.names) :]).max() < LITTLE:
            return np.zeros((len(contact), len(self.prior.sensor.electrodes), 3))
        change = (-STEP if film[0] > self.prior.mean[0] else STEP) * self.prior.std[0]
        factor = self.factor(film, contact)
        stronger = self.factor(film, contact * [1.0, 1.0, np.exp(CONTACT_STEPS[2])])
        tauter = self.factor(np.append(film[0] + change, film[1:]), contact)
        by_force, by_tension = (stronger - factor) / CONTACT_STEPS[2], (tauter - factor) / change
        columns = [by_tension, -by_force - film[0] * by_tension, -by_force]
        return np.asarray(np.stack(columns, axis=2) / np.maximum(factor, LEAST_FACTOR)[:, :, None])

    def _by_place(self, unknowns: Array, contact: Array) -> Array:
        """Derivatives of ln Q of what traces do by the coefficients, place and probe over their prior's deviations.

        Shape (n, n_electrode, 6). A trace is not where its electrode is, so it answers otherwise.
        """
        film, n = np.zeros_like(unknowns), len(self.prior.names)
        film[:n], of_traces = unknowns[:n], slice(n + len(self.modes), n + self.n_mode)
        film[of_traces] = unknowns[of_traces]
        factor, columns = self.factor(film, contact), []
        for number in range(3, len(SHARED)):
            moved, step = film.copy(), -STEP if film[number] > self.prior.mean[number] else STEP
            moved[number] += step * self.prior.std[number]
            columns.append((self.factor(moved, contact) - factor) / step)
        return np.asarray(np.stack(columns, axis=2) / np.maximum(factor, LEAST_FACTOR)[:, :, None])

    def _by_step(self, name: str, parameters: Array, contact: Array, charge: Array) -> Array:
        """Derivative by one parameter; by the thickness at one load F / (E h a), which is bending's part alone."""
        number = self.prior.names.index(name)
        step, high = STEP * self.prior.std[number], self.prior.bounds[1]
        moved = parameters.copy()
        moved[number] += step if parameters[number] + step <= high[number] else -step
        change = moved[number] - parameters[number]
        at = contact * [1.0, 1.0, np.exp(change)] if name == "thickness" else contact
        return np.asarray((self.forward_map(moved).charges(at) - charge) / change)
