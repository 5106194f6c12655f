"""Forward map, which computes the charges of many presses from a few solved presses.

All presses with one probe form a family with two coordinates: the distance from the centre of the film, and the force.
If the probe is not axisymmetric, its orientation is a further coordinate. If the film is not axisymmetric, the
direction from the centre is a further coordinate. On an axisymmetric film, presses in other directions are obtained by
a rotation. In a frame that moves with the probe, the stress at the nodes of the mesh is a smooth function of the
coordinates of the family. Presses are solved at Chebyshev nodes in the distance and in the logarithm of the force, and
at evenly spaced orientations and directions. For every other press, the stress field is interpolated. The charges are
integrals of the interpolated field over the electrodes. The positions of the electrodes therefore do not affect the
accuracy of the interpolation. When a map is built, its charges are compared with the charges of direct solves.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.common.contact_domain import Domain, as_contacts
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate.execution import in_order
from isocharge.simulate.forward.charge_map import STEPS, differences
from isocharge.simulate.forward.family import (
    Family,
    NodeCount,
    Orientation,
    Reading,
    check_family,
    direct_charges,
    family_mesh,
    node_counts,
    probe_frame_stress,
    relative_error,
    spread_check_presses,
)
from isocharge.simulate.forward.readout import ChargeDensity, ElectrodePieces, contact_charges, piece_charge_per_stress
from isocharge.simulate.mechanics.theory import Theory, amplitude_squared, rotate_stress
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.oval import film_oval
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.numerics.disk import contacts_at
from isocharge.simulate.numerics.interpolation import lagrange_values
from isocharge.simulate.numerics.polygon import to_complex
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.assembly import single_threaded_blas
from isocharge.simulate.solver.load_case import SolveSettings

CHUNK_SIZE = 256
"""Largest product of the number of presses and the number of stress fields that are evaluated at once.

The number limits the size of the working arrays to about 100 MB.
"""

INTERPOLATION_ERROR = 5e-4
"""Largest allowed relative error of a charge of a forward map, compared with direct solves, dimensionless."""

EVEN_FIELD = np.zeros(1, dtype=bool)
"""Value of the argument `is_odd` for a single even field.

On an axisymmetric film, the stress under a press is a single even field. On other films, the argument has no effect,
because the whole film is meshed.
"""

SKIP_RATIO = 10.0
"""Ratio of the error to `INTERPOLATION_ERROR` above which the next entry of `node_counts` is skipped, dimensionless.

