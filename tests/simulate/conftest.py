"""What the simulator's tests share: films, meshes, random fields, forward maps."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    Equilibrium,
    Film,
    ForwardMap,
    Polygon,
    Probe,
    Resolution,
    Sensor,
    Sweep,
    Theory,
    load_sensor,
)
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.simulate.forward.side_force import SideForceMap
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mesh.placed_mesh import Geometry, place
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import Template
from kept import kept

TURNED = Polygon.rectangle(4.0, 2.0, 0.3)
FULL = Theory(stretching=True, bending=True, pretensioned=False)


# Films and discrete problems


@pytest.fixture(scope="session")
def film() -> Film:
    """The film of the built-in sensors."""
    return load_sensor("three-25um-biaxial").film


@dataclass(frozen=True)
class Mesh:
    """A template in its place on a film of unit radius."""

    template: Template
    placement: Placement
    geometry: Geometry
    points: np.ndarray
    """(X1, X2) of the nodes, shape (n_node, 2)."""

    @property
    def inside(self) -> np.ndarray:
        """Which nodes are not on the rim, shape (n_node,)."""
        return ~self.template.on_rim

    def random_field(self, seed: int, components: int = 3) -> np.ndarray:
        """Random nodal values, fixed where the film is: as rough as the mesh can carry, shape (n_node, components)."""
        field = 0.1 * np.random.default_rng(seed).standard_normal((self.template.n_node, components))
        field[self.template.on_rim, :3] = 0.0
        field[self.template.on_axis, 1:2] = 0.0
        return field


def _mesh(probe: Probe, at: tuple[float, float], resolution: Resolution) -> Mesh:
    mesh = place(Film(1.0, 1e-3, 1.0, 0.3), probe, at, resolution, 0.05)
    points = np.stack([mesh.node_points.real, mesh.node_points.imag], axis=1)
    return Mesh(mesh.template, mesh.placement, mesh.geometry, points)


@pytest.fixture(scope="session")
def mesh_of() -> Callable[[Probe, tuple[float, float], Resolution], Mesh]:
    """A mesh for a probe, its position (film radii) and a resolution."""
    return _mesh


PROBES = {
    "circle": Circle(0.11),
    "triangle": Polygon.triangle(0.2, 0.4),
    "rectangle": Polygon.rectangle(0.2, 0.1, 0.7),
    "pentagon": Polygon.of(0.1 * np.array([(1.0, 0.0), (0.3, 1.0), (-0.8, 0.6), (-0.9, -0.5), (0.2, -0.8)]), angle=0.2),
}


@pytest.fixture(scope="session", params=PROBES.values(), ids=PROBES.keys())
def mesh(request: pytest.FixtureRequest) -> Mesh:
    """A small mesh far from any symmetry, with thin rings at the rim, for every kind of template."""
    return _mesh(request.param, (0.4, 0.0), Resolution(3, 8, 2, 1))


def assembled(mesh: Template, matrix: np.ndarray) -> np.ndarray:
    """The whole matrix, entry by entry, no cleverness."""
    components = matrix.shape[2]
    unknown = (components * mesh.nodes[..., None] + np.arange(components)).reshape(mesh.n_element, -1)
    dense = np.zeros((components * mesh.n_node, components * mesh.n_node))
    for numbers, block in zip(unknown, matrix.reshape(mesh.n_element, unknown.shape[1], -1), strict=True):
        dense[np.ix_(numbers, numbers)] += block
    return dense


@pytest.fixture(scope="session")
def made_up() -> Callable[..., Equilibrium]:
    """A made-up equilibrium with a given field.

    `field` is a function of (X1, X2), shape (n, 2), in the frame of the press and in film radii, that returns
    (U1, U2, W), shape (n, 3); polygonal probes have no symmetry to keep.
    """

    def make(
        field: Callable[[np.ndarray], np.ndarray],
        at: tuple[float, float] = (0.0, 0.0),
        *,
        amplitude2: float = 0.1,
        of: Film | None = None,
        probe: Probe = TURNED,
        theory: Theory = FULL,
        order: int = 5,
    ) -> Equilibrium:
        of = of or load_sensor("three-25um-biaxial").film
        mesh = place(of, probe, at, Resolution(order, 8, 5, 1), 0.05)
        return Equilibrium(
            film=of,
            probe=probe,
            at=at,
            force=1.0,
            theory=theory,
            mesh=mesh,
            field=field(np.stack([mesh.node_points.real, mesh.node_points.imag], axis=1)),
            groups=DimensionlessGroups(amplitude2, 1.0, 0.0, 0.0, of.poisson),
            status="converged",
            message="made up",
            iterations=0,
            residual=0.0,
            seconds=0.0,
        )

    return make


# Forward maps and datasets


@pytest.fixture(scope="session")
def three_map() -> ForwardMap:
    """The forward map of the released model's sensor."""
    return kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0))


@pytest.fixture(scope="session")
def side_force_map() -> SideForceMap:
    """Derivatives of the charges for side forces on a film of 0.8 MPa with four electrodes."""
    sensor = load_sensor("four-25um-biaxial")
    return kept(solve_side_forces, replace(sensor, film=replace(sensor.film, pretension=0.8)))


def solve_side_forces(sensor: Sensor) -> SideForceMap:
    return SideForceMap.build(ForwardMap.build(sensor, Circle(1.0), 8.0, (0.1, 1.0)))


@pytest.fixture(scope="session")
def small_dataset(three_map: ForwardMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 500 samples; not to be written to."""
    return write_sweep(tmp_path_factory.mktemp("data") / "presses", (three_map,), Sweep(samples=500, seed=7))
