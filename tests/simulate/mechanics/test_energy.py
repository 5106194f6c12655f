"""Energy, force and tangent agree, with stretching, bending and both, on every template.

The energy is a polynomial of degree four in the nodal values. Finite differences with five points are therefore exact
except for round-off.
"""

import numpy as np
import pytest
from tests.simulate.conftest import assembled

from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.theory import DimensionlessGroups, stress

GROUPS = {
    "membrane": DimensionlessGroups(squared_amplitude=0.02, load=1.0, tension=0.0, bending=0.0, poisson=0.34),
    "taut membrane": DimensionlessGroups(squared_amplitude=0.7, load=2.0, tension=0.6, bending=0.0, poisson=0.0),
    "von Karman": DimensionlessGroups(squared_amplitude=0.0, load=1.0, tension=0.0, bending=0.02, poisson=0.34),
    "plate": DimensionlessGroups(squared_amplitude=1e-4, load=1.0, tension=0.0, bending=5.0, poisson=0.49),
    "taut plate": DimensionlessGroups(squared_amplitude=0.3, load=1.0, tension=0.4, bending=0.1, poisson=0.3),
}
STENCIL = ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12))


@pytest.fixture(params=GROUPS.values(), ids=GROUPS.keys())
def elastic(request, mesh) -> ElasticFilm:
    return ElasticFilm(mesh.geometry, request.param)


def condensed(mesh, matrix: np.ndarray) -> np.ndarray:
    """Return the dense matrix for (U1, U2, W), shape (3 n_node, 3 n_node).

    The fourth unknown, the Laplacian of W, is eliminated by a Schur complement.
    """
    n_node = mesh.template.n_node
    size = 3 * mesh.template.n_node
    whole = assembled(mesh.template, matrix).reshape(n_node, -1, n_node, matrix.shape[2])
    first = whole[:, :3, :, :3].reshape(size, size)
    if matrix.shape[2] == 3:
        return first
    coupling = whole[:, 3, :, :3].reshape(-1, size)
    return first - coupling.T @ np.linalg.solve(whole[:, 3, :, 3], coupling)


def test_residual_is_the_gradient_of_the_energy(elastic, mesh):
    field = mesh.random_field(0)
    direction = mesh.random_field(100)
    slope = sum(share * elastic.energy(field + step * direction) for step, share in STENCIL)
    scale = sum(abs(share * elastic.energy(field + step * direction)) for step, share in STENCIL)
    assert np.sum(elastic.residual(field) * direction) == pytest.approx(slope, abs=1e-12 * scale)


def test_tangent_is_the_derivative_of_the_residual(elastic, mesh):
    """With bending, the derivative is that of the matrix in which the fourth unknown is condensed."""
    field = mesh.random_field(0)
    direction = mesh.random_field(100)
    slope = sum(share * elastic.residual(field + step * direction) for step, share in STENCIL)
    tangent = elastic.tangent(field)
    np.testing.assert_allclose(tangent, tangent.transpose(0, 3, 4, 1, 2), atol=1e-12 * np.abs(tangent).max())
    product = condensed(mesh, tangent) @ direction.ravel()
    np.testing.assert_allclose(product.reshape(-1, 3), slope, atol=1e-9 * np.abs(slope).max())


@pytest.mark.parametrize("poisson", [0.0, 0.34, 0.49])
def test_stress_solves_the_plane_stress_compliance(poisson):
    """Hooke's law returns the strain for a stress and Young's modulus 1."""
    strain = np.array([0.3, -0.2, 0.5])
    s11, s22, s12 = stress(strain, poisson)
    np.testing.assert_allclose([s11 - poisson * s22, s22 - poisson * s11, 2 * (1 + poisson) * s12], strain)
