"""Charges of a solved film and of similar films, with their derivatives with respect to the properties of the film.

The charges of the solved film are exact, for any film and any probe. The positions and gains of the electrodes and the
piezoelectric coefficients only change how the charges follow from the solved stress, so the effects of these properties
are exact as well. The other properties change the stress, and their effects are first-order changes. The derivatives
for the first-order changes are computed for an axisymmetric film with the mean properties under an axisymmetric probe,
because this computation takes only seconds. If the properties differ much from those of the solved film, the film is
solved again (`calibrate`).
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.robust_estimate import ModelValues
from isocharge.simulate import Circle, Domain, FilmPrior, FilmSlopes, ForwardMap, Probe, Sensor, SolveSettings
from isocharge.simulate.forward.family import nearest_to_clamp
from isocharge.simulate.sensor.film_properties import PRETENSION, UNEVEN_TENSIONS, FilmProperty, changed_film
from isocharge.simulate.solver.press import needed_resolution

DIFFERENCE_STEP = 1.0 / 3.0
"""Step of the difference quotients, in prior standard deviations of the property."""

MAX_LOG_CHANGE = 1.0
"""Largest first-order change of a charge, relative to the charge, that is applied to the logarithm of the charge."""


@dataclass(frozen=True)
class FilmCharges:
    """Charges of a solved film and, to first order, of similar films.

    Attributes:
        prior: Declarations of the properties.
        values: Properties of the solved film, shape (n_property,).
        film: Forward map of the solved film.
        slopes: Charges of an axisymmetric film, and their derivatives with respect to the mechanical properties.
        even_values: Properties of the axisymmetric film, shape (n_property,).
    """

    prior: FilmPrior
    values: Array
    film: ForwardMap
    slopes: FilmSlopes
    even_values: Array

    @classmethod
    def of_even_film(cls, prior: FilmPrior, values: Array, domain: Domain, executor: Executor | None) -> "FilmCharges":
        """Solve a film without its imperfections, and return its charges and their derivatives.

        A film without imperfections is called even. The film is axisymmetric, and so is the probe: a probe that is not
        axisymmetric is replaced by a circle. Only a few presses therefore need to be solved. The method `solved` later
        replaces the charges by those of the film with its imperfections, but keeps these derivatives.

        Args:
            prior: Declarations of the properties, with the described sensor and probe.
            values: Properties of the film, shape (n_property,). Imperfections are ignored.
            domain: Contacts for which the charges are needed.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If some presses of the domain cannot exist.
            SolveError: If a press has no equilibrium.
        """
        even_values = prior.without_imperfections(values)
        sensor, probe = prior.film(even_values)  # the sensor and the probe with these properties
        # The values may not cancel the described imperfections exactly. They do not change a shear modulus that the
        # sensor file states. Remove both, so that the film is exactly axisymmetric.
        axisymmetric_film = replace(sensor.film, deviator=(0.0, 0.0), young_ratio=1.0, shear=None, oval=0.0)
        slopes = FilmSlopes.build(
            replace(sensor, film=axisymmetric_film), round_probe(probe), domain, executor=executor
        )
        # `slopes.film` is the forward map of the solved film, from contacts to charges.
        return cls(prior=prior, values=even_values, film=slopes.film, slopes=slopes, even_values=even_values)

    @property
    def even(self) -> "FilmCharges":
        """Charges of the axisymmetric film whose derivatives are used."""
        return replace(self, values=self.even_values, film=self.slopes.film)

    def solved(self, values: Array, executor: Executor | None) -> "FilmCharges":
        """Return the charges of a similar film, which is solved with its imperfections and under its real probe.

        The present charges may belong to a circular probe in place of the real probe. The forward map from contacts to
        charges is built again, and its interpolation is checked. The derivatives with respect to the properties are not
        computed again. They remain the present derivatives.

        Args:
            values: Properties of the film, shape (n_property,).
            executor: Executor that runs the solves; None for this process.
        """
        sensor, probe = self.prior.film(values)
        radius, force_range = self.domain.radius, self.domain.force_range
        # The mesh is chosen for a middle force. With this mesh, the charges of an uneven film under the smallest force
        # have errors of up to 0.4 %, which is less than the noise of such small charges. With a mesh for the smallest
        # force, the solves would take four times as long.
        middle_force = float(np.sqrt(np.prod(force_range)))
        resolution = needed_resolution(sensor.film, probe, nearest_to_clamp(sensor.film, radius), middle_force)
        settings = SolveSettings(resolution=resolution)
        forward_map = ForwardMap.build(sensor, probe, radius, force_range, settings, executor=executor)
        return replace(self, values=values, film=forward_map)

    @property
    def domain(self) -> Domain:
        """Contacts for which the charges are known."""
        return self.film.domain

    def charges(self, values: Array, contact: Array) -> Array:
        """Compute the charges of presses on a film with given properties.

        Args:
            values: Properties of the film, shape (n_property,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        solved_charge, _, derivatives = self._solved_charges(self._sensor_with_readout(values), contact)
        charge, _ = _with_stress_changes(solved_charge, self._property_changes(values), derivatives)
        return charge

    def linearised(self, values: Array, contact: Array) -> ModelValues:
        """Compute the charges of presses on a film, and their derivatives.

        Args:
            values: Properties of the film, shape (n_property,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, pC, and their derivatives with respect to the contact (x, y, ln F) and to the properties. The
            properties take the place of the state in `ModelValues`. The derivatives with respect to the contact are
            those of the solved film.
        """
        sensor = self._sensor_with_readout(values)
        # `derivatives` contains an array of shape (n, n_electrode) for each property, by the name of the property: at
        # first for the properties that change the stress.
        solved_charge, contact_slopes, derivatives = self._solved_charges(sensor, contact)
        charge, derivative_factor = _with_stress_changes(solved_charge, self._property_changes(values), derivatives)

        # The derivatives D so far are taken with respect to the uneven parts of the pretension in MPa. The values
        # contain each part as a share s of the pretension T, so the part is s T. By the chain rule, the derivative with
        # respect to s is T D, and s D is added to the derivative with respect to T.
        for name in UNEVEN_TENSIONS:
            share = values[self.prior.index(name)]
            derivatives[PRETENSION.name] = derivatives[PRETENSION.name] + share * derivatives[name]
            derivatives[name] = values[self.prior.index(PRETENSION.name)] * derivatives[name]

        # Crosstalk adds a share of the charges of all other electrodes. The values of the gains are logarithms, so the
        # derivative with respect to a gain is the charge of its own electrode, and 0 for the other electrodes.
        derivatives["crosstalk"] = solved_charge.sum(axis=1, keepdims=True) - solved_charge
        for name, is_own in zip(sensor.electrode_names, np.eye(len(sensor.electrodes)), strict=True):
            derivatives[f"gain {name}"] = is_own * solved_charge
        # The derivatives with respect to the other properties of the readout are difference quotients.
        for film_property in self.prior.properties:
            if film_property.name not in derivatives:
                derivatives[film_property.name] = self._readout_derivative(sensor, film_property, contact)

        # So far, the derivatives belong to the charges of the solved film. The factor, shape (n, n_electrode), adapts
        # them to the changed charges.
        columns = np.stack([derivatives[name] for name in self.prior.names], axis=2)  # (n, n_electrode, n_property)
        return ModelValues(charge, contact_slopes, derivative_factor[:, :, None] * columns)

    def _sensor_with_readout(self, values: Array) -> Sensor:
        """Return the solved sensor with the electrodes and the piezoelectric coefficients of given properties.

        Args:
            values: Properties, shape (n_property,). The properties that change the stress are not used.
        """
        sensor, _ = self.prior.film(np.where(self.prior.changes_stress, self.values, values))
        return sensor

    def _values_by_name(self, values: Array) -> dict[str, float]:
        """Return the properties by name, with the uneven parts of the pretension in MPa instead of as shares.

        Args:
            values: Properties of a film, shape (n_property,).
        """
        value_of = dict(zip(self.prior.names, values.tolist(), strict=True))
        for name, described_MPa in zip(UNEVEN_TENSIONS, self.prior.sensor.film.deviator, strict=True):
            value_of[name] = described_MPa + value_of[name] * value_of[PRETENSION.name]
        return value_of

    def _property_changes(self, values: Array) -> dict[str, float]:
        """Return the differences between given properties and those of the solved film; see `_values_by_name`."""
        solved, changed = self._values_by_name(self.values), self._values_by_name(values)
        return {name: changed[name] - solved[name] for name in changed}

    def _solved_charges(self, sensor: Sensor, contact: Array) -> tuple[Array, Array, dict[str, Array]]:
        """Compute charges of the solved film, and their derivatives with respect to properties that change the stress.

        The derivatives with respect to Young's modulus and to the thickness follow from the other derivatives, if the
        bending is neglected. The derivatives with respect to the other properties are those of the axisymmetric film of
        `self.slopes`. The derivative with respect to the radius of the probe lacks the small effect on the charges of
        the contact pressure (d33).

        Args:
            sensor: Sensor with the electrodes and the piezoelectric coefficients that are used.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC; their derivatives with respect to the contact (x, y, ln F), shape (n,
            n_electrode, 3); and their derivatives with respect to properties, by the name of the property, each of
            shape (n, n_electrode), pC per unit. The unit of the uneven parts of the pretension is MPa.
        """
        solved_charge, contact_slopes = _with_readout(self.film, sensor).linearised(contact)
        force_slope = contact_slopes[:, :, 2]  # with respect to ln F

        # The two maps of `self.slopes` contain the solved stress of the axisymmetric film, and its changes with the
        # properties. Use them with the electrodes and the coefficients of the given sensor.
        slopes_of_sensor = replace(
            self.slopes, film=_with_readout(self.slopes.film, sensor), fields=_with_readout(self.slopes.fields, sensor)
        )
        slopes = slopes_of_sensor.jacobian(contact)
        # The radius of the probe is only a property if the probe is a circle.
        derivatives = {name: slope for name, slope in slopes.items() if name in self.prior.names}

        # The values of "young" and "thickness" are ln E and ln h, with Young's modulus E and the thickness h. A charge
        # is Q = E q, where q depends only on F / (E h), with the force F, and on each tension T divided by E. An
        # increase of ln h has the same effect on q as a decrease of ln F, so that dQ/d(ln h) = -dQ/d(ln F). An increase
        # of ln E changes q like a decrease of ln F and a decrease of all tensions T by the same ratio. It also
        # increases the factor E. So dQ/d(ln E) = Q - dQ/d(ln F) - sum of T dQ/dT over the three tensions in MPa.
        derivatives["thickness"] = -force_slope
        value_of = self._values_by_name(self.values)
        tension_terms = (value_of[name] * derivatives[name] for name in (PRETENSION.name, *UNEVEN_TENSIONS))
        derivatives["young"] = solved_charge - force_slope - sum(tension_terms)
        return solved_charge, contact_slopes, derivatives

    def _readout_derivative(self, sensor: Sensor, film_property: FilmProperty, contact: Array) -> Array:
        """Compute the derivatives of charges with respect to a property that does not change the stress.

        Args:
            sensor: Sensor with the electrodes and the coefficients.
            film_property: The property.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Central difference quotients, shape (n, n_electrode), pC per unit.
        """
        step = DIFFERENCE_STEP * film_property.std
        sensors = [changed_film(sensor, self.film.probe, {film_property.name: change})[0] for change in (step, -step)]
        forward, backward = (_with_readout(self.film, changed).charges(contact) for changed in sensors)
        return (forward - backward) / (2.0 * step)


def _with_stress_changes(
    solved_charge: Array, changes: dict[str, float], derivatives: dict[str, Array]
) -> tuple[Array, Array]:
    """Apply first-order changes of the properties to the charges of a solved film, and return the changed charges.

    Only properties that change the stress count. The effects of these properties on a charge are added up. Divided by
    the charge, the sum is the change of the logarithm of the charge, so the charge is multiplied by the exponential of
    this ratio. If the sum is not smaller than `MAX_LOG_CHANGE` times the charge, the exponential would be inaccurate,
    and the sum is added to the charge itself.

    Args:
        solved_charge: Charges of the solved film, shape (n, n_electrode), pC.
        changes: Differences between the properties and those of the solved film, by the names of the properties.
        derivatives: Derivatives of the charges of the solved film with respect to the properties that change the
            stress, by their names, each of shape (n, n_electrode), pC per unit.

    Returns:
        Charges, shape (n, n_electrode), pC, and factors of the same shape. A derivative of a solved charge, multiplied
        by its factor, is the derivative of the changed charge.
    """
    addition = np.zeros_like(solved_charge)
    for name, derivative in derivatives.items():
        addition += changes[name] * derivative
    # The array in `out` contains the results where the condition `where` is False: the relative addition to a charge of
    # zero is infinite, and the factor is 1 where the sum is added to the charge.
    relative = np.divide(addition, solved_charge, out=np.full_like(addition, np.inf), where=solved_charge != 0.0)
    is_small = np.abs(relative) < MAX_LOG_CHANGE
    factor = np.exp(relative, out=np.ones_like(relative), where=is_small)
    charge = np.where(is_small, solved_charge * factor, solved_charge + addition)
    return charge, factor


def round_probe(probe: Probe) -> Probe:
    """Return the probe itself if it is axisymmetric, or else the circular probe with the same area."""
    return probe if probe.is_axisymmetric else Circle(float(np.sqrt(probe.area / np.pi)))


def _with_readout(forward_map: ForwardMap, sensor: Sensor) -> ForwardMap:
    """Return the forward map of a solved film with the electrodes and the piezoelectric coefficients of a sensor."""
    return replace(forward_map, sensor=replace(sensor, film=forward_map.sensor.film))
