"""The forward map: the charges of many presses, computed from a few solves.

The presses of one probe form a family with the coordinates distance from the centre, force and, unless the probe is
axisymmetric, orientation. The direction of the position is a rotation of the whole film. In a frame that moves with the
probe, the stress at the nodes of the template is a smooth function of these coordinates. The press is solved at
Chebyshev nodes in the distance and in the logarithm of the force, and at evenly spaced orientations. For every other
press, the stress field is interpolated, and the charges are integrated from the interpolated field. The position of the
electrodes is therefore exact, also if the probe lies on an electrode. When a map is built, it is compared with direct
solves.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SolveError
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import Domain, as_contacts, differences
from isocharge.simulate.forward.family import ROTATIONS, CheckPress, Family, check_family, check_presses
from isocharge.simulate.forward.press_chunk import PressChunk
from isocharge.simulate.forward.readout import (
    COARSE,
    FAR,
    FAR_DISTANCE,
    FINE,
    NEAR,
    ReadoutPoints,
    contact_charge,
    touch_charge,
)
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.mechanics.theory import Theory, theory_for
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.placement import Placement, widest_smooth_layer
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.load_case import SolveSettings, layer_for
from isocharge.simulate.solver.press import needed_resolution, press

CHUNK_SIZE = 256
"""Number of presses that are evaluated at once. It limits the working arrays to about 100 MB."""

INTERPOLATION_ERROR = 5e-4
"""Largest relative error of a charge with respect to direct solves that a forward map may have."""

CHARGE_FLOOR = 0.1
"""Smallest charge to which an error is relative, as a share of the largest charge of the press, dimensionless."""

EVEN_FIELD = np.zeros(1, dtype=bool)
"""Parity of the stress field under a press on an isotropic round film: one field, which is even."""

SKIP_RATIO = 10.0
"""Ratio of the error to `INTERPOLATION_ERROR` above which the next numbers of nodes would not suffice either and are
skipped, dimensionless."""

MAX_RING_RATIO = 2.0
"""Largest ratio of the radii of successive rings of the mesh for which the stress is smooth enough across an electrode
that the rule for far electrodes can be used, dimensionless. Meshes that are chosen automatically have about 1.9."""

CHECK_COUNT = 10
"""Number of direct solves with which a forward map is compared."""


class NodeCount(NamedTuple):
    """Number of nodes of a family.

    Attributes:
        distances: Number of distances.
        forces: Number of forces.
        min_orientations: Smallest number of orientations.
    """

    distances: int
    forces: int
    min_orientations: int


NODE_COUNTS = (
    NodeCount(5, 3, ROTATIONS),
    NodeCount(8, 5, 2 * ROTATIONS),
    NodeCount(10, 7, 3 * ROTATIONS),
    NodeCount(13, 12, 3 * ROTATIONS),
)
"""Numbers of nodes that are tried in turn. The last one is for taut films, whose charges change from one power of the
force to another and pass through zero."""


@dataclass(frozen=True)
class ForwardMap:
    """Touch charges of a sensor under one probe, as a function of position, force and orientation.

    Attributes:
        sensor: The sensor.
        probe: The probe.
        family: Distances, forces and orientations of the solves.
        theory: Terms of the film theory that are modelled.
        resolution: Fineness of the mesh of the solves.
        layer: Width of the thin rings at the rim, in film radii.
        table: Scaled stress C : E' at the nodes of every element, in a frame that rotates with the probe, shape
            (n_distance * n_force * n_rotation, n_element * n_local * 3), dimensionless.
        error: Largest relative error of a charge with respect to the direct solves of `build`.
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
        executor: Executor | None = None,
    ) -> "ForwardMap":
        """Solve a family of presses, and compare the interpolation with direct solves.

        Args:
            sensor: The sensor.
            probe: The probe.
            radius: Largest distance of a press from the centre, mm.
            force_range: Smallest and largest force, N.
            settings: Accuracy, theory and mesh. Settings that are "auto" are chosen for all presses together: the
                fewest terms that the accuracy allows for all forces, the mesh that the outermost press needs, and the
                width of the thin rings for the geometric mean of the forces.
            executor: Executor that runs the solves; None for this process. The result does not depend on it.

        Raises:
            SceneError: If some presses of the domain cannot exist.
            SolveError: If a press has no equilibrium, or the interpolation error exceeds `INTERPOLATION_ERROR`.
        """
        film = sensor.film
        domain = Domain(radius, force_range)
        check_family(sensor.coated_film, probe, domain)
        middle_force = float(np.sqrt(force_range[0] * force_range[1]))
        theory = settings.theory
        if theory == "auto":
            theory = theory_for(sensor, probe, force_range, settings.accuracy)
        layer = layer_for(film, middle_force) if settings.layer == "auto" else settings.layer
        settings = replace(settings, theory=theory, layer=layer)
        resolution = needed_resolution(film, probe, (radius, 0.0), middle_force, settings)
        template = template_for(probe, resolution)
        layer = min(layer, widest_smooth_layer(template, probe, radius, film.radius))
        settings = replace(settings, resolution=resolution, layer=layer)
        checks = check_presses(domain, CHECK_COUNT)
        check_charges: list[Array] = []
        error = np.inf
        remaining_counts = list(NODE_COUNTS)
        while remaining_counts:
            count = remaining_counts.pop(0)
            node_count = (count.distances, count.forces)
            family = Family.spread(domain, film.radius, node_count, probe.period, count.min_orientations)
            table = family.unfold(family.solve(sensor, probe, settings, executor), template)
            forward_map = cls(sensor, probe, family, theory, resolution, layer, table, error)
            if not check_charges:
                solve_directly = partial(direct_charges, sensor, probe, forward_map.settings)
                check_charges = list(in_order(executor, solve_directly, checks))
            error = max(map(forward_map.relative_error, checks, check_charges))
            if error <= INTERPOLATION_ERROR:
                return replace(forward_map, error=error)
            if error > SKIP_RATIO * INTERPOLATION_ERROR and len(remaining_counts) > 1:
                remaining_counts.pop(0)
        raise SolveError(
            f"the forward map of {sensor.name} up to {radius:g} mm and {force_range[1]:g} N interpolates to "
            f"{error:.2g} only, expected {INTERPOLATION_ERROR:g}; ask for a smaller radius or range of forces"
        )

    @property
    def domain(self) -> Domain:
        """Presses that the map covers."""
        return self.family.domain

    @property
    def settings(self) -> SolveSettings:
        """Theory and mesh of the solves, for single presses or another map. The width of the thin rings remains
        "auto"."""
        return SolveSettings(theory=self.theory, resolution=self.resolution)

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the sensor's electrodes, in the order of the charges."""
        return self.sensor.electrode_names

    @property
    def solves(self) -> int:
        """Number of equilibria that were solved for the map."""
        return self.family.distance.size * self.family.force.size * self.family.solved_rotations.size

    def charges(self, contact: Array, orientation: Array | float = 0.0) -> Array:
        """Compute touch charges.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N. If F is zero, the charges are zero.
            orientation: Further rotation of the probe, anticlockwise, shape (n,) or a number, rad.

        Returns:
            Charges, shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = as_contacts(contact, "forward map")
        untouched = contact[:, 2] == 0.0
        valid_contact = (0.0, 0.0, self.domain.force_range[0])
        self.domain.check(np.where(untouched[:, None], valid_contact, contact), "forward map")
        orientation = np.broadcast_to(orientation, len(contact))
        charge = np.zeros((len(contact), len(self.electrodes)))
        touched = np.flatnonzero(~untouched)
        charge[touched] = self._unchecked_charges(contact[touched], orientation[touched])
        return charge

    def derivatives(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to x, y and ln F by central differences.

        The differences also use presses a little outside the domain.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.

        Returns:
            Shape (n, n_electrode, 3), pC/mm, pC/mm and pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.domain.check(contact, "forward map")
        return differences(lambda moved: self._unchecked_charges(moved, np.zeros(len(moved))), contact)

    def relative_error(self, check: CheckPress, direct: Array) -> float:
        """Compute the largest error of a charge of one press with respect to a direct solve.

        The error is relative to the charge, or to `CHARGE_FLOOR` times the largest charge of the press if that is
        larger.

        Args:
            check: The press.
            direct: Charges of the direct solve, shape (n_electrode,), pC.
        """
        mapped = self.charges(np.array([[*check.position, check.force]]), check.rotation)[0]
        scale = np.maximum(np.abs(direct), CHARGE_FLOOR * np.abs(direct).max())
        return float((np.abs(mapped - direct) / scale).max())

    def field_charges(self, contact: Array, is_odd: Booleans, readout: ReadoutPoints | None = None) -> Array:
        """Compute the charges of several stress fields that the table contains, under a circular probe.

        The fields are small corrections, so the coarse integration rule is used for all electrodes, and the pressure on
        the electrodes and the crosstalk are omitted.

        Args:
            contact: Presses (x, y, F) in the domain, shape (n, 3), mm and N.
            is_odd: Whether each field is odd about the direction of the press, shape (n_field,). The table holds the
                values of all fields at one node, then those at the next node.
            readout: Integration points of the charges; None for those of the electrodes.

        Returns:
            Shape (n, n_electrode, n_field), pC.
        """
        at = contact[:, 0] + 1j * contact[:, 1]
        readout = readout or self._coarse_readout
        every_electrode = np.ones((at.size, len(readout.count)), dtype=bool)
        parts = []
        with single_threaded_blas():
            for start in range(0, at.size, CHUNK_SIZE):
                chunk = slice(start, start + CHUNK_SIZE)
                rules = ((readout, every_electrode[chunk]),)
                parts.append(self._integrate_fields(at[chunk], contact[chunk, 2], np.zeros(1), is_odd, rules))
        return np.concatenate(parts)

    def stress_charges_by_force(self, position: Array, is_needed: Booleans) -> Array:
        """Compute the charges that the stress causes, for all forces of the family at once.

        The pressure on the electrodes and the crosstalk are omitted. The probe keeps its orientation.

        Args:
            position: Positions (x, y) in the domain, shape (n, 2), mm.
            is_needed: Whether the charge of each electrode is needed, shape (n_electrode,).

        Returns:
            Shape (n, n_force, n_electrode), pC. Charges that are not needed are zero.
        """
        at = position[:, 0] + 1j * position[:, 1]
        stacked = self._stacked_forces
        unit_force = stacked.family.force[0]
        even_fields = np.zeros(self.family.force.size, dtype=bool)
        chunk_size = max(1, CHUNK_SIZE // even_fields.size)
        parts = []
        with single_threaded_blas():
            for start in range(0, at.size, chunk_size):
                chunk = at[start : start + chunk_size]
                rules = tuple((readout, pairs & is_needed) for readout, pairs in self._rules(chunk))
                force = np.full(chunk.size, unit_force)
                parts.append(stacked._integrate_fields(chunk, force, np.zeros(1), even_fields, rules))
        stress_unit = amplitude_squared(self.sensor.film, self.family.force)
        scale = stress_unit / amplitude_squared(self.sensor.film, unit_force)
        return np.asarray(np.concatenate(parts).swapaxes(1, 2) * scale[:, None])

    def pressure_charges(self, position: Array) -> Array:
        """Compute the charges of the pressure on the electrodes per force, without crosstalk.

        Args:
            position: Positions (x, y), shape (n, 2), mm.

        Returns:
            Shape (n, n_electrode), pC/N.
        """
        return self._pressure_charges(position[:, 0] + 1j * position[:, 1], np.zeros(len(position)))

    @cached_property
    def _stacked_forces(self) -> "ForwardMap":
        """Map of a single force, in which the stress fields of all forces are separate fields, in single precision."""
        force_count = self.family.force.size
        family = replace(self.family, force=self.family.force[:1])
        rows = self.table.reshape(self.family.distance.size, force_count, self.family.rotation.size, -1, 3)
        stacked = np.moveaxis(rows, 1, 3).reshape(family.distance.size * family.rotation.size, -1)
        return replace(self, family=family, table=stacked.astype(np.float32))

    def _unchecked_charges(self, contact: Array, orientation: Array) -> Array:
        """Compute the charges of presses in the domain or a little outside, in chunks that fit into the memory.

        Args:
            contact: Presses (x, y, F), shape (n, 3), mm and N.
            orientation: Further rotation of the probe, shape (n,), rad.

        Returns:
            Shape (n, n_electrode), pC.
        """
        position = contact[:, 0] + 1j * contact[:, 1]
        charge = np.empty((len(contact), len(self.electrodes)))
        with single_threaded_blas():
            for start in range(0, len(contact), CHUNK_SIZE):
                chunk = slice(start, start + CHUNK_SIZE)
                charge[chunk] = self._chunk_charges(position[chunk], contact[chunk, 2], orientation[chunk])
        return charge

    def _chunk_charges(self, at: Complexes, force: Array, orientation: Array) -> Array:
        """Compute the charges of one chunk of presses.

        Args:
            at: Positions x + iy, shape (n,), mm.
            force: Forces, shape (n,), N.
            orientation: Further rotation of the probe, shape (n,), rad.

        Returns:
            Shape (n, n_electrode), pC.
        """
        rules = self._rules(at)
        charge: Array = self._integrate_fields(at, force, orientation, EVEN_FIELD, rules)[..., 0]
        charge += force[:, None] * self._pressure_charges(at, orientation)
        return self.sensor.calibration.read(charge)

    def _pressure_charges(self, at: Complexes, orientation: Array) -> Array:
        """Compute the charges of the pressure on the electrodes per force, without crosstalk.

        Args:
            at: Positions x + iy, shape (n,), mm.
            orientation: Further rotation of the probe, shape (n,), rad.

        Returns:
            Shape (n, n_electrode), pC/N.
        """
        charge = np.zeros((at.size, len(self.electrodes)))
        if self.sensor.piezo.d33 != 0.0:
            for i in np.flatnonzero(self._is_near(at).any(axis=1)):
                probe = self.probe.rotated(float(orientation[i]))
                charge[i] = contact_charge(self.sensor, probe, (at[i].real, at[i].imag), 1.0)
        return charge

    def _integrate_fields(
        self,
        at: Complexes,
        force: Array,
        orientation: Array,
        is_odd: Booleans,
        rules: tuple[tuple[ReadoutPoints, Booleans], ...],
    ) -> Array:
        """Interpolate the stress fields of one chunk of presses, and integrate their charges.

        Args:
            at: Positions x + iy, shape (n,), mm.
            force: Forces, shape (n,), N.
            orientation: Further rotation of the probe, shape (n,) or (1,), rad.
            is_odd: Whether each field of the table is odd about the direction of the press, shape (n_field,).
            rules: Integration rules, each with the pairs of press and electrode that use it, shape (n, n_electrode).

        Returns:
            Shape (n, n_electrode, n_field), pC.
        """
        rotation = orientation - np.angle(at)
        field = self.family.weights(np.abs(at), force, rotation).astype(self.table.dtype) @ self.table
        mesh = template_for(self.probe, self.resolution)
        placement = Placement.of(mesh, self.probe, np.abs(at), self.sensor.film.radius, self.layer, rotation)
        presses = PressChunk(mesh, placement, field, np.angle(at), rotation + self.probe.angle)
        _, first_pairs = rules[0]
        charge = np.zeros((*first_pairs.shape, is_odd.size))
        for readout, uses_rule in rules:
            for count in np.unique(readout.count):
                press_index, electrode = np.nonzero(uses_rule & (readout.count == count))
                points = readout.points[electrode, :count] @ np.array([1.0, 1j]) / self.sensor.film.radius
                weights = readout.weights[electrode, :count]
                charge[press_index, electrode] = presses.scaled_charges(press_index, points, weights, is_odd)
        stress_unit = self.sensor.film.young * amplitude_squared(self.sensor.film, force)
        return np.asarray(charge * stress_unit[:, None, None])

    @cached_property
    def _fine_readout(self) -> ReadoutPoints:
        """Integration rule for electrodes near the probe."""
        return ReadoutPoints.of(self.sensor, FINE)

    @cached_property
    def _coarse_readout(self) -> ReadoutPoints:
        """Integration rule for electrodes away from the probe."""
        return ReadoutPoints.of(self.sensor, COARSE)

    @cached_property
    def _far_readout(self) -> ReadoutPoints:
        """Integration rule for electrodes far from the probe."""
        return ReadoutPoints.of(self.sensor, FAR)

    def _rules(self, at: Complexes) -> tuple[tuple[ReadoutPoints, Booleans], ...]:
        """Return the integration rules for presses at positions x + iy (mm), each with the pairs of press and electrode
        that use it, shape (n, n_electrode)."""
        near = self._is_near(at)
        parts = [(np.abs(at[:, None] - centre) / radius).min(axis=1) for centre, radius in self.sensor.part_circles]
        far = ~near & (np.stack(parts, axis=1) > FAR_DISTANCE) & self._has_smooth_far_field
        return (self._fine_readout, near), (self._coarse_readout, ~near & ~far), (self._far_readout, far)

    @cached_property
    def _has_smooth_far_field(self) -> bool:
        """Whether the mesh is fine enough for the integration with few points over electrodes far from the probe."""
        ring_ratio = (self.sensor.film.radius / self.probe.reach) ** (1.0 / self.resolution.rings)
        return bool(ring_ratio <= MAX_RING_RATIO)

    def _is_near(self, at: Complexes) -> Booleans:
        """Return whether each electrode is so near to each press that it needs the fine rule, shape (n,
        n_electrode)."""
        gap = [(np.abs(at[:, None] - centre) - radius).min(axis=1) for centre, radius in self.sensor.part_circles]
        return np.asarray(np.stack(gap, axis=1) < self.probe.reach + NEAR)


def direct_charges(sensor: Sensor, probe: Probe, settings: SolveSettings, check: CheckPress) -> Array:
    """Compute the charges of one press by a direct solve, without interpolation.

    Args:
        sensor: The sensor.
        probe: The probe.
        settings: Settings of the solver.
        check: The press.

    Returns:
        Shape (n_electrode,), pC.
    """
    at = check.position
    rotated = probe.rotated(check.rotation)
    return touch_charge(sensor, press(sensor.film, rotated, at, check.force, settings))
