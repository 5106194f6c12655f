"""Charges of a solved film and of similar films, with their derivatives with respect to the properties of the film.

The charges of the solved film are exact, for any film and any probe. The positions and gains of the electrodes and the
piezoelectric coefficients only change how the solved stress is read, so their effect is exact as well. The other
properties change the stress, and their effects are first-order changes. They are computed for an axisymmetric film with
the mean properties under a circular probe, because this takes only seconds. If the properties differ much from those of
the solved film, the film is solved again (`calibrate`).
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import Circle, Domain, FilmPrior, FilmSlopes, ForwardMap, Probe, Sensor
from isocharge.simulate.forward.derivative_maps import NODE_COUNT
from isocharge.simulate.sensor.film_properties import PRETENSION, FilmProperty, changed_film

STEP = 1.0 / 3.0
"""Step of the difference quotients, in prior standard deviations of the property."""

PROBE_RADIUS = "probe_radius"
"""Name of the only property that changes the stress and whose derivative does not follow from that of the stress."""

UNEVEN_TENSIONS = ("tension_difference", "tension_shear")
"""Properties that are uneven parts of the pretension, relative to the pretension."""

MAX_LOG_CHANGE = 1.0
"""Largest change of the logarithm of a charge to which a first-order change is applied."""


def axisymmetric(sensor: Sensor) -> Sensor:
    """Return the sensor with an axisymmetric film that has the mean properties of its film."""
    film = replace(sensor.film, deviator=(0.0, 0.0), young_ratio=1.0, shear=None, oval=0.0)
    return replace(sensor, film=film)


def circle_of(probe: Probe) -> Circle:
    """Return the circular probe with the same area as a probe."""
    return probe if isinstance(probe, Circle) else Circle(float(np.sqrt(probe.area / np.pi)))


@dataclass(frozen=True)
class FilmCharges:
    """Charges of a solved film and, to first order, of similar films.

    Attributes:
        prior: Declarations of the properties.
        values: Properties of the solved film, shape (n_property,).
        even_values: Properties of the axisymmetric film, shape (n_property,).
        film: Forward map of the solved film.
        slopes: Derivatives with respect to the mechanical properties, for the axisymmetric film.
        same_probe: Forward map of the axisymmetric film under a circular probe, with the few nodes of the slopes.
        larger_probe: The same map under a probe whose radius is larger by `STEP`; None if the probe is not round.
    """

    prior: FilmPrior
    values: Array
    even_values: Array
    film: ForwardMap
    slopes: FilmSlopes
    same_probe: ForwardMap
    larger_probe: ForwardMap | None

    @classmethod
    def solve_roughly(
        cls,
        prior: FilmPrior,
        values: Array,
        domain: Domain,
        executor: Executor | None,
    ) -> "FilmCharges":
        """Solve the axisymmetric film with the mean properties, under a circular probe, at a few presses.

        Args:
            prior: Declarations of the properties, with the described sensor and probe.
            values: Properties of the film, shape (n_property,). Imperfections are ignored.
            domain: Contacts for which the charges are needed.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If some presses of the domain cannot exist.
            SolveError: If a press has no equilibrium.
        """
        even_values = np.where(prior.is_imperfection, 0.0, values)

        def solve(film_values: Array) -> ForwardMap:
            """Solve the axisymmetric film with the given properties under the circular probe."""
            sensor, probe = prior.film(film_values)
            return ForwardMap.build_unchecked(
                axisymmetric(sensor), circle_of(probe), domain, NODE_COUNT, executor=executor
            )

        same_probe = solve(even_values)
        larger_probe = None
        if PROBE_RADIUS in prior.names:
            is_radius = np.arange(len(values)) == prior.index(PROBE_RADIUS)
            larger_probe = solve(even_values + STEP * prior.std * is_radius)
        return cls(
            prior=prior,
            values=even_values,
            even_values=even_values,
            film=same_probe,
            slopes=FilmSlopes.build(same_probe, executor=executor),
            same_probe=same_probe,
            larger_probe=larger_probe,
        )

    def solved(self, values: Array, executor: Executor | None) -> "FilmCharges":
        """Return the charges of a similar film that is solved under the probe itself, also if it is not circular.

        The interpolation of the new forward map is checked. The derivatives with respect to the properties are not
        computed again; they stay those of this film.

        Args:
            values: Properties of the film, shape (n_property,).
            executor: Executor that runs the solves; None for this process.
        """
        sensor, probe = self.prior.film(values)
        film = ForwardMap.build(sensor, probe, self.domain.radius, self.domain.force_range, executor=executor)
        return replace(self, values=values, film=film)

    @property
    def domain(self) -> Domain:
        """Contacts for which the charges are known."""
        return self.film.domain

    def into_domain(self, contact: Array) -> Array:
        """Move each contact (x, y, F), shape (n, 3), that lies outside the domain to the nearest contact in it."""
        position = contact[:, :2]
        distance = np.hypot(position[:, 0], position[:, 1])[:, None]
        shrink = self.domain.radius / np.maximum(distance, self.domain.radius)
        return np.column_stack([shrink * position, np.clip(contact[:, 2], *self.domain.force_range)])

    def charges(self, values: Array, contact: Array) -> Array:
        """Compute the charges of presses on a film with given properties, shape (n, n_electrode), pC."""
        charge, _ = self.linearised(values, contact)
        return charge

    def linearised(self, values: Array, contact: Array) -> tuple[Array, Array]:
        """Compute the charges of presses on a film, and their derivatives with respect to the properties.

        Args:
            values: Properties of the film, shape (n_property,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC, and their derivatives, shape (n, n_electrode, n_property), pC per unit
            of the property.
        """
        reading = _Reading(self, values)
        solved_charge = reading.film.charges(contact)
        jacobian = reading.jacobian(contact, solved_charge)

        # First-order change by the mechanical properties. It is applied to the logarithm of a charge, unless the charge
        # is negative or changes its sign.
        change = values - self.values
        change[reading.exact] = 0.0
        charge_change = jacobian @ change
        log_change = np.divide(charge_change, solved_charge, out=np.zeros_like(solved_charge), where=solved_charge > 0)
        is_logarithmic = (solved_charge > 0.0) & (np.abs(log_change) < MAX_LOG_CHANGE)
        factor = np.where(is_logarithmic, np.exp(np.where(is_logarithmic, log_change, 0.0)), 1.0)
        charge = np.where(is_logarithmic, solved_charge * factor, solved_charge + charge_change)
        return charge, factor[:, :, None] * jacobian

    def contact_slopes(self, values: Array, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to (x, y, ln F), shape (n, n_electrode, 3).

        Args:
            values: Properties of the film, shape (n_property,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
        """
        return _Reading(self, values).film.derivatives(contact)


class _Reading:
    """A solved film that is read by electrodes with other properties.

    Attributes:
        film: Forward map of the solved film, with the piezoelectric coefficients, gains and positions of the electrodes
            of other properties.
        exact: Indices of the properties whose effect is exact, because they do not change the stress.
    """

    def __init__(self, charges: FilmCharges, values: Array) -> None:
        """Place the electrodes.

        Args:
            charges: The solved film.
            values: Properties, shape (n_property,). Of these, only those of the electrodes and of the coefficients are
                used.
        """
        self._charges = charges
        self._prior = charges.prior
        is_exact = ~charges.prior.changes_stress
        self.exact = np.flatnonzero(is_exact)
        self._sensor, _ = charges.prior.film(np.where(is_exact, values, charges.values))
        self.film = self._read(charges.film)

    def _read(self, forward_map: ForwardMap) -> ForwardMap:
        """Return a forward map with the electrodes and coefficients of this reading."""
        return replace(forward_map, sensor=replace(self._sensor, film=forward_map.sensor.film))

    def jacobian(self, contact: Array, charge: Array) -> Array:
        """Compute the derivatives of the charges with respect to all properties.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of the solved film at these contacts, shape (n, n_electrode), pC.

        Returns:
            Derivatives, shape (n, n_electrode, n_property), pC per unit.
        """
        derivatives = self._mechanical(contact, charge)
        derivatives["crosstalk"] = charge.sum(axis=1, keepdims=True) - charge
        for electrode, name in enumerate(self._sensor.electrode_names):
            own_charge = np.zeros_like(charge)
            own_charge[:, electrode] = charge[:, electrode]
            derivatives[f"gain {name}"] = own_charge
        columns = [
            derivatives[one.name] if one.name in derivatives else self._read_difference(one, contact)
            for one in self._prior.properties
        ]
        even_jacobian = np.stack(columns, axis=2)
        return even_jacobian + self._secant_correction(contact, charge, even_jacobian)

    def _secant_correction(self, contact: Array, charge: Array, jacobian: Array) -> Array:
        """Compute the change of the derivatives from the axisymmetric film to the solved film, along their difference.

        The charges are assumed to be quadratic along the line between both films. The derivative at the solved film
        then differs from that at the axisymmetric film by twice the deviation of the charges from the first order, and
        only along this line (Broyden 1965).

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of the solved film at these contacts, shape (n, n_electrode), pC.
            jacobian: Derivatives of the axisymmetric film, shape (n, n_electrode, n_property), pC per unit.

        Returns:
            Change of the derivatives, shape (n, n_electrode, n_property), pC per unit.
        """
        charges = self._charges
        step = np.where(self._prior.changes_stress, charges.values - charges.even_values, 0.0)
        scaled_step = step / self._prior.std**2
        length = float(step @ scaled_step)  # squared, in prior standard deviations
        if length == 0.0 or charges.film.probe.is_axisymmetric != self._prior.probe.is_axisymmetric:
            return np.zeros_like(jacobian)
        even_charge = self._read(charges.same_probe).charges(contact)
        deviation = charge - even_charge - jacobian @ step
        return np.asarray(2.0 * deviation[:, :, None] * scaled_step / length)

    def _mechanical(self, contact: Array, charge: Array) -> dict[str, Array]:
        """Compute the derivatives with respect to the properties that change the stress.

        The stress in units of Young's modulus E depends on E, the thickness h and the force F only through F / (E h)
        and the tensions divided by E. The small effect of the bending is neglected here.
        """
        slopes = self._charges.slopes
        derivatives = replace(slopes, film=self._read(slopes.film), fields=self._read(slopes.fields)).jacobian(contact)
        force_slope = self.film.derivatives(contact)[:, :, 2]
        derivatives["thickness"] = -force_slope
        values = dict(zip(self._prior.names, self._charges.values.tolist(), strict=True))
        for name in UNEVEN_TENSIONS:  # shares of the pretension
            derivatives[PRETENSION.name] = derivatives[PRETENSION.name] + values[name] * derivatives[name]
            derivatives[name] = values[PRETENSION.name] * derivatives[name]
        derivatives["young"] = charge - force_slope - values[PRETENSION.name] * derivatives[PRETENSION.name]
        same_charge = self._read(self._charges.same_probe).charges(contact)
        larger_probe = self._charges.larger_probe
        if larger_probe is not None:
            step = STEP * self._prior.std[self._prior.index(PROBE_RADIUS)]
            derivatives[PROBE_RADIUS] = (self._read(larger_probe).charges(contact) - same_charge) / step
        return derivatives

    def _read_difference(self, one: FilmProperty, contact: Array) -> Array:
        """Compute the derivative with respect to a property that does not change the stress, by central differences."""
        step = STEP * one.std
        sensors = [changed_film(self.film.sensor, self.film.probe, {one.name: change})[0] for change in (step, -step)]
        forward, backward = (replace(self.film, sensor=sensor).charges(contact) for sensor in sensors)
        return np.asarray((forward - backward) / (2.0 * step))
