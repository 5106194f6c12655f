"""Changes of the charges that a change of the pretension or of the temperature of the film causes.

A change of the pretension by (T11, T22, T12) changes the charges to first order by

    dQ = tension_jacobian @ (T11, T22, T12).

The stress fields are solved with the tangent of the equilibrium (`solver.sensitivity`) at a few distances and forces.
Between these distances and forces they are interpolated, as in a forward map. If the film becomes warmer than its ring,
its pretension changes. The module `mechanics.film_temperature` computes this change.

Example:

    forward_map = ForwardMap.build(sensor, Circle(1.0))
    tension_map = TensionMap.build(forward_map)
    tension_map.temperature_jacobian(contact)  # pC/K, shape (n, n_electrode)
"""

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.derivative_fields import solve_derivatives
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.film_temperature import tension_change
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.solver.sensitivity import TENSION_IS_ODD, tension_stress


@dataclass(frozen=True)
class TensionMap:
    """Derivatives of the charges with respect to the pretension, as a function of position and force.

    Attributes:
        film: Forward map of the film.
        fields: Map whose table contains the stress fields of a change of the mean pretension, of the difference between
            the pretensions along and across the direction of the press, and of its shear.
    """

    film: ForwardMap
    fields: ForwardMap

    @classmethod
    def build(cls, film: ForwardMap, *, executor: Executor | None = None) -> "TensionMap":
        """Solve the fields at some presses in the domain of a forward map, which takes about ten seconds.

        Args:
            film: Forward map of the film, whose probe is a circle. Its mesh and its readout are used.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric.
            SolveError: If a press has no equilibrium.
        """
        if not film.probe.is_axisymmetric:
            raise SceneError(f"temperature of the film: expected a circular probe, got {film.probe.notation}")
        return cls(film, solve_derivatives(film, tension_stress, executor))

    def tension_jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the pretension (T11, T22, T12) along x and y.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 3), pC/MPa.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.film.domain.check(contact, "temperature of the film")
        film = self.film.sensor.film
        field_charge = self.fields.field_charges(contact, TENSION_IS_ODD)
        # The fields are derivatives with respect to the mean, the difference and the shear of the pretension along and
        # across the direction of the press, in this unit.
        tension_unit = film.young * amplitude_squared(film, contact[:, 2]) + film.pretension
        derivatives = np.moveaxis(field_charge / tension_unit[:, None, None], 2, 0)  # shape (3, n, n_electrode)
        mean_derivative, press_difference_derivative, press_shear_derivative = derivatives

        # Rotate the derivatives with respect to the difference and the shear from the axes of the press to x and y.
        twice_angle = 2.0 * np.arctan2(contact[:, 1], contact[:, 0])[:, None]
        cosine = np.cos(twice_angle)
        sine = np.sin(twice_angle)
        difference_derivative = cosine * press_difference_derivative - sine * press_shear_derivative
        t12_derivative = sine * press_difference_derivative + cosine * press_shear_derivative

        # T11 and T22 contribute to the mean and to the difference.
        t11_derivative = 0.5 * (mean_derivative + difference_derivative)
        t22_derivative = 0.5 * (mean_derivative - difference_derivative)
        calibration = self.film.sensor.calibration
        components = (t11_derivative, t22_derivative, t12_derivative)
        return np.stack([calibration.read(derivative) for derivative in components], axis=2)

    def temperature_jacobian(self, contact: Array) -> Array:
        """Compute the change of the touch charges per kelvin of the temperature difference between the film and its
        ring. The difference is positive if the film is warmer.

        The change does not include the pyroelectric charge.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Changes, shape (n, n_electrode), pC/K. Zero if the film has no expansion coefficients.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        return np.asarray(self.tension_jacobian(contact) @ tension_change(self.film.sensor.film, 1.0, 0.0))
