"""Charges of presses on any film of a prior, and their derivatives with respect to the contact and the film.

A film is described by a vector of unknowns. The parameters of `FilmPrior` come first. The parameters may be followed by
three kinds of coefficients: coefficients of the modes of imperfections, in units of their standard deviations;
coefficients of traces that the sensor file does not describe; and coefficients of the terms of the discrepancy.
`UnknownLayout` defines the order of the unknowns.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate import Film, ForwardMap, Probe
from isocharge.simulate.forward.charge_map import FunctionMap, differences
from isocharge.simulate.forward.film_modes import MODES, ModeMap
from isocharge.simulate.numerics.disk import onto_disk
from isocharge.simulate.sensor.film_prior import SHARED
from isocharge.train.calibration.discrepancy import term_count, terms
from isocharge.train.calibration.film_maps import CONTACT_STEPS, STEP, FilmMaps, log_force_derivative
from isocharge.train.calibration.imperfections import (
    ModeCharges,
    log_unevenness,
    tension_unevenness,
    trace_charges,
    trace_lines,
    trace_widths,
)
from isocharge.train.calibration.unknowns import UnknownLayout

LOAD_PARAMETERS = ("pretension", "young", "thickness")
"""Parameters that change the stress of the film under a load. The others move electrodes or scale charges."""

NEGLIGIBLE = 1e-3
"""Coefficient below which modes and traces are not computed, because they change the charges by less than 1e-4."""

LARGEST_LOCAL_COEFFICIENT = 0.1
"""Largest coefficient of modes and traces whose factor is assumed to be the same on neighbouring films."""

MIN_FACTOR = 0.05
"""Lower bound for the factor of modes and traces. The first-order expansion is not valid for smaller factors."""


@dataclass(frozen=True)
class FilmCharges(FilmMaps):
    """Charges of all films of a prior, including the effects of imperfections, traces and discrepancy."""

    @cached_property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes of these films. The tuple is empty if no modes of the family were solved."""
        return tuple(MODES) if self.family.imperfections else ()

    @cached_property
    def layout(self) -> UnknownLayout:
        """Indices of the parameters, coefficients and nuisances in the vector of unknowns."""
        return UnknownLayout(self.prior.names, self.modes, self.prior.sensor.electrode_names)

    @cached_property
    def _mode_stds(self) -> Array:
        """Standard deviations of the modes, in the units of the modes, shape (n_mode,)."""
        return np.array([MODES[name].std for name in self.modes])

    @cached_property
    def _is_uneven_tension(self) -> Booleans:
        """Whether each mode is an uneven tension, shape (n_mode,).

        To second order, these modes act like a lower mean tension.
        """
        return np.array([MODES[name].is_uneven_tension for name in self.modes], dtype=bool)

    @property
    def n_coefficient(self) -> int:
        """Number of coefficients after the parameters."""
        return self.layout.coefficient_count

    @cached_property
    def _trace_lines(self) -> Array:
        """Ends of the lines along which traces may lie; see `trace_lines`."""
        return trace_lines(self.prior.sensor)

    def trace_widths(self, unknowns: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Return the total width of the traces of each electrode that the sensor file does not describe.

        Args:
            unknowns: Parameters and coefficients of a film, shape (n_parameter + n_coefficient,).
            covariance: Covariance of the unknowns, with parameters in units of their prior standard deviations.

        Returns:
            Width and its standard deviation by the name of the electrode, mm.
        """
        traces = self.layout.traces
        widths, stds = trace_widths(unknowns[traces], covariance[traces, traces])
        names = self.prior.sensor.electrode_names
        return {name: (float(width), float(std)) for name, width, std in zip(names, widths, stds, strict=True)}

    def film(self, unknowns: Array) -> FunctionMap:
        """Return the charges of one film as a function of the contact.

        Args:
            unknowns: Parameters of the film, shape (n_parameter,), or parameters and coefficients, shape
                (n_parameter + n_coefficient,).
        """
        forward_map = self.forward_map(unknowns[self.layout.parameters])

        def charges(contact: Array) -> Array:
            """Return the charges of contacts (x, y, F), shape (n, n_electrode), pC."""
            charge = forward_map.charges(contact)
            return charge * self.factor(unknowns, contact, charge)

        return FunctionMap(charges, forward_map.electrodes, self.domain)

    def factor(self, unknowns: Array, contact: Array, charge: Array | None = None) -> Array:
        """Compute the factors by which modes, traces and discrepancy change the charges of a film.

        Modes are imperfections of the film, such as an uneven tension. Traces are lines to the electrodes that collect
        charge. The discrepancy is a polynomial of the contact for ln(factor). Modes and traces with negligible
        coefficients are left out, because their charges take time to compute.

        Args:
            unknowns: Parameters and coefficients, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges without modes, traces and discrepancy, shape (n, n_electrode), pC. If None, they
                are computed.

        Returns:
            Factors, shape (n, n_electrode), dimensionless.
        """
        layout = self.layout
        factor = np.ones((len(contact), len(self.prior.sensor.electrodes)))
        if np.abs(unknowns[layout.imperfections]).max(initial=0.0) > NEGLIGIBLE:
            if charge is None:
                charge = self.forward_map(unknowns[layout.parameters]).charges(contact)
            factor = self._imperfection_factor(unknowns, contact, charge)

        term_coefficients = unknowns[layout.terms]
        if term_coefficients.any():
            coefficients_by_term = term_coefficients.reshape(term_count(), -1)  # shape (n_term, n_electrode)
            log_factor = terms(contact, self.domain) @ coefficients_by_term
            factor = factor * np.exp(log_factor)
        return factor

    def _imperfection_factor(self, unknowns: Array, contact: Array, charge: Array) -> Array:
        """Compute the factors by which modes and traces change the charges of a film.

        Modes and traces add charges, so the factor is 1 plus the added charges over the charges without them. An uneven
        tension also causes a factor of second order. The result is at least `MIN_FACTOR`.

        Args:
            unknowns: Parameters and coefficients, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges without modes and traces, shape (n, n_electrode), pC.

        Returns:
            Factors, shape (n, n_electrode), dimensionless.
        """
        layout = self.layout
        parameters = unknowns[layout.parameters]
        mode_coefficients = unknowns[layout.modes]
        trace_coefficients = unknowns[layout.traces]
        factor = np.ones_like(charge)

        # First order: the added charges are proportional to the coefficients.
        if np.abs(trace_coefficients).max() > NEGLIGIBLE:
            forward_map = self.forward_map(parameters)
            trace_jacobian = trace_charges(forward_map, self._trace_lines, contact)  # shape (n, n_electrode, n_trace)
            factor += trace_jacobian @ trace_coefficients / charge
        if np.abs(mode_coefficients).max(initial=0.0) > NEGLIGIBLE:  # there may be no modes
            modes = self._mode_charges(parameters, contact, charge)
            factor += modes.mode_jacobian @ mode_coefficients / charge

            # Second order: an uneven tension acts like a lower mean tension.
            unevenness, _ = self._unevenness(self._pretension(parameters), mode_coefficients)
            factor *= np.exp(unevenness * modes.log_unevenness)
        return np.maximum(factor, MIN_FACTOR)

    def _pretension(self, unknowns: Array) -> float:
        """Return the pretension of a film, MPa."""
        return float(unknowns[self.layout.parameter("pretension")])

    def _mode_charges(self, parameters: Array, contact: Array, charge: Array) -> ModeCharges:
        """Return the effects of the modes on the charges of presses, from a cache if possible.

        The modes depend only on the film and the probe, but their charges also depend on the sensor and on the
        contacts. A cached result is therefore returned for the same film, probe, sensor and contacts. If only film and
        probe are the same, the modes are taken from the cache, and their charges are computed.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts without modes, shape (n, n_electrode), pC.
        """
        forward_map = self.forward_map(parameters)
        sensor = forward_map.sensor
        if self.family.imperfections is None:
            no_modes = np.zeros((*charge.shape, 0))
            return ModeCharges(None, sensor, contact, mode_jacobian=no_modes, log_unevenness=np.zeros_like(charge))

        film_and_probe = (sensor.film, forward_map.probe)
        cached = self._cached_modes.get(film_and_probe)
        if cached is not None and cached.sensor == sensor and np.array_equal(cached.contact, contact):
            return cached
        if cached is not None and cached.modes is not None:
            modes = cached.modes
        else:
            modes = self.family.imperfections.mode_map(forward_map, self.modes)
        computed = self._computed_mode_charges(modes, forward_map, parameters, contact, charge)
        self._cache_mode_charges(film_and_probe, computed)
        return computed

    def _cache_mode_charges(self, film_and_probe: tuple[Film, Probe], computed: ModeCharges) -> None:
        """Store a result of `_mode_charges`. The cache contains the results for at most two films."""
        is_full = len(self._cached_modes) > 1
        if is_full and film_and_probe not in self._cached_modes:
            oldest_key = next(iter(self._cached_modes))
            del self._cached_modes[oldest_key]
        self._cached_modes[film_and_probe] = computed

    def _computed_mode_charges(
        self, modes: ModeMap, forward_map: ForwardMap, parameters: Array, contact: Array, charge: Array
    ) -> ModeCharges:
        """Compute the effects of the modes on the charges of presses.

        Args:
            modes: The modes of the film.
            forward_map: Forward map of the film.
            parameters: Parameters of the film, shape (n_parameter,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts without modes, shape (n, n_electrode), pC.
        """
        # The modes belong to a film, and are evaluated here with the electrodes and the gains of this sensor.
        sensor = forward_map.sensor
        fields = replace(modes.fields, sensor=sensor) if modes.fields is not None else None
        modes_of_sensor = replace(modes, film=forward_map, fields=fields)
        mode_jacobian = modes_of_sensor.mode_jacobian(contact) * self._mode_stds  # per standard deviation of each mode

        pretension_derivative = self.difference("pretension", parameters, contact, charge)
        log_tension_derivative = self._pretension(parameters) * pretension_derivative / charge  # d ln Q / d ln T
        return ModeCharges(modes, sensor, contact, mode_jacobian, log_unevenness(log_tension_derivative))

    @cached_property
    def _cached_modes(self) -> dict[tuple[Film, Probe], ModeCharges]:
        """Cache of `_mode_charges`, by film and probe. The first entry is the oldest one."""
        return {}

    def _unevenness(self, pretension: float, mode_coefficients: Array) -> tuple[float, Array]:
        """Return the unevenness of the tension and its derivatives; see `tension_unevenness`."""
        tension_stds = np.where(self._is_uneven_tension, self._mode_stds, 0.0)
        return tension_unevenness(pretension, tension_stds, mode_coefficients)

    def charges(self, unknowns: Array, contact: Array) -> Array:
        """Compute the charges of contacts on one film.

        Args:
            unknowns: Parameters and coefficients of the film, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        return self.film(unknowns).charges(contact)

    def by_contact(self, unknowns: Array, contact: Array) -> Array:
        """Compute the derivatives of the charges of one film with respect to (x, y, ln F).

        Args:
            unknowns: Parameters and coefficients of the film, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 3), pC/mm, pC/mm and pC.
        """
        return differences(self.film(unknowns).charges, contact, CONTACT_STEPS)

    def into_domain(self, contact: Array) -> Array:
        """Return the nearest contacts of the domain.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
        """
        position = onto_disk(contact[:, :2], self.domain.radius)
        force = np.clip(contact[:, 2], *self.domain.force_range)
        return np.column_stack([position, force])

    def by_parameter(self, unknowns: Array, contact: Array, by_contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the unknowns of the film.

        With the pretension T, the charges have the form E q(F / (E h a), T / E, h / a). They are linear in d31 and d32.
        The derivatives with respect to the scales are therefore exact, and the others are finite differences. Small
        changes of electrodes, coefficients and probe are assumed not to change the factor of the modes.

        Args:
            unknowns: Parameters of the film, shape (n_parameter,), or parameters and coefficients, shape
                (n_parameter + n_coefficient,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            by_contact: Derivatives with respect to the contacts, as the method `by_contact` returns them.

        Returns:
            Derivatives with respect to the parameters over their prior standard deviations, shape (n, n_electrode,
            n_parameter), or with respect to parameters and coefficients, shape (n, n_electrode, n_parameter +
            n_coefficient), pC.
        """
        layout = self.layout
        parameters = unknowns[layout.parameters]
        coefficients = unknowns[layout.coefficients]
        film = self.forward_map(parameters)
        charge = film.charges(contact)
        force_derivative = by_contact[:, :, 2]
        if coefficients.any():
            force_derivative = log_force_derivative(film, contact)
        film_jacobian = self.parameter_jacobian(film, parameters, contact, charge, force_derivative)
        film_jacobian *= self.prior.std
        if not coefficients.size:
            return np.asarray(film_jacobian)

        # Product rule: the charge is that of the film without coefficients times the factor of the coefficients.
        factor = self.factor(unknowns, contact, charge)[:, :, None]
        for name, log_derivative in self._load_slopes(unknowns, contact).items():
            index = layout.parameter(name)
            film_jacobian[:, :, index] += charge * log_derivative * self.prior.std[index]
        if np.abs(unknowns[layout.traces]).max() > LARGEST_LOCAL_COEFFICIENT:
            for name, log_derivative in self._trace_slopes(unknowns, contact).items():
                film_jacobian[:, :, layout.parameter(name)] += charge * log_derivative
        film_jacobian *= factor

        # Modes add charge, and an uneven tension multiplies the charge by exp(unevenness * log_unevenness).
        modes = self._mode_charges(parameters, contact, charge)
        _, unevenness_slopes = self._unevenness(self._pretension(parameters), unknowns[layout.modes])
        log_unevenness_charge = (charge * modes.log_unevenness)[:, :, None]
        mode_jacobian = modes.mode_jacobian + factor * log_unevenness_charge * unevenness_slopes
        # Uneven tensions are relative to E, as the pretension is, so that they contribute to the derivative of ln E.
        tension_coefficients = unknowns[layout.modes] * self._is_uneven_tension
        young = layout.parameter("young")
        film_jacobian[:, :, young] -= mode_jacobian @ tension_coefficients * self.prior.std[young]

        trace_jacobian = trace_charges(film, self._trace_lines, contact)
        # A coefficient of the discrepancy changes only the charge of its own electrode, so a diagonal matrix is used.
        own_charge = factor * charge[:, :, None] * np.eye(charge.shape[1])  # shape (n, n_electrode, n_electrode)
        term_values = terms(contact, self.domain)  # shape (n, n_term)
        # Shape (n, n_electrode, n_term, n_electrode of the coefficient), whose last two axes are joined
        term_products = own_charge[:, :, None, :] * term_values[:, None, :, None]
        term_jacobian = term_products.reshape(*charge.shape, -1)
        return np.concatenate([film_jacobian, mode_jacobian, trace_jacobian, term_jacobian], axis=2)

    def _without_terms(self, unknowns: Array) -> Array:
        """Return parameters and coefficients of a film, with the terms of the discrepancy set to zero."""
        film = unknowns.copy()
        film[self.layout.terms] = 0.0
        return film

    def _stepped(self, unknowns: Array, name: str) -> tuple[Array, float]:
        """Change one parameter by a small step towards its prior mean, so that it remains within its bounds.

        Args:
            unknowns: Parameters and coefficients of a film.
            name: Name of the parameter.

        Returns:
            Changed parameters and coefficients, and the step in prior standard deviations.
        """
        index = self.layout.parameter(name)
        step = -STEP if unknowns[index] > self.prior.mean[index] else STEP
        stepped = unknowns.copy()
        stepped[index] += step * self.prior.std[index]
        return stepped, step

    def _load_slopes(self, unknowns: Array, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of ln(factor of modes and traces) with respect to pretension, ln E and ln h.

        T is the pretension, E is Young's modulus, h is the thickness, and a is the radius of the film. Like the
        charges, the factor depends on them only through F / (E h a) and T / E. Two finite differences, one with respect
        to ln F and one with respect to T, therefore determine all three derivatives.

        Args:
            unknowns: Parameters and coefficients of the film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives by the name of the parameter, each of shape (n, n_electrode). There are none if the
            coefficients of modes and traces are small, because the derivatives are negligible then.
        """
        film = self._without_terms(unknowns)  # the discrepancy does not depend on the parameters
        if np.abs(film[self.layout.imperfections]).max() < LARGEST_LOCAL_COEFFICIENT:
            return {}

        # Finite difference with respect to ln F
        factor = self.factor(film, contact)
        _, _, log_force_step = CONTACT_STEPS
        factor_with_force = self.factor(film, contact * [1.0, 1.0, np.exp(log_force_step)])
        force_derivative = (factor_with_force - factor) / log_force_step

        # Finite difference with respect to T
        film_with_tension, step = self._stepped(film, "pretension")
        tension_step = step * self.prior.std[self.layout.parameter("pretension")]
        tension_derivative = (self.factor(film_with_tension, contact) - factor) / tension_step

        # Chain rule for factor = f(F / (E h a), T / E): d/d ln h = -d/d ln F, and d/d ln E = -d/d ln F - T d/dT
        derivatives = {
            "pretension": tension_derivative,
            "young": -force_derivative - self._pretension(film) * tension_derivative,
            "thickness": -force_derivative,
        }
        positive_factor = np.maximum(factor, MIN_FACTOR)
        return {name: derivative / positive_factor for name, derivative in derivatives.items()}  # of ln(factor)

    def _trace_slopes(self, unknowns: Array, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of ln(factor of traces) with respect to the parameters that do not change the load.

        These parameters are the piezoelectric coefficients, the place of the electrodes and the radius of the probe. A
        trace and its electrode lie at different places, so the relative changes of their charges are different.

        Args:
            unknowns: Parameters and coefficients of the film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives with respect to each parameter over its prior standard deviation, by the name of the parameter,
            each of shape (n, n_electrode).
        """
        # A film with the traces alone. The factors of discrepancy and modes are assumed not to change.
        film = self._without_terms(unknowns)
        film[self.layout.modes] = 0.0
        factor = self.factor(film, contact)
        log_derivatives = {}
        for name in SHARED:
            if name in LOAD_PARAMETERS:
                continue
            stepped_film, step = self._stepped(film, name)
            derivative = (self.factor(stepped_film, contact) - factor) / step
            log_derivatives[name] = derivative / np.maximum(factor, MIN_FACTOR)  # d ln f = df / f
        return log_derivatives
