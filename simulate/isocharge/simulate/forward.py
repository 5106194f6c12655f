"""The forward map: charges for many presses from a few solves.

Presses of one probe form a family in distance from the centre and force; the angle is a turn. The stress at the nodes
of the template is a smooth function of both, so it is solved on Chebyshev nodes and interpolated as a field, and the
charge is integrated from the interpolated field for every press anew: exact about the place of the electrode, with the
probe on it included. How well it does is measured against direct solves when it is built.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isocharge.errors import SceneError, SolveError
from isocharge.simulate.arrays import Array, Complexes
from isocharge.simulate.charge import COARSE, FINE, NEAR, ReadoutPoints, touch_charge
from isocharge.simulate.equilibrium import (
    Equilibrium,
    amplitude_squared,
    bending_share,
    check_scene,
    press,
    resolution_for,
    single_threaded_blas,
    turn_stress,
)
from isocharge.simulate.membrane import film_gradient, strain, stress
from isocharge.simulate.probe import Circle
from isocharge.simulate.sensor import Film, Sensor
from isocharge.simulate.spectral import barycentric_weights, chebyshev_nodes, lagrange_values, lobatto_nodes
from isocharge.simulate.template import Placement, Resolution, template

Progress = Callable[[int, int], None]
"""Called with (done, total)."""

CHUNK = 256
"""Presses evaluated at once: keeps the working arrays within some 100 MB."""

INTERPOLATION_ERROR = 5e-4
"""Largest relative error of any charge against direct solves that a forward map may have."""

CHECKS = 10
"""Direct solves that a forward map is compared with."""

TOO_THICK = 0.05
"""Share of bending above which a membrane's charges are not worth a dataset."""


@dataclass(frozen=True)
class Nodes:
    """Where a family is solved.

    Attributes:
        distance: Distances from the centre, shape (n_distance,), m.
        force: Forces, shape (n_force,), N; Chebyshev in the logarithm.
    """

    distance: Array
    force: Array

    @classmethod
    def spread(cls, radius: float, force_range: tuple[float, float], count: tuple[int, int]) -> "Nodes":
        """Chebyshev nodes for distances up to `radius`."""
        low, high = np.log(force_range)
        force = np.exp(chebyshev_nodes(count[1], low, high)) if high > low else np.array([force_range[0]])
        return cls(chebyshev_nodes(count[0], 0.0, radius), force)

    def weights(self, distance: Array, force: Array) -> Array:
        """Interpolation weights for presses, shape (n, n_distance * n_force)."""
        by_distance = lagrange_values(self.distance, barycentric_weights(self.distance), distance)
        logs = np.log(self.force)
        by_force = lagrange_values(logs, barycentric_weights(logs), np.log(force))
        weights: Array = (by_distance[:, :, None] * by_force[:, None, :]).reshape(distance.size, -1)
        return weights


