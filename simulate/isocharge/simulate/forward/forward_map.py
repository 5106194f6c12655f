"""The forward map: charges for many presses from a few solves.

Presses of one probe form a family in distance from the centre, force and, unless the probe is round, orientation; the
angle of the position is a rotation. Seen from the probe, the stress at the template's nodes is a smooth function of all
of them. It is solved on Chebyshev nodes in distance and the force's logarithm and on evenly spread orientations,
interpolated as a field, and the charge is integrated from the interpolated field again for every press: exact for the
position of the electrode, also with the probe on it. Building a map compares it with direct solves.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import SolveError
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.forward.charge_map import Domain, as_contacts, differences
from isocharge.simulate.forward.family import ROTATIONS, Family, check_family
from isocharge.simulate.forward.readout import COARSE, FINE, NEAR, ReadoutPoints, contact_charge, touch_charge
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.mechanics.stress import rotate_stress
from isocharge.simulate.mechanics.theory import Theory, theory_for
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.numerics.interpolation import tensor_values
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.load_case import SolveSettings, layer_for
from isocharge.simulate.solver.press import needed_resolution, press

CHUNK = 256
"""Presses evaluated at once: keeps the working arrays within some 100 MB."""

INTERPOLATION_ERROR = 5e-4
"""Largest relative error of any charge against direct solves that a forward map may have."""

SMALL = 0.1
"""Floor for the charge that an error is relative to, as a share of the press's largest charge, dimensionless."""

EVEN = np.zeros(1, dtype=bool)
"""Parity of the stress under a press on an isotropic round film."""

CHECKS = 10
"""Number of direct solves that a forward map is compared with."""

NODES = (((5, 3), ROTATIONS), ((8, 5), 2 * ROTATIONS), ((13, 8), 3 * ROTATIONS), ((13, 12), 3 * ROTATIONS))
"""Distances and forces, and least orientations, that are tried in turn: the last for taut films, on which the charges
pass from a power of the force to another, and through zero."""


