"""Fixtures that the tests of the simulator share: films, meshes, random fields, equilibria and forward maps."""

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
    Sweep,
    Theory,
    load_sensor,
)
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.simulate.forward.derivative_maps import SideForceMap
from isocharge.simulate.mechanics.theory import DimensionlessGroups
from isocharge.simulate.mesh.placed_mesh import Geometry, place
from isocharge.simulate.mesh.template import Template
from kept import kept

TURNED = Polygon.rectangle(4.0, 2.0, 0.3)
FULL = Theory(bending=True)


# Films and discrete problems


@pytest.fixture(scope="session")
def film() -> Film:
    """The film of the built-in sensors."""
    return load_sensor("three-25um-biaxial").film


@dataclass(frozen=True)
class Mesh:
    """A template that is placed on a film of unit radius."""

    template: Template
    geometry: Geometry

    def random_field(self, seed: int, components: int = 3) -> np.ndarray:
        """Return independent random values at the nodes, shape (n_node, components).

        Components that the boundary conditions fix on the rim and on the axis are zero.
        """
        field = 0.1 * np.random.default_rng(seed).standard_normal((self.template.n_node, components))
        field[self.template.on_rim, :3] = 0.0
        field[self.template.on_axis, 1:2] = 0.0
        return field


PROBES = {
    "circle": Circle(0.11),
    "triangle": Polygon.triangle(0.2, 0.4),
    "rectangle": Polygon.rectangle(0.2, 0.1, 0.7),
    "pentagon": Polygon.of(0.1 * np.array([(1.0, 0.0), (0.3, 1.0), (-0.8, 0.6), (-0.9, -0.5), (0.2, -0.8)]), angle=0.2),
}


@pytest.fixture(scope="session", params=PROBES.values(), ids=PROBES.keys())
def mesh(request: pytest.FixtureRequest) -> Mesh:
    """A small mesh for each kind of template, with thin rings at the rim and a probe away from the centre."""
    placed = place(Film(1.0, 1e-3, 1.0, 0.3), request.param, (0.4, 0.0), Resolution(3, 8, 2, 1), 0.05)
    return Mesh(placed.template, placed.geometry)


def assembled(mesh: Template, matrix: np.ndarray) -> np.ndarray:
    """Return the dense matrix of the mesh, which is the sum of the matrices of its elements."""
    components = matrix.shape[2]
    unknowns = (components * mesh.nodes[..., None] + np.arange(components)).reshape(mesh.n_element, -1)
    element_matrices = matrix.reshape(mesh.n_element, unknowns.shape[1], -1)
    dense = np.zeros((components * mesh.n_node, components * mesh.n_node))
    for element_unknowns, element_matrix in zip(unknowns, element_matrices, strict=True):
        dense[np.ix_(element_unknowns, element_unknowns)] += element_matrix
    return dense


@pytest.fixture(scope="session")
def made_up() -> Callable[..., Equilibrium]:
    """Function that returns an equilibrium with a given displacement field, without a solve.

    Its argument `field` is a function of points (X1, X2), shape (n, 2), in film radii in the frame of the press. It
    returns the displacements (U1, U2, W), shape (n, 3). The default probe is a rectangle, because a field under a
    polygon need not be symmetric.
    """

    def make(
        field: Callable[[np.ndarray], np.ndarray],
        at: tuple[float, float] = (0.0, 0.0),
        *,
        squared_amplitude: float = 0.1,
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
            groups=DimensionlessGroups(squared_amplitude, 1.0, 0.0, 0.0, of.poisson),
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
    """Forward map of the sensor three-25um-biaxial."""
    return kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0))


@pytest.fixture(scope="session")
def taut_map() -> ForwardMap:
    """Forward map of a film of 0.8 MPa with four electrodes, up to 8 mm and from 0.2 to 1 N.

    The solution does not depend on the electrodes, so a test may replace the sensor by one with the same film.
    """
    sensor = load_sensor("four-25um-biaxial")
    return kept(
        ForwardMap.build, replace(sensor, film=replace(sensor.film, pretension=0.8)), Circle(1.0), 8.0, (0.2, 1.0)
    )


@pytest.fixture(scope="session")
def side_force_map(taut_map: ForwardMap) -> SideForceMap:
    """Derivatives of the charges of `taut_map` with respect to side forces."""
    return kept(SideForceMap.build, taut_map)


@pytest.fixture(scope="session")
def small_dataset(three_map: ForwardMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 500 samples. Tests must not change it."""
    return write_sweep(tmp_path_factory.mktemp("data") / "presses", (three_map,), Sweep(samples=500, seed=7))