@dataclass(frozen=True)
class ForwardMap:
    """Touch charges of a sensor under one probe as a function of (x, y, F).

    Attributes:
        sensor: The sensor.
        probe: The footprint.
        radius: Presses up to this distance from the centre are covered, m.
        force_range: Smallest and largest force covered, N.
        resolution: Mesh of the solves.
        nodes: Where it was solved.
        table: Scaled stress C : E' at the nodes of every element, shape (n_solve, n_element * n_local, 3).
        error: Largest relative error of a charge against the direct solves that the build compared with.
    """

    sensor: Sensor
    probe: Circle
    radius: float
    force_range: tuple[float, float]
    resolution: Resolution
    nodes: Nodes
    table: Array
    error: float

    @classmethod
    def build(
        cls,
        sensor: Sensor,
        probe: Circle,
        radius: float = 8e-3,
        force_range: tuple[float, float] = (0.05, 2.0),
        *,
        resolution: Resolution | None = None,
        executor: Executor | None = None,
        progress: Progress | None = None,
    ) -> "ForwardMap":
        """Solve a family and check it.

        Args:
            sensor: The sensor.
            probe: The footprint.
            radius: Largest distance of a press from the centre, m.
            force_range: Smallest and largest force, N.
            resolution: Mesh; the coarsest that carries the outermost press well if absent.
            executor: Where the solves run; here and now if absent. The result does not depend on it.
            progress: Told how many solves are done.

        Raises:
            SceneError: If some presses cannot exist or the film is too thick for a membrane.
            SolveError: If an equilibrium or the wanted interpolation error was not reached.
        """
        _check_family(sensor.film, probe, radius, force_range)
        resolution = resolution or resolution_for(sensor.film, probe, (radius, 0.0))
        error = np.inf
        for count in ((8, 3), (11, 5), (15, 8)):
            nodes = Nodes.spread(radius, force_range, count)
            table = _solve_family(sensor.film, probe, nodes, resolution, executor, progress)
            made = cls(sensor, probe, radius, force_range, resolution, nodes, table, error)
            error = _check_against_solves(made)
            if error <= INTERPOLATION_ERROR:
                return cls(sensor, probe, radius, force_range, resolution, nodes, table, error)
        raise SolveError(
            f"the forward map of {sensor.name} up to {radius * 1e3:g} mm and {force_range[1]:g} N interpolates to "
            f"{error:.2g} only, expected {INTERPOLATION_ERROR:g}; ask for a smaller radius or range of forces"
        )

    def forward(self, x: Array, y: Array, force: Array) -> Array:
        """Touch charges.

        Args:
            x: Positions, shape (n,), m.
            y: Positions, shape (n,), m.
            force: Forces, shape (n,), N; where zero the film is untouched and the charges are zero.

        Returns:
            Shape (n, n_electrode), C.

        Raises:
            SceneError: If a press lies outside the covered radius or forces.
        """
        x, y, force = np.broadcast_arrays(*(np.asarray(value, dtype=float) for value in (x, y, force)))
        touched = np.flatnonzero(force != 0.0)
        self._check_inside(x[touched], y[touched], force[touched])
        charge = np.zeros((x.size, len(self.sensor.electrodes)))
        with single_threaded_blas():
            for start in range(0, touched.size, CHUNK):
                chunk = touched[start : start + CHUNK]
                charge[chunk] = self._charges(x[chunk] + 1j * y[chunk], force[chunk])
        return charge

    def _check_inside(self, x: Array, y: Array, force: Array) -> None:
        distance, slack = np.hypot(x, y), 1.0 + 1e-9
        low, high = self.force_range
        wrong = ~((distance <= self.radius * slack) & (force >= low / slack) & (force <= high * slack))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise SceneError(
                f"press {i} at ({x[i] * 1e3:.4g}, {y[i] * 1e3:.4g}) mm with {force[i]:.4g} N is outside the forward "
                f"map: expected at most {self.radius * 1e3:g} mm from the centre and {low:g} to {high:g} N"
            )

    def _charges(self, at: Complexes, force: Array) -> Array:
        """Charges of one chunk of presses, shape (n, n_electrode)."""
        field = self.nodes.weights(np.abs(at), force) @ self.table.reshape(len(self.table), -1)
        charge = np.empty((at.size, len(self.sensor.electrodes)))
        near, (fine, coarse) = self._near(at), self._readouts
        for readout, chosen in ((fine, near), (coarse, ~near)):
            press_index, electrode = np.nonzero(chosen)
            charge[press_index, electrode] = self._read(readout, field, at, press_index, electrode)
        scale = self.sensor.film.young * amplitude_squared(self.sensor.film, force)
        scaled: Array = charge * scale[:, None]
        return scaled

    @cached_property
    def _readouts(self) -> tuple[ReadoutPoints, ReadoutPoints]:
        """The fine and the coarse rule for the charges."""
        return ReadoutPoints.of(self.sensor, FINE), ReadoutPoints.of(self.sensor, COARSE)

    def _near(self, at: Complexes) -> np.ndarray:
        """Which electrodes need the fine rule for which presses, shape (n, n_electrode)."""
        corners = [self.sensor.calibration.place(np.array(e.corners)) for e in self.sensor.electrodes]
        centre = np.array([c.mean(axis=0) @ [1.0, 1j] for c in corners])
        reach = np.array([np.linalg.norm(c - c.mean(axis=0), axis=1).max() for c in corners])
        near: np.ndarray = np.abs(at[:, None] - centre) < reach + self.probe.radius + NEAR
        return near

    def _read(
        self,
        readout: ReadoutPoints,
        field: Array,
        at: Complexes,
        press_index: np.ndarray,
        electrode: np.ndarray,
    ) -> Array:
        """Scaled charges of pairs of press and electrode, shape (n_pair,)."""
        mesh, angle = template(self.resolution), np.angle(at[press_index])
        points = readout.points[electrode] @ np.array([1.0, 1j]) / self.sensor.film.radius
        turned = points * np.exp(-1j * angle)[:, None]
        placement = Placement.of_circle(
            np.abs(at[press_index])[:, None] / self.sensor.film.radius,
            self.probe.radius / self.sensor.film.radius,
        )
        z = placement.to_template(turned)
        element, xi, eta = mesh.locate(z.ravel(), np.broadcast_to(placement.rho, z.shape).ravel())
        values, _ = mesh.basis_at(xi, eta)
        nodal = field.reshape(len(field), mesh.n_element, -1, 3)[np.repeat(press_index, z.shape[1]), element]
        local = np.matmul(values[:, None, :], nodal).reshape(*z.shape, 3)
        stress_there = turn_stress(local, angle[:, None])
        charge: Array = np.einsum("kpc,kpc->k", stress_there, readout.weights[electrode])
        return charge