With such a large error, the next entry would not suffice either.
"""

CHECK_COUNT = 10
"""Number of presses at which a forward map is compared with direct solves."""


@dataclass(frozen=True)
class ForwardMap:
    """Map that computes the touch charges of a sensor from the position, the force and the orientation of a probe.

    Attributes:
        sensor: Sensor whose charges are computed.
        probe: Probe that presses the film.
        family: Distances, forces, directions and rotations of the solved presses.
        theory: Terms of the film theory that the solves include.
        resolution: Fineness of the mesh of the solves.
        layer: Width of the thin rings of the mesh at the rim, in film radii.
        table: Scaled stress at the nodes of every element under the solved presses, in a frame that rotates with the
            probe, shape (n_distance * n_force * n_turn, n_element * n_local * 3), dimensionless.
        error: Largest relative error of a charge with respect to the direct solves of `build`, dimensionless.
    """

    sensor: Sensor
    probe: Probe
    family: Family
    theory: Theory
    resolution: Resolution
    layer: float
    table: Array
    error: float

    @classmethod
    def build(
        cls,
        sensor: Sensor,
        probe: Probe,
        radius: float = DEFAULT_RADIUS,
        force_range: tuple[float, float] = DEFAULT_FORCE_RANGE,
        settings: SolveSettings = SolveSettings(),
        *,
        orientation: Orientation = "fixed",
        executor: Executor | None = None,
    ) -> "ForwardMap":
        """Build a forward map: solve a family of presses, and compare the interpolated charges with direct solves.

        Args:
            sensor: Sensor whose charges the map computes.
            probe: Probe that presses the film.
            radius: Largest distance of a press from the centre, mm.
            force_range: Smallest and largest force, N.
            settings: Accuracy, theory and mesh. A setting that is "auto" is chosen once for all presses. The mesh is as
                fine as the outermost press requires. The width of the thin rings is chosen for the geometric mean of
                the smallest and the largest force.
            orientation: Whether the probe keeps its own orientation ("fixed") or may be rotated ("random"). The choice
                only matters if neither the film nor the probe is axisymmetric. A fixed orientation then needs only a
                quarter of the solves for a rectangle, and two thirds of the solves for an equilateral triangle.
            executor: Executor that runs the solves; None for this process. The result does not depend on the executor.

        Raises:
            SceneError: If some presses of the domain cannot exist.
            SolveError: If a press has no equilibrium, or the interpolation error exceeds `INTERPOLATION_ERROR`.
        """
        domain = Domain(radius, force_range)
        counts = node_counts(sensor.film)
        build_map = partial(cls.build_unchecked, sensor, probe, domain, orientation=orientation, executor=executor)
        forward_map = build_map(counts[0], settings)

        # Solve a few check presses directly. The interpolated charges of every map are compared with these charges, so
        # all maps have the mesh of the first map.
        contact, rotation = spread_check_presses(domain, CHECK_COUNT)
        if forward_map.family.is_oriented:  # the probe cannot be rotated
            rotation = np.zeros(CHECK_COUNT)
        checks = np.column_stack([contact, rotation]).tolist()
        solve_directly = partial(direct_charges, sensor, probe, forward_map.settings)
        check_charges = np.array(list(in_order(executor, solve_directly, checks)))
        same_mesh = replace(forward_map.settings, layer=forward_map.layer)

        # Increase the number of nodes until the interpolated charges are sufficiently accurate. If the error is very
        # large, the next number of nodes would not suffice either and is skipped, unless it is the last.
        error = relative_error(forward_map.charges(contact, rotation), check_charges)
        count_index = 0
        while not error <= INTERPOLATION_ERROR:  # also if the error is NaN
            may_next_suffice = error <= SKIP_RATIO * INTERPOLATION_ERROR
            is_next_last = count_index + 2 == len(counts)
            count_index += 1 if may_next_suffice or is_next_last else 2
            if count_index >= len(counts):
                raise SolveError(
                    f"the forward map of {sensor.name} up to {radius:g} mm and {force_range[1]:g} N interpolates to "
                    f"{error:.2g} only, expected {INTERPOLATION_ERROR:g}; ask for a smaller radius or range of forces"
                )
            forward_map = build_map(counts[count_index], same_mesh)
            error = relative_error(forward_map.charges(contact, rotation), check_charges)
        return replace(forward_map, error=error)

    @classmethod
    def build_unchecked(
        cls,
        sensor: Sensor,
        probe: Probe,
        domain: Domain,
        count: NodeCount,
        settings: SolveSettings = SolveSettings(),
        *,
        orientation: Orientation = "fixed",
        read: Reading = probe_frame_stress,
        executor: Executor | None = None,
    ) -> "ForwardMap":
        """Build a forward map from a few solves, without a check by direct solves. The error of the map is not known.

        Args:
            sensor: Sensor whose charges the map computes.
            probe: Probe that presses the film.
            domain: Presses for which the map will be used.
            count: Numbers of distances and forces at which presses are solved, and of harmonics of the angles.
            settings: Accuracy, theory and mesh. A setting that is "auto" is chosen once for all presses.
            orientation: Whether the probe keeps its own orientation ("fixed") or may be rotated ("random").
            read: Function that computes the stress fields of the table from each solved press, shape (n_element,
                n_local, ..., 3), in the frame of the probe.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If some presses of the domain cannot exist.
            SolveError: If a press has no equilibrium.
        """
        check_family(sensor.film, probe, domain)
        resolution, ring_width = family_mesh(sensor.film, probe, domain, settings)  # of the thin rings at the rim
        fixed_settings = SolveSettings(theory=settings.theory, resolution=resolution, layer=ring_width)
        family = Family.spread(domain, sensor.film, probe, count, orientation)
        solved_values = family.solve(sensor, probe, fixed_settings, executor, read)
        template = template_for(resolution, probe.topology, not sensor.film.is_axisymmetric)
        table = family.unfold(solved_values, template)  # the stress fields at all rotations of the probe
        return cls(sensor, probe, family, settings.theory, resolution, ring_width, table, error=np.inf)

    @property
    def domain(self) -> Domain:
        """Presses for which the map is valid."""
        return self.family.domain

    @property
    def settings(self) -> SolveSettings:
        """Settings for solving other presses with the theory and the mesh of this map.

        The width of the thin rings at the rim remains "auto", so that it is chosen for each press.
        """
        return SolveSettings(theory=self.theory, resolution=self.resolution)

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the sensor's electrodes, in the order of the charges."""
        return self.sensor.electrode_names

    @property
    def solves(self) -> int:
        """Number of equilibria that were solved for the map."""
        family = self.family
        return family.distance.size * family.force.size * len(family.turns.solved)

    def charges(self, contact: Array, orientation: Array | float = 0.0) -> Array:
        """Compute the touch charges of presses: the charges under load minus the charges without load.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N. If F is zero, the charges are zero.
            orientation: Anticlockwise rotation of the probe in addition to its own orientation, shape (n,) or a number,
                rad.

        Returns:
            Charges, shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press with a force lies outside the domain, if an orientation is not finite, or if the
                probe is rotated although the map is only valid without a rotation.
        """
        contact = as_contacts(contact, "forward map")
        orientation = np.broadcast_to(orientation, len(contact))
        if not np.isfinite(orientation).all():
            wrong_orientation = orientation[~np.isfinite(orientation)][0]
            raise SceneError(f"forward map: expected finite orientations in rad, got {wrong_orientation}")
        if self.family.is_oriented and orientation.any():  # the map is only valid without a rotation
            raise SceneError(
                f"forward map: expected {self.probe.notation} in its own orientation, got a rotation by "
                f"{orientation[orientation != 0.0][0]:.4g} rad; build the map with orientation='random'"
            )

        # A press without a force may lie anywhere. It is replaced by a valid press, whose charges are then set to zero.
        has_force = contact[:, 2:] != 0.0
        valid_contact = (0.0, 0.0, self.domain.force_range[0])
        checked_contact = self.domain.check(np.where(has_force, contact, valid_contact), "forward map")
        return np.where(has_force, self._unchecked_charges(checked_contact, orientation), 0.0)

    def derivatives(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to x, y and ln F by central differences.

        The probe keeps its own orientation. At the edge of the domain, the central differences also evaluate presses
        slightly outside the domain.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 3), pC/mm, pC/mm and pC.

        Raises:
            SceneError: If a press lies outside the domain, or if the domain has only one force, so that the derivative
                with respect to the force is unknown.
        """
        contact = self.domain.check(contact, "forward map")
        min_force, max_force = self.domain.force_range
        if min_force == max_force:
            raise SceneError(
                f"expected a forward map of different forces for derivatives, got one of the force {min_force:g} N; "
                f"build a map from {0.9 * min_force:.3g} to {1.1 * min_force:.3g} N"
            )
        # `STEPS` are for a radius of 1 mm. The steps of a smaller probe are shorter, because the charges change within
        # its footprint. They are in proportion to its longest radius: with steps in proportion to the width of a narrow
        # footprint, numerical errors of the charges would dominate the differences.
        longest_radius_mm = self.probe.under(min_force).reach
        step_scale = min(1.0, longest_radius_mm)
        steps = np.multiply(STEPS, [step_scale, step_scale, 1.0])
        return differences(self._unchecked_charges, contact, steps)

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the charges of presses, and their derivatives with respect to x, y and ln F.

        See `charges` and `derivatives` for the shapes of the arrays. A `ChargeSpline` computes both much faster.
        """
        return self.charges(contact), self.derivatives(contact)

    def charges_by_force(self, position: Array, is_odd: Booleans = EVEN_FIELD) -> Array:
        """Compute the charges of each stress field at given positions, for all forces at which presses were solved.

        If the footprint of the probe grows with the force, each force has its own mesh. Otherwise, all forces have the
        same mesh, and the integration points are located only once. In this case, the stress fields are converted to
        single precision. The result includes neither the crosstalk nor the charges that the contact pressure causes.
        The probe keeps its own orientation.

        Args:
            position: Positions (x, y) in the domain, shape (n, 2), mm.
            is_odd: Whether each field is odd under a reflection in the line from the centre to the press, shape
                (n_field,).

        Returns:
            Charges, shape (n_force, n, n_electrode, n_field), pC.
        """
        n_force = self.family.force.size
        if not self.probe.grows:
            return self._same_mesh_charges(position, is_odd, slice(n_force), np.float32)
        slices = [slice(index, index + 1) for index in range(n_force)]  # each selects a single force
        return np.concatenate([self._same_mesh_charges(position, is_odd, selected, np.float64) for selected in slices])

    def _same_mesh_charges(self, position: Array, is_odd: Booleans, selected: slice, number_type: type) -> Array:
        """Compute the charges of each stress field for some forces of the solved presses that share the same mesh.

        Args:
            position: Positions (x, y) in the domain, shape (n, 2), mm.
            is_odd: Whether each field is odd under a reflection in the line from the centre to the press, shape
                (n_field,).
            selected: Slice that selects these forces from the forces of all solved presses.
            number_type: Number type to which the stress fields are converted.

        Returns:
            Charges, shape (n_selected_force, n, n_electrode, n_field), pC.
        """
        # The integration points depend on the mesh, and not on the force. To locate them only once, treat the fields of
        # different forces like different fields of one force. Create a map that has only the first selected force, but
        # the fields of all selected forces at each node. A turn is a direction of a press and a rotation of the probe.
        family = self.family
        force = family.force[selected]
        n_field = is_odd.size
        press_shape = (family.distance.size, family.force.size, family.turns.rotation.size)
        stress_by_force = self.table.reshape(*press_shape, -1, n_field * 3)[:, selected]  # (distance, force, turn, ...)
        fields = np.moveaxis(stress_by_force, 1, 3)  # shape (n_distance, n_turn, n_node, n_selected_force, n_field * 3)
        single_force_map = replace(
            self,
            probe=self.probe.under(force[0]),
            family=replace(family, force=force[:1]),
            table=fields.reshape(-1, fields[0, 0].size).astype(number_type),  # a row for each distance and turn
        )
        # All forces have the same fields in the same order.
        charge = single_force_map.field_charges(contacts_at(position, force[0]), np.tile(is_odd, force.size))
        charge_by_force = charge.reshape(*charge.shape[:2], force.size, n_field)

        # The map multiplies all fields by the squared amplitude of its own force. Replace this factor by the squared
        # amplitude of each force.
        squared_amplitude = amplitude_squared(self.sensor.film, force)
        charge_by_force *= (squared_amplitude / squared_amplitude[0])[:, None]
        return np.moveaxis(charge_by_force, 2, 0)  # from (n, n_electrode, n_force, n_field)

    def _unchecked_charges(self, contact: Array, orientation: Array | float = 0.0) -> Array:
        """Compute the charges of presses that lie in the domain or slightly outside the domain.

        The result is the sum of the charges that the stress causes and the charges that the contact pressure causes,
        with crosstalk.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.
            orientation: Rotation of the probe in addition to its own orientation, shape (n,) or a number, rad.

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        charge = self.field_charges(contact, EVEN_FIELD, orientation)[..., 0]
        charge += contact_charges(self.sensor, self.probe, contact, orientation)
        return self.sensor.calibration.read(charge)

    def field_charges(self, contact: Array, is_odd: Booleans, orientation: Array | float = 0.0) -> Array:
        """Compute the charges of each stress field in the table of the map.

        The table contains stress fields at the nodes of the mesh under the solved presses: the stress itself, or its
        changes with several properties of the film. A row of the table contains all fields at one node, then all fields
        at the next node. The result includes neither the crosstalk nor the charges that the contact pressure causes.
        The presses are evaluated in chunks, which limits the required memory.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.
            is_odd: Whether each field is odd under a reflection in the line from the centre to the press, shape
                (n_field,).
            orientation: Rotation of the probe in addition to its own orientation, shape (n,) or a number, rad.

        Returns:
            Charges, shape (n, n_electrode, n_field), pC.
        """
        if self.probe.grows:
            return self._growing_probe_charges(contact, is_odd)

        position = to_complex(contact[:, :2])
        orientation = np.broadcast_to(orientation, len(contact))
        charges = np.empty((len(contact), len(self.electrodes), is_odd.size))
        pieces = ElectrodePieces.of(self.sensor)
        charge_per_stress = piece_charge_per_stress(self.sensor)
        with single_threaded_blas():  # faster for the many small matrices of a chunk
            chunk_size = max(1, CHUNK_SIZE // is_odd.size)
            for start in range(0, len(contact), chunk_size):
                chunk = slice(start, start + chunk_size)
                density = self.charge_density(
                    position[chunk], contact[chunk, 2], orientation[chunk], is_odd, charge_per_stress
                )
                charges[chunk] = density.integrate(pieces)
        return self.sensor.gains[:, None] * charges

    def _growing_probe_charges(self, contact: Array, is_odd: Booleans) -> Array:
        """Compute the charges of each stress field for a probe whose footprint grows with the force.

        The mesh depends on the footprint, so the stress fields cannot be interpolated between forces. Instead, the
        charges at the forces of the solved presses (the family) are divided by the squared amplitude, and interpolated.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.
            is_odd: Whether each field is odd under a reflection in the line from the centre to the press, shape
                (n_field,).

        Returns:
            Charges without crosstalk, shape (n, n_electrode, n_field), pC.
        """
        film = self.sensor.film
        family_force = self.family.force
        force = contact[:, 2]
        weights = lagrange_values(np.log(family_force), np.log(force))
        # Divide by the squared amplitude at the force of the family, and multiply by that at the force of the press.
        weights *= amplitude_squared(film, force)[:, None] / amplitude_squared(film, family_force)
        family_charges = self.charges_by_force(contact[:, :2], is_odd)
        # Sum over the forces of the family (index k), for each press (n), electrode (e) and field (f).
        return np.asarray(np.einsum("nk,knef->nef", weights, family_charges))

    def charge_density(
        self, position: Complexes, force: Array, orientation: Array, is_odd: Booleans, charge_per_stress: Array
    ) -> ChargeDensity:
        """Interpolate the stress fields under several presses, and convert them into charge per area.

        If only half of the film is meshed, the charge per area is also computed for the reflection of the mesh. An
        electrode consists of pieces of one or two kinds. Each kind has its own weights of the stress components.

        Args:
            position: Positions x + iy, shape (n,), mm.
            force: Forces, shape (n,), N.
            orientation: Rotation of the probe in addition to its own orientation, shape (n,), rad.
            is_odd: Whether each field is odd under a reflection in the line from the centre to the press, shape
                (n_field,).
            charge_per_stress: Charge per area and per unit of the stress (s11, s22, s12), for each kind of piece, shape
                (n_kind, 3), pC/N.

        Returns:
            Charge per area at the nodes of the mesh under each press.
        """
        # Place the mesh under each press, after the press was rotated onto the x axis. The probe has a rotation
        # relative to the direction of the press, which has no effect if the probe is axisymmetric.
        film = self.sensor.film
        n_field = is_odd.size
        direction = np.angle(position)  # from the centre of the film to the press, rad
        rotation = np.zeros_like(direction) if self.probe.is_axisymmetric else orientation - direction
        template = template_for(self.resolution, self.probe.topology, not film.is_axisymmetric)
        oval = film_oval(film, direction)
        placement = Placement.of(template, self.probe, np.abs(position), film.radius, self.layer, rotation, oval)

        # Interpolate between the solved presses (the family), in the precision of the table, and multiply by the unit
        # of the scaled stress. A row of the table contains all fields at one node, then all fields at the next node.
        stress_unit = film.young * amplitude_squared(film, force)
        weights = self.family.weights(position, force, rotation) * stress_unit[:, None]
        interpolated = weights.astype(self.table.dtype) @ self.table  # one row for each press
        stress = interpolated.reshape(position.size, -1, n_field, 3).swapaxes(1, 2)  # shape (n, n_field, n_node, 3)

        # Convert the stress, whose components refer to a frame that rotates with the probe, into charge per area. If
        # only half of the film is meshed, there is a second sign for the reflection of the mesh.
        probe_angle = direction + rotation + self.probe.angle
        charge_per_probe_stress = rotate_stress(np.eye(3), probe_angle[:, None]) @ charge_per_stress.T  # (n, 3, n_kind)
        signs = _reflection_signs(is_odd) if template.half else np.ones((n_field, 3, 1))  # (n_field, 3, n_sign)
        # Charge per area and stress component, shape (n, n_field, 3, n_sign, n_kind)
        charge_factors = signs[..., None] * charge_per_probe_stress[:, None, :, None]
        density = stress @ charge_factors.reshape(*stress.shape[:2], 3, -1).astype(stress.dtype)

        # From (press, field, node, sign and kind) to (sign, kind, press, element, node, field), as in `ChargeDensity`
        shape = (*charge_factors.shape[3:], position.size, template.n_element, -1, n_field)
        ordered_density = density.transpose(3, 0, 2, 1).reshape(shape)
        return ChargeDensity(position, self.probe, film.radius, template, placement, ordered_density)


def _reflection_signs(is_odd: Booleans) -> Array:
    """Return the signs of the stress components at a point of the half mesh and at its reflection.

    In an even field, s12 changes its sign under the reflection. In an odd field, s11 and s22 change their signs.

    Args:
        is_odd: Whether each field is odd with respect to the reflection, shape (n_field,).

    Returns:
        Signs 1 and -1 of (s11, s22, s12), shape (n_field, 3, 2). The last index is 0 for the point and 1 for its
        reflection.
    """
    reflected_signs = np.where(is_odd[:, None], [-1.0, -1.0, 1.0], [1.0, 1.0, -1.0])
    return np.stack([np.ones_like(reflected_signs), reflected_signs], axis=2)
