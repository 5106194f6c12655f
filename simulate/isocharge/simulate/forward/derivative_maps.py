"""Derivatives of the charges with respect to properties of the film.

A change of a property of the film, such as its pretension or an oval clamp, changes the stress. The class `FilmSlopes`
computes these changes from the factorised tangent of the equilibrium (see `solver.sensitivity`), at a few distances and
forces. Between the solved presses, the changes are interpolated as in a forward map. The changes need fewer solved
presses than the stress itself, because they are used for small corrections.

Each property with two axes, like an ellipse, has two components. Let alpha be the angle from the x axis to axis 1 of
the property. The components are the size of the property times cos(2 alpha) and sin(2 alpha).

Example:

    forward_map = ForwardMap.build(sensor, Circle(1.0))
    slopes = FilmSlopes.build(forward_map)
    slopes.jacobian(contact)["oval_x"]  # pC, shape (n, n_electrode)
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.theory import amplitude_squared
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.solver.sensitivity import FILM_FIELDS, FILM_IS_ODD, TENSION_FIELDS, stress_changes


def few_nodes(film: Film, domain: Domain) -> NodeCount:
    """Return the numbers of distances and forces that suffice for derivatives and for approximate charges.

    The errors are a few thousandths of the largest value. They depend mainly on the number of forces. Only for presses
    near the clamp, where the distance coordinate is large, more distances are needed.

    Args:
        film: The film.
        domain: Presses for which the derivatives or the charges are needed.
    """
    largest_coordinate = float(distance_coordinate(domain.radius / film.radius))
    return NodeCount(distances=3 + math.ceil(2.0 * largest_coordinate), forces=8)


@dataclass(frozen=True)
class FilmSlopes:
    """Derivatives of the charges with respect to properties of one film, at any position and force.

    Attributes:
        film: Forward map of the film.
        fields: Forward map whose table contains the stress fields `sensitivity.FILM_FIELDS`.
    """

    film: ForwardMap
    fields: ForwardMap

    @classmethod
    def build(cls, forward_map: ForwardMap, *, executor: Executor | None = None) -> "FilmSlopes":
        """Solve a few presses in the domain of a forward map, and compute the stress fields of its properties.

        Args:
            forward_map: Forward map of the film under a circular probe. It provides the domain, the mesh and the
                readout.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric.
            SolveError: If a press has no equilibrium.
        """
        if not forward_map.probe.is_axisymmetric:
            raise SceneError(f"properties of a film: expected a circular probe, got {forward_map.probe.notation}")
        fields = ForwardMap.build_unchecked(
            forward_map.sensor,
            forward_map.probe,
            forward_map.domain,
            few_nodes(forward_map.sensor.film, forward_map.domain),
            replace(forward_map.settings, layer=forward_map.layer),
            read=stress_changes,
            executor=executor,
        )
        return cls(forward_map, fields)

    def jacobian(self, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of the charges with respect to the properties of the film.

        The names of the properties are those of `sensitivity.FILM_FIELDS`. The unit of a tension is MPa, and the other
        properties are dimensionless.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives by the name of the property, each of shape (n, n_electrode), pC per unit of the property.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.film.domain.check(contact, "properties of a film")
        film = self.film.sensor.film
        field_charge = self.film.sensor.calibration.read(
            self.fields.field_charges(contact, FILM_IS_ODD).swapaxes(1, 2)  # shape (n, n_field, n_electrode)
        )
        tension_unit = film.young * amplitude_squared(film, contact[:, 2]) + film.pretension
        field_charge[:, :TENSION_FIELDS] /= tension_unit[:, None, None]

        # The axes of an even field are along and across the direction of the press, at the angle t from the x axis.
        # The axes of an odd field are rotated by 45 degrees from them. Rotate both to the axes x and y.
        even, odd = field_charge[:, 1::2], field_charge[:, 2::2]
        twice_angle = 2.0 * np.arctan2(contact[:, 1], contact[:, 0])[:, None, None]
        cosine = np.cos(twice_angle)
        sine = np.sin(twice_angle)
        components = np.stack([cosine * even - sine * odd, sine * even + cosine * odd], axis=2)
        field_charge[:, 1:] = components.reshape(field_charge[:, 1:].shape)
        names = [field.name for field in FILM_FIELDS]
        return dict(zip(names, np.moveaxis(field_charge, 1, 0), strict=True))