def _check_family(film: Film, probe: Circle, radius: float, force_range: tuple[float, float]) -> None:
    low, high = force_range
    if not (0.0 < low <= high and np.isfinite(high)):
        raise SceneError(f"force range: expected 0 < MIN <= MAX in N, got {low} to {high}")
    if not (np.isfinite(radius) and radius > 0.0):
        raise SceneError(f"radius: expected a positive number, got {radius * 1e3} mm")
    check_scene(film, probe, (radius, 0.0), high)
    share = bending_share(film, amplitude_squared(film, low))
    if share > TOO_THICK:
        raise SceneError(
            f"a film of {film.thickness * 1e6:g} um at {low:g} N carries about {share:.0%} of its load by bending, "
            f"which this version does not model: expected at most {TOO_THICK:.0%}; use a thinner film or larger forces"
        )


def _solve_family(
    film: Film,
    probe: Circle,
    nodes: Nodes,
    resolution: Resolution,
    executor: Executor | None,
    progress: Progress | None,
) -> Array:
    """Scaled nodal stress of every solve, shape (n_distance * n_force, n_element * n_local, 3)."""
    jobs = [(film, probe, float(distance), nodes.force, resolution) for distance in nodes.distance]
    results: Iterable[Array] = executor.map(_solve_chain, jobs) if executor else map(_solve_chain, jobs)
    return np.concatenate(list(_report(results, len(jobs), progress)))


def _report(results: Iterable[Array], total: int, progress: Progress | None) -> Iterator[Array]:
    for done, result in enumerate(results, start=1):
        if progress:
            progress(done, total)
        yield result


def _solve_chain(job: tuple[Film, Circle, float, Array, Resolution]) -> Array:
    """One distance, all forces, each solve started from the one before; shape (n_force, n_element * n_local, 3)."""
    film, probe, distance, forces, resolution = job
    start: Equilibrium | None = None
    rows = []
    for force in forces:
        start = press(film, probe, (distance, 0.0), float(force), resolution=resolution, start=start)
        rows.append(nodal_stress(start).reshape(-1, 3))
    return np.stack(rows)


def nodal_stress(equilibrium: Equilibrium) -> Array:
    """Scaled stress C : E' at the nodes of every element, (n_element, n_local, 3), the press turned onto the x axis."""
    mesh, placement = template(equilibrium.resolution), equilibrium.placement
    line = lobatto_nodes(equilibrium.resolution.order)
    xi, eta = np.meshgrid(line, line)
    _, by_local = mesh.basis_at(xi.ravel(), eta.ravel())
    gradient, _ = film_gradient(by_local[:, None], placement.to_film(mesh.element_points(placement.rho)))
    slope = np.einsum("epan,eni->epai", gradient, equilibrium.field[mesh.nodes])
    return stress(strain(slope, equilibrium.groups.amplitude2), equilibrium.groups.poisson)


def _check_against_solves(made: ForwardMap) -> float:
    """Largest relative error of a charge over presses between the nodes and at the edge of the family."""
    shares = np.sqrt(chebyshev_nodes(CHECKS - 1, 0.0, 1.0))
    low, high = np.log(made.force_range)
    errors = []
    for number, share in enumerate([*shares, 1.0]):
        angle, force = 2.4 * number, float(np.exp(low + (high - low) * ((0.5 + 0.618 * number) % 1.0)))
        force = min(max(force, made.force_range[0]), made.force_range[1])
        x, y = made.radius * share * np.cos(angle), made.radius * share * np.sin(angle)
        solved = press(made.sensor.film, made.probe, (x, y), force, resolution=made.resolution)
        direct = touch_charge(made.sensor, solved)
        mapped = made.forward(np.array([x]), np.array([y]), np.array([force]))[0]
        errors.append(np.abs(mapped / direct - 1.0).max())
    return float(np.max(errors))
