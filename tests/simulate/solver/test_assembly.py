"""Static condensation and sparse solve, compared with a dense solve."""

import numpy as np
import pytest
from tests.simulate.conftest import assembled

from isocharge.simulate import Circle, Ellipse, Polygon, Resolution
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mesh.template import Template
from isocharge.simulate.solver.assembly import Assembly

SMALL = (
    (Resolution(2, 8, 1), Circle(1.0)),
    (Resolution(3, 8, 2, 1), Circle(1.0)),
    (Resolution(3, 8, 1), Polygon.triangle(3.0)),
    (Resolution(2, 8, 1, 2), Polygon.rectangle(4.0, 2.0)),
    (Resolution(2, 8, 1), Ellipse(4.0, 2.0)),
)


def dense_solution(mesh: Template, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve with numpy. The displacements (U1, U2, W) are fixed on the rim, and U2 also on the line of symmetry."""
    components = matrix.shape[2]
    free = np.ones((mesh.n_node, components), dtype=bool)
    free[mesh.on_rim, :3] = False
    free[mesh.on_axis, 1] = False
    keep = np.flatnonzero(free)
    padded = np.pad(right, ((0, 0), (0, components - 3))).ravel()
    solution = np.zeros(free.size)
    solution[keep] = np.linalg.solve(assembled(mesh, matrix)[np.ix_(keep, keep)], padded[keep])
    return solution.reshape(-1, components)[:, :3]


@pytest.mark.parametrize("bending", [0.0, 1e-7, 1e-3, 10.0])
def test_sparse_solution_with_the_tangent_of_a_film_equals_dense_solution(mesh, bending):
    """The matrix is badly scaled and, with bending, indefinite. It is factorised without pivoting."""
    elastic = ElasticFilm(mesh.geometry, DimensionlessGroups(0.01, 1.0, 5.0 if bending == 0.0 else 0.0, bending, 0.34))
    field = 0.01 * mesh.random_field(1)
    matrix = elastic.tangent(field, 0.0 if bending == 0.0 else 1.0)
    right = -elastic.residual(field)
    solution = Assembly(mesh.template, elastic.unknowns_per_node).factor(matrix).solve(right)
    expected = dense_solution(mesh.template, matrix, right)
    np.testing.assert_allclose(solution, expected, atol=1e-8 * np.abs(expected).max())