@dataclass(frozen=True)
class ForwardMap:
    """Touch charges of a sensor under one probe as a function of (x, y, F) and orientation.

    Attributes:
        sensor: The sensor.
        probe: The footprint.
        family: Distances, forces and orientations of the solves.
        theory: Which terms are modelled.
        resolution: Mesh of the solves.
        layer: Width of its thin rings at the rim over the film's radius.
        table: Scaled stress C : E' at the nodes of every element, in a frame that rotates with the probe; shape
            (n_distance * n_force * n_rotation, n_element * n_local * 3).
        error: Largest relative error of a charge against the direct solves that the build compared with.
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
        """Solve a family and check it.

        Args:
            sensor: The sensor.
            probe: The footprint.
            radius: Largest distance of a press from the centre, mm.
            force_range: Smallest and largest force, N.
            settings: Accuracy, theory and mesh. What is "auto" is chosen for all presses: the fewest terms that the
                accuracy allows over the forces, the mesh of the outermost press, thin rings for the middle force.
            executor: Runs the solves; None for this process. The result does not depend on it.

        Raises:
            SceneError: If some presses cannot exist.
            SolveError: If an equilibrium or the interpolation error is not reached.
        """
        film, domain = sensor.film, Domain(radius, force_range)
        check_family(sensor.coated_film, probe, domain)
        middle = float(np.sqrt(force_range[0] * force_range[1]))
        theory = (
            theory_for(sensor, probe, force_range, settings.accuracy) if settings.theory == "auto" else settings.theory
        )
        layer = layer_for(film, middle) if settings.layer == "auto" else settings.layer
        settings = replace(settings, theory=theory, layer=layer)
        resolution = needed_resolution(film, probe, (radius, 0.0), middle, settings)
        settings = replace(settings, resolution=resolution)
        error = np.inf
        for count, rotations in NODES:
            family = Family.spread(domain, count, probe.period, rotations)
            table = family.unfold(family.solve(sensor, probe, settings, executor), template_for(probe, resolution))
            forward_map = cls(sensor, probe, family, theory, resolution, layer, table, error)
            error = max(relative_error(forward_map, *press) for press in family.probes_between(CHECKS))
            if error <= INTERPOLATION_ERROR:
                return replace(forward_map, error=error)
        raise SolveError(
            f"the forward map of {sensor.name} up to {radius:g} mm and {force_range[1]:g} N interpolates to "
            f"{error:.2g} only, expected {INTERPOLATION_ERROR:g}; ask for a smaller radius or range of forces"
        )

    @property
    def domain(self) -> Domain:
        """The presses that are covered."""
        return self.family.domain

    @property
    def settings(self) -> SolveSettings:
        """Theory and mesh of the solves, for single presses or another map; the thin rings suit each press."""
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
        """Touch charges.

        Args:
            contact: (x, y, F), shape (n, 3), mm and N; where F is zero the film is untouched and the charges are zero.
            orientation: Further rotation of the probe, shape (n,) or a number, rad, anticlockwise.

        Returns:
            Shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = as_contacts(contact, "forward map")
        untouched = contact[:, 2] == 0.0
        self.domain.check(np.where(untouched[:, None], (0.0, 0.0, self.domain.force_range[0]), contact), "forward map")
        orientation = np.broadcast_to(orientation, len(contact))
        charge, touched = np.zeros((len(contact), len(self.electrodes))), np.flatnonzero(~untouched)
        charge[touched] = self._at(contact[touched], orientation[touched])
        return charge

    def derivatives(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F), shape (n, n_electrode, 3), pC/mm, pC/mm and pC, of contacts, shape (n, 3), mm and N.

        By central differences, which reach beyond the edge of the domain.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.domain.check(contact, "forward map")
        return differences(lambda moved: self._at(moved, np.zeros(len(moved))), contact)

    def _at(self, contact: Array, orientation: Array) -> Array:
        """Charges of presses of the domain or a little beyond."""
        at, charge = contact[:, 0] + 1j * contact[:, 1], np.empty((len(contact), len(self.electrodes)))
        with single_threaded_blas():
            for start in range(0, len(contact), CHUNK):
                chunk = slice(start, start + CHUNK)
                charge[chunk] = self._charges(at[chunk], contact[chunk, 2], orientation[chunk])
        return charge

    def by_field(self, contact: Array, odd: Booleans, readout: ReadoutPoints | None = None) -> Array:
        """Charges of several fields of stress in one table, each at its nodes in turn, under a round probe.

        These are corrections: the coarse rule is used everywhere, and neither pressure on electrodes nor crosstalk is
        in them.

        Args:
            contact: Presses of the domain, shape (n, 3), mm and N.
            odd: Which fields are odd about the direction of the press, shape (n_field,).
            readout: What collects; the electrodes if absent.

        Returns:
            Shape (n, n_electrode, n_field), pC.
        """
        at, readout = contact[:, 0] + 1j * contact[:, 1], readout or self._readouts[1]
        every = np.ones((at.size, len(readout.count)), dtype=bool)
        with single_threaded_blas():
            parts = [
                self._by_field(at[chunk], contact[chunk, 2], np.zeros(1), odd, ((readout, every[chunk]),))
                for chunk in (slice(start, start + CHUNK) for start in range(0, at.size, CHUNK))
            ]
        return np.concatenate(parts)

    def _charges(self, at: Complexes, force: Array, orientation: Array) -> Array:
        """Charges of one chunk of presses, shape (n, n_electrode)."""
        near, (fine, coarse) = self._near(at), self._readouts
        charge: Array = self._by_field(at, force, orientation, EVEN, ((fine, near), (coarse, ~near)))[..., 0]
        if self.sensor.piezo.d33 != 0.0:
            for i in np.flatnonzero(near.any(axis=1)):
                probe = self.probe.rotated(float(orientation[i]))
                charge[i] += contact_charge(self.sensor, probe, (at[i].real, at[i].imag), force[i])
        return self.sensor.calibration.read(charge)

    def _by_field(
        self,
        at: Complexes,
        force: Array,
        orientation: Array,
        odd: Booleans,
        rules: tuple[tuple[ReadoutPoints, Booleans], ...],
    ) -> Array:
        """Charges of the fields of one chunk of presses, (n, n_electrode, n_field); each rule where it is chosen."""
        rotation = orientation - np.angle(at)
        field = self.family.weights(np.abs(at), force, rotation) @ self.table
        mesh = template_for(self.probe, self.resolution)
        placement = Placement.of(mesh, self.probe, np.abs(at), self.sensor.film.radius, self.layer, rotation)
        charge = np.empty((*rules[0][1].shape, odd.size))
        for readout, chosen in rules:
            for count in np.unique(readout.count):
                press_index, electrode = np.nonzero(chosen & (readout.count == count))
                charge[press_index, electrode] = self._read(
                    readout, field, placement, at, rotation + self.probe.angle, press_index, electrode, count, odd
                )
        scale = self.sensor.film.young * amplitude_squared(self.sensor.film, force)
        return np.asarray(charge * scale[:, None, None])

    @cached_property
    def _readouts(self) -> tuple[ReadoutPoints, ReadoutPoints]:
        """The fine and the coarse rule for the charges."""
        return ReadoutPoints.of(self.sensor, FINE), ReadoutPoints.of(self.sensor, COARSE)

    def _near(self, at: Complexes) -> Booleans:
        """Which electrodes need the fine rule for which presses, shape (n, n_electrode)."""
        away = [(np.abs(at[:, None] - centre) - reach).min(axis=1) for centre, reach in self.sensor.discs]
        return np.asarray(np.stack(away, axis=1) < self.probe.reach + NEAR)

    def _read(
        self,
        readout: ReadoutPoints,
        field: Array,
        placement: Placement,
        at: Complexes,
        frame: Array,
        press_index: Integers,
        electrode: Integers,
        count: int,
        odd: Booleans,
    ) -> Array:
        """Scaled charges of pairs of press and electrode, whose readout has `count` points, shape (n_pair, n_field).

        `frame` is the angle of the probe, and of the field's stress, from the direction of the press, shape (n,).
        """
        mesh, angle = template_for(self.probe, self.resolution), np.angle(at[press_index])
        points = readout.points[electrode, :count] @ np.array([1.0, 1j]) / self.sensor.film.radius
        position, mirrored = mesh.into_meshed_half(points * np.exp(-1j * angle)[:, None])
        element, xi, eta = placement[press_index].locate(mesh, position)
        values = tensor_values(self.resolution.order, xi.ravel(), eta.ravel())
        width, frames = 3 * odd.size, (angle if mesh.half else angle + frame[press_index])[:, None]
        nodal = field.reshape(len(field), mesh.n_element, -1, width)[press_index[:, None], element]
        local = np.matmul(values[:, None, :], nodal.reshape(*values.shape, width)).reshape(*position.shape, width)
        charge, weights = np.empty((len(local), odd.size)), readout.weights[electrode, :count]
        for number in range(odd.size):
            one = local[..., 3 * number : 3 * number + 3]
            one[mirrored, (slice(0, 2) if odd[number] else 2)] *= -1.0
            charge[:, number] = np.einsum("kpc,kpc->k", rotate_stress(one, frames), weights)
        return charge


def relative_error(
    forward_map: ForwardMap, distance: float, angle: float, force: float, rotation: float = 0.0
) -> float:
    """Largest error of a charge against a direct solve, relative to the charge or `SMALL` of the largest one.

    Args:
        forward_map: The map.
        distance: Of the press from the centre, mm.
        angle: Its direction from the centre, rad.
        force: N.
        rotation: Further rotation of the probe, rad.
    """
    sensor, at = forward_map.sensor, (distance * float(np.cos(angle)), distance * float(np.sin(angle)))
    direct = touch_charge(
        sensor, press(sensor.film, forward_map.probe.rotated(rotation), at, force, forward_map.settings)
    )
    mapped = forward_map.charges(np.array([[*at, force]]), rotation)[0]
    scale = np.maximum(np.abs(direct), SMALL * np.abs(direct).max())
    return float((np.abs(mapped - direct) / scale).max())
