"""Charges of presses on any film of a prior, and the derivatives of these charges.

A film is described by a vector of unknowns. The first unknowns are the parameters of `FilmPrior`. The parameters may be
followed by coefficients, which describe imperfections of the film (modes), traces and the discrepancy. A mode is a
first-order change of the charges by one imperfection. The coefficient of a mode is in units of the standard deviation
of the mode. The coefficients of traces describe only traces that the sensor file does not contain. `UnknownLayout`
defines the order of the unknowns.
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
    tension_unevenness,
    trace_charges,
    trace_lines,
    trace_widths,
    unevenness_derivative,
)
from isocharge.train.calibration.unknowns import UnknownLayout

LOAD_PARAMETERS = ("pretension", "young", "thickness")
"""Parameters that change the stress of the film under a load."""

LARGEST_LOCAL_COEFFICIENT = 0.1
"""Largest coefficient of modes and traces for which their factor is assumed not to depend on the parameters.

The factor is that by which modes and traces multiply the charges."""

MIN_FACTOR = 0.05
"""Lower bound for the factor of modes and traces. The first-order expansion is not valid for smaller factors."""

MAX_CACHED_MODES = 2
"""Largest number of films whose modes and mode charges are cached."""


@dataclass(frozen=True)
class FilmCharges(FilmMaps):
    """Model that computes the charges of all films of a prior, including imperfections, traces and the discrepancy."""

    @cached_property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes of imperfections. The tuple is empty if no modes were computed for these films."""
        return tuple(MODES) if self.family.imperfections else ()

    @cached_property
    def layout(self) -> UnknownLayout:
        """Indices of the parameters, coefficients and nuisances in the vector of unknowns."""
        return UnknownLayout(self.prior.names, self.modes, self.prior.sensor.electrode_names)

    @cached_property
    def _mode_stds(self) -> Array:
        """Standard deviation of the size of each mode among typical films, in the unit of the mode, shape (n_mode,)."""
        return np.array([MODES[name].std for name in self.modes])

    @cached_property
    def _is_uneven_tension(self) -> Booleans:
        """Whether each mode is an uneven tension of the film, shape (n_mode,).

        In second order, such a mode has the same effect as a lower mean tension.
        """
        return np.array([MODES[name].is_uneven_tension for name in self.modes], dtype=bool)

    @property
    def n_coefficient(self) -> int:
        """Number of coefficients after the parameters."""
        return self.layout.coefficient_count

    @cached_property
    def _trace_lines(self) -> Array:
        """Both ends of each line along which a trace may lie; see `trace_lines`."""
        return trace_lines(self.prior.sensor)

    def trace_widths(self, unknowns: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Estimate, for each electrode, the total width of its traces that the sensor file does not contain.

        Args:
            unknowns: Parameters and coefficients of a film, shape (n_parameter + n_coefficient,).
            covariance: Covariance of the unknowns, in which parameters are in units of their prior standard deviations.

        Returns:
            For the name of each electrode, the width and the standard deviation of the width, mm.
        """
        traces = self.layout.traces
        widths, stds = trace_widths(unknowns[traces], covariance[traces, traces])
        names = self.prior.sensor.electrode_names
        return {name: (float(width), float(std)) for name, width, std in zip(names, widths, stds, strict=True)}

    def film(self, unknowns: Array) -> FunctionMap:
        """Return the map from contacts to the charges of one film.

        Args:
            unknowns: Parameters of the film, shape (n_parameter,), or parameters and coefficients, shape
                (n_parameter + n_coefficient,).
        """
        forward_map = self.forward_map(unknowns[self.layout.parameters])

        def charges(contact: Array) -> Array:
            """Compute the charges, shape (n, n_electrode), of contacts (x, y, F), shape (n, 3)."""
            charge = forward_map.charges(contact)
            return charge * self.factor(unknowns, contact, charge)

        return FunctionMap(charges, forward_map.electrodes, self.domain)

    def factor(self, unknowns: Array, contact: Array, charge: Array | None = None) -> Array:
        """Compute the factors by which modes, traces and the discrepancy multiply the charges of a film.

        Modes are imperfections of the film, such as an uneven tension. Traces are metal lines that lead to the
        electrodes and also collect charge. The discrepancy multiplies each charge by a factor whose logarithm is a
        polynomial of the contact. The computation of the effects of modes and traces is slow. Therefore, these effects
        are only computed if at least one coefficient of modes and traces is not zero.

        Args:
            unknowns: Parameters and coefficients of the film, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges without modes, traces and discrepancy, shape (n, n_electrode), pC. If this argument is None,
                the charges are computed.

        Returns:
            Factors, shape (n, n_electrode), dimensionless.
        """
        layout = self.layout
        factor = np.ones((len(contact), len(self.prior.sensor.electrodes)))
        if unknowns[layout.imperfections].any():
            if charge is None:
                charge = self.forward_map(unknowns[layout.parameters]).charges(contact)
            factor = self._imperfection_factor(unknowns, contact, charge)

        # Factor of the discrepancy, whose logarithm is a weighted sum of the terms
        term_coefficients = unknowns[layout.terms]
        if term_coefficients.any():
            coefficients_by_term = term_coefficients.reshape(term_count(), -1)  # shape (n_term, n_electrode)
            log_factor = terms(contact, self.domain) @ coefficients_by_term
            factor = factor * np.exp(log_factor)
        return factor

    def _imperfection_factor(self, unknowns: Array, contact: Array, charge: Array) -> Array:
        """Compute the factors by which modes and traces multiply the charges of a film.

        Modes are imperfections of the film, such as an uneven tension. Traces are metal lines that also collect charge.
        Both add charges. Therefore, the factor is 1 plus the ratio of the added charges to the charges without modes
        and traces. An uneven tension also has a second-order effect, which multiplies the factor. The result is at
        least `MIN_FACTOR`.

        Args:
            unknowns: Parameters and coefficients of the film, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges without modes and traces, shape (n, n_electrode), pC.

        Returns:
            Factors, shape (n, n_electrode), dimensionless.
        """
        layout = self.layout
        parameters = unknowns[layout.parameters]
        mode_coefficients = unknowns[layout.modes]  # empty if no modes were computed for these films
        trace_coefficients = unknowns[layout.traces]
        factor = np.ones_like(charge)

        # First order: the added charges are proportional to the coefficients. A Jacobian contains the charges that are
        # added per unit of each coefficient, shape (n, n_electrode, n_coefficient).
        if trace_coefficients.any():
            forward_map = self.forward_map(parameters)
            trace_jacobian = trace_charges(forward_map, self._trace_lines, contact)
            factor += trace_jacobian @ trace_coefficients / charge
        if mode_coefficients.any():
            mode_charges = self._mode_charges(parameters, contact, charge)
            factor += mode_charges.mode_jacobian @ mode_coefficients / charge

            # Second order: an uneven tension acts like a lower mean tension. The unevenness is the relative decrease of
            # the mean tension, and `unevenness_derivative` is the derivative of ln Q with respect to the unevenness.
            unevenness, _ = self._unevenness(self._pretension(parameters), mode_coefficients)
            factor *= np.exp(unevenness * mode_charges.unevenness_derivative)
        return np.maximum(factor, MIN_FACTOR)

    def _pretension(self, unknowns: Array) -> float:
        """Return the pretension of a film, MPa, from its unknowns or its parameters."""
        return float(unknowns[self.layout.parameter("pretension")])

    def _mode_charges(self, parameters: Array, contact: Array, charge: Array) -> ModeCharges:
        """Return the effects of the modes on the charges of presses, using cached results if possible.

        The computation has two slow parts. The first part, the modes themselves, depends only on the film and the
        probe. The second part, the charges of the modes, also depends on the sensor (its electrodes and gains) and on
        the contacts. The cache contains the latest result for each of a few films and probes. If the sensor and the
        contacts are those of the cached result, this result is returned. Otherwise, only its modes are used again.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts without modes, shape (n, n_electrode), pC.
        """
        forward_map = self.forward_map(parameters)
        sensor = forward_map.sensor
        if self.family.imperfections is None:  # no modes were computed for these films, so there are no effects
            no_jacobian = np.zeros((*charge.shape, 0))
            return ModeCharges(
                None, sensor, contact, mode_jacobian=no_jacobian, unevenness_derivative=np.zeros_like(charge)
            )

        film_and_probe = (sensor.film, forward_map.probe)
        cached_result = self._mode_charge_cache.get(film_and_probe)
        modes = None
        if cached_result is not None:
            if cached_result.sensor == sensor and np.array_equal(cached_result.contact, contact):
                return cached_result
            modes = cached_result.modes
        if modes is None:
            modes = self.family.imperfections.mode_map(forward_map, self.modes)
        mode_charges = self._compute_mode_charges(modes, forward_map, parameters, contact, charge)
        self._cache_mode_charges(film_and_probe, mode_charges)
        return mode_charges

    def _cache_mode_charges(self, film_and_probe: tuple[Film, Probe], mode_charges: ModeCharges) -> None:
        """Store a result of `_mode_charges` in the cache, which contains at most `MAX_CACHED_MODES` results.

        If the cache is full and has no result with the same key, the result with the oldest key is removed first.

        Args:
            film_and_probe: Key of the result.
            mode_charges: The result.
        """
        is_full = len(self._mode_charge_cache) >= MAX_CACHED_MODES
        if is_full and film_and_probe not in self._mode_charge_cache:
            oldest_key = next(iter(self._mode_charge_cache))
            del self._mode_charge_cache[oldest_key]
        self._mode_charge_cache[film_and_probe] = mode_charges

    def _compute_mode_charges(
        self, modes: ModeMap, forward_map: ForwardMap, parameters: Array, contact: Array, charge: Array
    ) -> ModeCharges:
        """Compute the effects of given modes on the charges of presses.

        The effects are the charges that each mode adds, and the change of the charges by a lower mean tension.

        Args:
            modes: The modes of the film. They may have been computed for a sensor with other electrodes and gains.
            forward_map: Forward map of the film, with the sensor for which the charges are computed.
            parameters: Parameters of the film, shape (n_parameter,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts without modes, shape (n, n_electrode), pC.
        """
        # Charges that are added by one standard deviation of each mode, shape (n, n_electrode, n_mode). The modes are
        # evaluated with the electrodes and gains of the sensor of `forward_map`, which replaces their own sensor.
        sensor = forward_map.sensor
        fields = replace(modes.fields, sensor=sensor) if modes.fields is not None else None
        modes_of_sensor = replace(modes, film=forward_map, fields=fields)
        mode_jacobian = modes_of_sensor.mode_jacobian(contact) * self._mode_stds

        # Derivative of ln Q with respect to ln T, where T is the tension. It gives the effect of a lower mean tension,
        # which is the second-order effect of an uneven tension.
        pretension_derivative = self.finite_difference("pretension", parameters, contact, charge)
        log_tension_derivative = self._pretension(parameters) * pretension_derivative / charge
        return ModeCharges(modes, sensor, contact, mode_jacobian, unevenness_derivative(log_tension_derivative))

    @cached_property
    def _mode_charge_cache(self) -> dict[tuple[Film, Probe], ModeCharges]:
        """Cache of `_mode_charges`. The keys are pairs of film and probe, and the oldest key is the first one."""
        return {}

    def _unevenness(self, pretension: float, mode_coefficients: Array) -> tuple[float, Array]:
        """Return the unevenness of the tension of a film, and its derivatives; see `tension_unevenness`.

        Args:
            pretension: Pretension of the film, MPa.
            mode_coefficients: Coefficients of the modes, in standard deviations, shape (n_mode,).
        """
        tension_stds = np.where(self._is_uneven_tension, self._mode_stds, 0.0)
        return tension_unevenness(pretension, tension_stds, mode_coefficients)

    def charges(self, unknowns: Array, contact: Array) -> Array:
        """Compute the charges of presses on one film.

        Args:
            unknowns: Parameters and coefficients of the film, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        return self.film(unknowns).charges(contact)

    def contact_slopes(self, unknowns: Array, contact: Array) -> Array:
        """Compute the derivatives of the charges of one film with respect to the contact (x, y, ln F).

        Args:
            unknowns: Parameters and coefficients of the film, as in `film`.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 3), pC/mm, pC/mm and pC.
        """
        return differences(self.film(unknowns).charges, contact, CONTACT_STEPS)

    def into_domain(self, contact: Array) -> Array:
        """Move each contact outside the domain to the nearest contact in the domain.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N. They may lie outside the domain.

        Returns:
            Contacts (x, y, F) in the domain, shape (n, 3), mm and N.
        """
        position = onto_disk(contact[:, :2], self.domain.radius)
        force = np.clip(contact[:, 2], *self.domain.force_range)
        return np.column_stack([position, force])

    def unknown_slopes(self, unknowns: Array, contact: Array, contact_slopes: Array) -> Array:
        """Compute the derivatives of the charges with respect to the unknowns of the film.

        The unknowns are the parameters of the film, which may be followed by coefficients of modes, traces and the
        discrepancy. Together, the coefficients multiply the charges by a factor. The charges without this factor obey
        scaling laws; see `parameter_jacobian`. The effect of modes on the factor is assumed not to depend on the
        piezoelectric coefficients, the positions of the electrodes, and the radius of the probe.

        Args:
            unknowns: Parameters of the film, shape (n_parameter,), or parameters and coefficients, shape
                (n_parameter + n_coefficient,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            contact_slopes: Derivatives of the charges with respect to the contacts, as the method `contact_slopes`
                returns them.

        Returns:
            Derivatives with respect to the parameters in units of their prior standard deviations, and with respect to
            the coefficients if `unknowns` contains them, shape (n, n_electrode, n_parameter + n_coefficient), pC.
        """
        layout = self.layout
        parameters = unknowns[layout.parameters]
        coefficients = unknowns[layout.coefficients]
        forward_map = self.forward_map(parameters)
        charge = forward_map.charges(contact)  # without the factor

        # Derivatives of the charges without the factor with respect to the parameters. They need the derivative with
        # respect to ln F, also without the factor. If all coefficients are zero, the factor is 1, and `contact_slopes`
        # contains this derivative. Otherwise, it is computed separately.
        force_derivative = contact_slopes[:, :, 2]
        if coefficients.any():
            force_derivative = log_force_derivative(forward_map, contact)
        parameter_jacobian = self.parameter_jacobian(forward_map, parameters, contact, charge, force_derivative)
        film_jacobian = parameter_jacobian * self.prior.std  # per prior standard deviation
        if not coefficients.size:
            return np.asarray(film_jacobian)

        # Product rule: the derivative of factor * charge is factor * (d charge + charge * d ln(factor)).
        factor = self.factor(unknowns, contact, charge)[:, :, None]  # shape (n, n_electrode, 1)
        film_jacobian = self._with_factor_slopes(film_jacobian, unknowns, contact, charge) * factor

        # The effect of an uneven tension depends on the ratio of this tension to Young's modulus E. An increase of ln E
        # therefore acts like the same relative decrease of the coefficients of uneven tensions.
        mode_jacobian = self._mode_jacobian(unknowns, contact, charge, factor)
        tension_coefficients = unknowns[layout.modes] * self._is_uneven_tension
        young = layout.parameter("young")
        film_jacobian[:, :, young] -= mode_jacobian @ tension_coefficients * self.prior.std[young]

        # Derivatives with respect to the coefficients of traces and of the terms of the discrepancy
        trace_jacobian = trace_charges(forward_map, self._trace_lines, contact)
        term_jacobian = self._term_jacobian(contact, factor[:, :, 0] * charge)
        return np.concatenate([film_jacobian, mode_jacobian, trace_jacobian, term_jacobian], axis=2)

    def _with_factor_slopes(self, film_jacobian: Array, unknowns: Array, contact: Array, charge: Array) -> Array:
        """Add the terms that the factor of modes and traces contributes to the derivatives of the charges.

        The added terms are charge * d ln(factor), as in the product rule for factor * charge.

        Args:
            film_jacobian: Derivatives of the charges without coefficients with respect to the parameters in units of
                their prior standard deviations, shape (n, n_electrode, n_parameter), pC.
            unknowns: Parameters and coefficients of the film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts without coefficients, shape (n, n_electrode), pC.

        Returns:
            Derivatives, shape (n, n_electrode, n_parameter), pC.
        """
        layout = self.layout
        jacobian = film_jacobian.copy()
        # The load parameters change the factor of modes and traces. These derivatives are per unit of the parameter.
        for name, log_derivative in self._load_slopes(unknowns, contact).items():
            index = layout.parameter(name)
            jacobian[:, :, index] += charge * log_derivative * self.prior.std[index]

        # The other parameters change only the factor of traces. These derivatives are per prior standard deviation.
        if np.abs(unknowns[layout.traces]).max() > LARGEST_LOCAL_COEFFICIENT:
            for name, log_derivative in self._trace_slopes(unknowns, contact).items():
                jacobian[:, :, layout.parameter(name)] += charge * log_derivative
        return jacobian

    def _mode_jacobian(self, unknowns: Array, contact: Array, charge: Array, factor: Array) -> Array:
        """Compute the derivatives of the charges with respect to the coefficients of the modes.

        A mode adds charge. A mode of uneven tension also lowers the mean tension, and thereby multiplies the charge by
        exp(unevenness * unevenness_derivative). The unevenness is this relative decrease of the mean tension.

        Args:
            unknowns: Parameters and coefficients of the film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts without coefficients, shape (n, n_electrode), pC.
            factor: Factor of the coefficients on these charges, shape (n, n_electrode, 1).

        Returns:
            Derivatives, shape (n, n_electrode, n_mode), pC.
        """
        parameters = unknowns[self.layout.parameters]
        mode_charges = self._mode_charges(parameters, contact, charge)
        # Derivatives of the unevenness with respect to the coefficients, shape (n_mode,)
        _, unevenness_slopes = self._unevenness(self._pretension(parameters), unknowns[self.layout.modes])
        # Derivatives of the charges with respect to the unevenness, by the chain rule, shape (n, n_electrode, 1)
        unevenness_charge_slopes = factor * (charge * mode_charges.unevenness_derivative)[:, :, None]
        return np.asarray(mode_charges.mode_jacobian + unevenness_charge_slopes * unevenness_slopes)

    def _term_jacobian(self, contact: Array, charge: Array) -> Array:
        """Compute the derivatives of the charges with respect to the coefficients of the discrepancy.

        Each coefficient belongs to one term and one electrode. The derivative of the logarithm of the electrode's
        charge with respect to the coefficient is the value of the term.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts, including the factor of the coefficients, shape (n, n_electrode), pC.

        Returns:
            Derivatives, shape (n, n_electrode, n_term * n_electrode), pC. In the last axis, the index of the electrode
            changes fastest.
        """
        # Axes: contact, electrode of the charge, term, electrode of the coefficient. The two electrodes must be equal,
        # so the derivatives are zero except on a diagonal.
        own_charge = charge[:, :, None] * np.eye(charge.shape[1])  # shape (n, n_electrode, n_electrode)
        term_values = terms(contact, self.domain)  # shape (n, n_term)
        jacobian = own_charge[:, :, None, :] * term_values[:, None, :, None]
        return jacobian.reshape(*charge.shape, -1)  # joins the axes of the coefficients

    def _without_terms(self, unknowns: Array) -> Array:
        """Return a copy of a film's unknowns, with zeros for the coefficients of the discrepancy.

        Args:
            unknowns: Parameters and coefficients of the film.
        """
        film_without_terms = unknowns.copy()
        film_without_terms[self.layout.terms] = 0.0
        return film_without_terms

    def _step_parameter(self, unknowns: Array, name: str) -> tuple[Array, float]:
        """Change one parameter by a small step towards the prior mean, so that the parameter stays within its bounds.

        Args:
            unknowns: Parameters and coefficients of a film.
            name: Name of the parameter.

        Returns:
            Copy of the unknowns with the changed parameter, and the signed step, in prior standard deviations.
        """
        index = self.layout.parameter(name)
        step = -STEP if unknowns[index] > self.prior.mean[index] else STEP
        stepped_unknowns = unknowns.copy()
        stepped_unknowns[index] += step * self.prior.std[index]
        return stepped_unknowns, step

    def _load_slopes(self, unknowns: Array, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of ln(factor) with respect to the pretension, ln E and ln h.

        The factor is the one by which modes and traces multiply the charges, E is Young's modulus, and h is the
        thickness. The factor depends on these parameters only through F / (E h a) and T / E, where F is the force, a is
        the radius of the film, and T is the pretension. Therefore, all three derivatives follow from two finite
        differences, with respect to ln F and T.

        Args:
            unknowns: Parameters and coefficients of the film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives with respect to each parameter in its own unit, by the name of the parameter, each of shape (n,
            n_electrode). The dictionary is empty if the coefficients of modes and traces are small, because the
            derivatives are then negligible.
        """
        film = self._without_terms(unknowns)  # the discrepancy does not depend on the parameters
        if np.abs(film[self.layout.imperfections]).max() < LARGEST_LOCAL_COEFFICIENT:
            return {}

        # Finite difference with respect to ln F
        factor = self.factor(film, contact)
        _, _, log_force_step = CONTACT_STEPS
        contact_with_larger_force = contact * [1.0, 1.0, np.exp(log_force_step)]
        force_derivative = (self.factor(film, contact_with_larger_force) - factor) / log_force_step

        # Finite difference with respect to T
        stepped_film, step = self._step_parameter(film, "pretension")
        tension_step = step * self.prior.std[self.layout.parameter("pretension")]  # in MPa
        tension_derivative = (self.factor(stepped_film, contact) - factor) / tension_step

        # By the chain rule, d/d ln h = -d/d ln F and d/d ln E = -d/d ln F - T d/dT.
        derivatives = {
            "pretension": tension_derivative,
            "young": -force_derivative - self._pretension(film) * tension_derivative,
            "thickness": -force_derivative,
        }
        # Derivatives of ln(factor), because d ln(factor) = d factor / factor
        positive_factor = np.maximum(factor, MIN_FACTOR)
        return {name: derivative / positive_factor for name, derivative in derivatives.items()}

    def _trace_slopes(self, unknowns: Array, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of the logarithm of the factor of traces with respect to some of the parameters.

        The parameters are those in `SHARED` but not in `LOAD_PARAMETERS`: the piezoelectric coefficients, the shift and
        the rotation of the electrodes, and the radius of the probe. These parameters change the charge of a trace and
        the charge of its electrode by different ratios, because the trace and the electrode lie at different places.

        Args:
            unknowns: Parameters and coefficients of the film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives with respect to each parameter in units of its prior standard deviation, by the name of the
            parameter, each of shape (n, n_electrode).
        """
        # Only the factor of the traces is assumed to depend on these parameters. Without the coefficients of the
        # discrepancy and of the modes, the factor is that of the traces alone.
        film = self._without_terms(unknowns)
        film[self.layout.modes] = 0.0
        factor = self.factor(film, contact)
        log_derivatives = {}
        for name in SHARED:
            if name in LOAD_PARAMETERS:
                continue
            stepped_film, step = self._step_parameter(film, name)
            derivative = (self.factor(stepped_film, contact) - factor) / step
            log_derivatives[name] = derivative / np.maximum(factor, MIN_FACTOR)  # d ln(factor) = d factor / factor
        return log_derivatives
