"""Condensation and sparse solve against dense algebra."""

import numpy as np
import pytest

from isocharge.simulate import Resolution
from isocharge.simulate.assembly import Assembly, assembly
from isocharge.simulate.membrane import Geometry, Groups, Membrane
from isocharge.simulate.template import Template, template

SMALL = (Resolution(2, 8, 1), Resolution(3, 8, 2), Resolution(4, 12, 1))


def assembled(mesh: Template, matrix: np.ndarray) -> np.ndarray:
    """The whole matrix, entry by entry, no cleverness."""
    unknown = (3 * mesh.nodes[..., None] + np.arange(3)).reshape(mesh.n_element, -1)
    size = unknown.shape[1]
    dense = np.zeros((3 * mesh.n_node, 3 * mesh.n_node))
    for numbers, block in zip(unknown, matrix.reshape(mesh.n_element, size, size), strict=True):
        dense[np.ix_(numbers, numbers)] += block
    return dense


def dense_solution(mesh: Template, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """numpy.linalg.solve on the unknowns that are not on the rim."""
    free = 3 * mesh.n_free
    solution = np.zeros(3 * mesh.n_node)
    solution[:free] = np.linalg.solve(assembled(mesh, matrix)[:free, :free], right.ravel()[:free])
    return solution.reshape(-1, 3)


def random_matrices(mesh: Template, seed: int) -> np.ndarray:
    """Symmetric, positive definite, full: every component coupled to every other."""
    size = 3 * mesh.nodes.shape[1]
    root = np.random.default_rng(seed).standard_normal((mesh.n_element, size, size))
    matrix = root @ root.transpose(0, 2, 1) + size * np.eye(size)
    return matrix.reshape(mesh.n_element, size // 3, 3, size // 3, 3)


@pytest.mark.parametrize("resolution", SMALL, ids=str)
@pytest.mark.parametrize("seed", range(2))
def test_solution_is_the_dense_one(resolution, seed):
    mesh = template(resolution)
    matrix, right = random_matrices(mesh, seed), np.random.default_rng(seed).standard_normal((mesh.n_node, 3))
    solution = Assembly(mesh).solve(matrix, right)
    np.testing.assert_allclose(solution, dense_solution(mesh, matrix, right), atol=1e-12)
    assert not solution[mesh.n_free :].any()


def test_tangent_of_a_membrane_is_solved_like_the_dense_one(coarse, off_centre, random_field):
    """Badly scaled and only just definite: in-plane and transverse stiffness of a tensioned film."""
    membrane = Membrane(Geometry.build(coarse, off_centre), Groups(0.01, 1.0, 5.0, 0.34))
    field = 0.1 * random_field(coarse, 1)
    matrix, right = membrane.tangent(field), -membrane.residual(field)
    expected = dense_solution(coarse, matrix, right)
    error = np.abs(assembly(coarse.resolution).solve(matrix, right) - expected).max()
    assert error < 1e-9 * np.abs(expected).max()


def test_right_hand_side_is_left_alone(coarse):
    right = np.ones((coarse.n_node, 3))
    assembly(coarse.resolution).solve(random_matrices(coarse, 0), right)
    assert np.all(right == 1.0)


def test_rim_values_of_the_right_hand_side_are_ignored(coarse):
    matrix, right = random_matrices(coarse, 0), np.random.default_rng(0).standard_normal((coarse.n_node, 3))
    first = assembly(coarse.resolution).solve(matrix, right)
    right[coarse.n_free :] = 1e6
    np.testing.assert_array_equal(assembly(coarse.resolution).solve(matrix, right), first)


def test_condensation_shrinks_the_system():
    """What the module's docstring says of order 4."""
    mesh = template(Resolution(4, 8, 6))
    assert 3 * mesh.n_free / Assembly(mesh).n_skeleton == pytest.approx(2.3, abs=0.05)
