"""Effect of the pretension and of the temperature of the film on the charges.

A change of the pretension by (T11, T22, T12) changes the charges to first order by

    dQ = tension_jacobian @ (T11, T22, T12).

A change of the pretension changes the stress. The change of the stress is computed from the tangent of the equilibrium
(see `solver.sensitivity`), at a few distances and forces. Between the solved presses, it is interpolated as in a
forward map. If the film becomes warmer than its ring, the pretension of the film changes. The module
`mechanics.film_temperature` computes the change of the pretension.

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
    """Map that computes how the charges change with the pretension of the film, at any position and force.

    Attributes:
        film: Forward map of the film.
        fields: Forward map whose table contains three stress fields. They are the changes of the stress by a change of
            the mean pretension, by a difference between the pretensions along and across the direction of the press,
            and by a shear of the pretension.
    """

    film: ForwardMap
    fields: ForwardMap

    @classmethod
    def build(cls, forward_map: ForwardMap, *, executor: Executor | None = None) -> "TensionMap":
        """Solve a few presses in the domain of a forward map, and compute the stress fields of a pretension change.

        The solves take about ten seconds.

        Args:
            forward_map: Forward map of the film under a circular probe. It provides the domain, the mesh and the
                readout.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric.
            SolveError: If a press has no equilibrium.
        """
        if not forward_map.probe.is_axisymmetric:
            raise SceneError(f"temperature of the film: expected a circular probe, got {forward_map.probe.notation}")
        return cls(forward_map, solve_derivatives(forward_map, tension_stress, executor))

    def tension_jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the pretension (T11, T22, T12) in the axes x and y.

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
        # The fields are derivatives with respect to three quantities in the frame of the press: the mean pretension,
        # the difference of the pretensions along and across the direction of the press, and the shear. All three are
        # in units of `tension_unit`.
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
        """Compute the derivatives of the touch charges with respect to the temperature of the film.

        The temperature of the ring remains constant. The pyroelectric charge is not included.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode), pC/K. They are zero if the film has no expansion coefficients.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        tension_per_kelvin = tension_change(self.film.sensor.film, 1.0, 0.0)  # (T11, T22, T12), MPa/K
        return np.asarray(self.tension_jacobian(contact) @ tension_per_kelvin)
