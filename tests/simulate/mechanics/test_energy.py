"""Energy, force and tangent agree, with stretching, bending and both, on every template.

The energy is a polynomial of degree four in the nodal values. Finite differences with five points are therefore exact
except for round-off.
"""

import numpy as np
import pytest

from isocharge.simulate import Circle, Film, Polygon, Resolution
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.theory import DimensionlessGroups, elasticity
from isocharge.simulate.mesh.placed_mesh import place
from solved_charges import relative_error


def isotropic(poisson: float) -> np.ndarray:
    """Return the elasticity matrix of an isotropic film with the given Poisson's ratio."""
    return elasticity(Film(1.0, 1e-3, 1.0, poisson), angle=0.3)


GROUPS = {
    "membrane": (0.02, 1.0, 0.0, 0.0, 0.34),
    "taut membrane": (0.7, 2.0, 0.6, 0.0, 0.0),
    "von Karman": (0.0, 1.0, 0.0, 0.02, 0.34),
    "plate": (1e-4, 1.0, 0.0, 5.0, 0.49),
    "taut plate": (0.3, 1.0, 0.4, 0.1, 0.3),
}
"""Squared amplitude, load, tension and bending stiffness of dimensionless groups, and Poisson's ratio."""

STENCIL = ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12))


PROBES = {
    "circle": Circle(0.11),
    "triangle": Polygon.triangle(0.2, 0.4),
    "rectangle": Polygon.rectangle(0.2, 0.1, 0.7),
    "pentagon": Polygon.of(0.1 * np.array([(1.0, 0.0), (0.3, 1.0), (-0.8, 0.6), (-0.9, -0.5), (0.2, -0.8)]), angle=0.2),
}


@pytest.fixture(scope="module", params=PROBES.values(), ids=PROBES)
def mesh(request):
    """A small mesh for each kind of template, with thin rings at the rim and a probe away from the centre."""
    return place(Film(1.0, 1e-3, 1.0, 0.3), request.param, (0.4, 0.0), Resolution(3, 8, 2, 1), 0.05)


def random_field(mesh, seed: int) -> np.ndarray:
    """Return independent random values at the nodes, shape (n_node, 3).

    Components that the boundary conditions fix on the rim and on the axis are zero.
    """
    field = 0.1 * np.random.default_rng(seed).standard_normal((mesh.template.n_node, 3))
    field[mesh.template.on_rim] = 0.0
    field[mesh.template.on_axis, 1] = 0.0
    return field


@pytest.fixture(params=GROUPS.values(), ids=GROUPS)
def elastic(request, mesh) -> ElasticFilm:
    *groups, poisson = request.param
    return ElasticFilm(mesh, DimensionlessGroups(*groups, isotropic(poisson), np.zeros(3), (0.0, 0.0), 0.0, 0.0, 0.0))


def condensed(template, matrices: np.ndarray) -> np.ndarray:
    """Return the dense matrix for (U1, U2, W), shape (3 n_node, 3 n_node).

    The matrix is the sum of those of the elements. The fourth unknown, the Laplacian of W, is eliminated by a Schur
    complement.
    """
    components = range(matrices.shape[1])
    whole = np.zeros((template.n_node, len(components)) * 2)
    for nodes, matrix in zip(template.nodes, matrices, strict=True):
        whole[np.ix_(nodes, components, nodes, components)] += matrix.transpose(1, 0, 3, 2)
    size = 3 * template.n_node
    first = whole[:, :3, :, :3].reshape(size, size)
    if len(components) == 3:
        return first
    coupling = whole[:, 3, :, :3].reshape(-1, size)
    return first - coupling.T @ np.linalg.solve(whole[:, 3, :, 3], coupling)


def test_residual_is_the_gradient_of_the_energy(elastic, mesh):
    field = random_field(mesh, 0)
    direction = random_field(mesh, 100)
    slope = sum(share * elastic.energy(field + step * direction) for step, share in STENCIL)
    scale = sum(abs(share * elastic.energy(field + step * direction)) for step, share in STENCIL)
    assert np.sum(elastic.residual(field) * direction) == pytest.approx(slope, abs=1e-12 * scale)


def test_tangent_is_the_derivative_of_the_residual(elastic, mesh):
    """With bending, the derivative is that of the matrix in which the fourth unknown is condensed."""
    field = random_field(mesh, 0)
    direction = random_field(mesh, 100)
    slope = sum(share * elastic.residual(field + step * direction) for step, share in STENCIL)
    tangent = elastic.tangent(field)
    assert relative_error(tangent.transpose(0, 3, 4, 1, 2), tangent) <= 1e-12
    product = condensed(mesh.template, tangent) @ direction.ravel()
    assert relative_error(product.reshape(-1, 3), slope) <= 1e-9


@pytest.mark.parametrize("poisson", [0.0, 0.34, 0.49])
def test_stress_solves_the_plane_stress_compliance(poisson):
    """Hooke's law returns the strain for a stress and Young's modulus 1."""
    strain = np.array([0.3, -0.2, 0.5])
    s11, s22, s12 = strain @ isotropic(poisson)
    np.testing.assert_allclose([s11 - poisson * s22, s22 - poisson * s11, 2 * (1 + poisson) * s12], strain)
