"""Derivatives of the charges with respect to properties of the film and to the radius of the probe.

A change of a property of the film, such as its pretension or an oval clamp, changes the stress. The class `FilmSlopes`
computes these changes from the factorised tangent of the equilibrium (see `solver.sensitivity`), at a few distances and
forces. Between the solved presses, the changes are interpolated as in a forward map. A few solved presses suffice,
because the changes are only used for small corrections.

Each property with two axes, like an ellipse, has two components. Let alpha be the angle from the x axis to axis 1 of
the property. The components are the size of the property times cos(2 alpha) and sin(2 alpha).

Example:

    slopes = FilmSlopes.build(sensor, Circle(1.0), Domain(8.0, (0.05, 1.0)))
    slopes.jacobian(contact)["oval_x"]  # pC, shape (n, n_electrode)
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.family import NodeCount, probe_frame_stress
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.theory import amplitude_squared
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.sensitivity import (
    FILM_FIELDS,
    FILM_IS_ODD,
    SCALAR_FIELDS,
    TENSION_FIELDS,
    stress_changes,
)


def few_nodes(film: Film, domain: Domain) -> NodeCount:
    """Return the numbers of distances and forces that suffice for derivatives and for approximate charges.

    The root-mean-square error of the charges is below 0.05 %. The errors of the derivatives are a few thousandths of
    the largest derivative. More distances are needed only for presses near the clamp, where the distance coordinate is
    large.

    Args:
        film: The film.
        domain: Presses for which the derivatives or the charges are needed.
    """
    largest_coordinate = float(distance_coordinate(domain.radius / film.radius))
    return NodeCount(distances=2 + math.ceil(3.0 * largest_coordinate), forces=8)


@dataclass(frozen=True)
class FilmSlopes:
    """Derivatives of the charges with respect to properties of one film and to the radius of the probe.

    Attributes:
        film: Forward map of the film.
        fields: Forward map whose table contains the stress fields `sensitivity.FILM_FIELDS`.
    """

    film: ForwardMap
    fields: ForwardMap

    @classmethod
    def build(
        cls,
        sensor: Sensor,
        probe: Probe,
        domain: Domain,
        settings: SolveSettings = SolveSettings(),
        *,
        executor: Executor | None = None,
    ) -> "FilmSlopes":
        """Solve a few presses, and compute the stress and its changes from each of them.

        Args:
            sensor: Sensor with the film.
            probe: Axisymmetric probe.
            domain: Presses for which the derivatives are needed.
            settings: Accuracy, theory and mesh. A setting that is "auto" is chosen once for all presses.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric, or some presses of the domain cannot exist.
            SolveError: If a press has no equilibrium.
        """
        if not probe.is_axisymmetric:
            raise SceneError(f"properties of a film: expected a circular probe, got {probe.notation}")
        # The map applies the function `read` to each solved press. Its results are the entries of the table of the map.
        count = few_nodes(sensor.film, domain)  # numbers of distances and forces of the solved presses
        solved_map = ForwardMap.build_unchecked(
            sensor, probe, domain, count, settings, read=_stress_and_changes, executor=executor
        )
        # At each node of the mesh, the first field is the stress, and the other fields are its changes. Divide the
        # table into the tables of two maps.
        n_press = len(solved_map.table)
        n_field = 1 + len(FILM_FIELDS)
        fields = solved_map.table.reshape(n_press, -1, n_field, 3)  # shape (n_press, n_node, n_field, 3)
        stress = fields[:, :, 0].reshape(n_press, -1)
        changes = fields[:, :, 1:].reshape(n_press, -1)

        # Single precision is enough for derivatives, and halves the time in which they are interpolated.
        single_changes: np.ndarray = changes.astype(np.float32)
        return cls(replace(solved_map, table=stress), replace(solved_map, table=single_changes))

    def jacobian(self, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of the charges with respect to the properties of the film.

        `sensitivity.FILM_FIELDS` lists the properties. The unit of a tension is MPa, the unit of the radius of the
        probe is mm, and the other properties are dimensionless. The attribute `film` of the object is the forward map
        of the film. The attribute `fields` is a forward map whose stress fields are the changes of the stress per unit
        of each property.

        Args:
            contact: Presses (x, y, F) in the domain of the forward map `film`, shape (n, 3), mm and N.

        Returns:
            Dictionary from the name of each property to the derivatives of the charges, shape (n, n_electrode), pC per
            unit of the property.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        # Compute the charges that the changes of the stress cause. `FILM_IS_ODD` states which of the fields are odd
        # under a reflection in the line from the centre to the press.
        contact = self.film.domain.check(contact, "properties of a film")
        film = self.film.sensor.film
        charge_without_crosstalk = self.fields.field_charges(contact, FILM_IS_ODD).swapaxes(1, 2)
        field_charge = self.film.sensor.calibration.read(charge_without_crosstalk)  # shape (n, n_field, n_electrode)

        # The fields of a tension are the changes per tension unit, which is E A^2 + T with Young's modulus E, the
        # amplitude A of the press and the pretension T. Convert them into changes per MPa.
        tension_unit = film.young * amplitude_squared(film, contact[:, 2]) + film.pretension  # MPa, shape (n,)
        field_charge[:, TENSION_FIELDS] /= tension_unit[:, None, None]

        # The first `SCALAR_FIELDS` fields have no direction. They are followed by a pair of an even and an odd field
        # for each imperfection with an axis. The axis of the even field points to the press, in the direction t. The
        # axis of the odd field has the direction t + 45 degrees. An imperfection is the complex number
        # size * exp(2 i axis), because half a turn does not change it. The factor exp(2 i t) therefore converts the
        # pair into the derivatives with respect to the real part and the imaginary part of this number.
        directed_charge = field_charge[:, SCALAR_FIELDS:]  # a view, so that changes also change `field_charge`
        even_charge = directed_charge[:, ::2]
        odd_charge = directed_charge[:, 1::2]
        direction = np.arctan2(contact[:, 1], contact[:, 0])[:, None, None]  # t
        components = (even_charge + 1j * odd_charge) * np.exp(2j * direction)
        directed_charge[:, ::2] = components.real
        directed_charge[:, 1::2] = components.imag
        return {field.name: field_charge[:, index] for index, field in enumerate(FILM_FIELDS)}


def _stress_and_changes(solved: Equilibrium, surface: Surface) -> Array:
    """Compute the scaled stress under a press, and its change per unit of each property in `FILM_FIELDS`.

    Args:
        solved: Equilibrium of the film under the press.
        surface: Surface at which the stress is read: the middle, the top or the bottom of the film.

    Returns:
        Values at the nodes of the mesh, shape (n_element, n_local, 1 + n_field, 3): the stress (s11, s22, s12) in the
        frame of the probe, followed by its change for each of the `FILM_FIELDS`.
    """
    stress = probe_frame_stress(solved, surface)
    return np.concatenate([stress[:, :, None], stress_changes(solved, surface)], axis=2)
