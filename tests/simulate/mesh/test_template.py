"""The mesh's topology: what Euler and counting know of it."""

import numpy as np
import pytest

from isocharge.simulate import Film, Polygon, Resolution
from isocharge.simulate.mesh.placed_mesh import place
from isocharge.simulate.mesh.refinement import RefinedTemplate
from isocharge.simulate.mesh.template import Template, template

FILM = Film(45.0, 0.025, 3000.0, 0.34)
RESOLUTIONS = (Resolution(2, 8, 1), Resolution(4, 16, 3, 2))
CORNERS = (0, 3, 5)


@pytest.fixture(params=RESOLUTIONS, ids=str)
def resolution(request) -> Resolution:
    return request.param


@pytest.fixture(params=CORNERS, ids=lambda corners: f"{corners} corners" if corners else "circle")
def built(request, resolution) -> Template:
    return template(resolution, request.param)


@pytest.mark.parametrize("wrong", [(1, 8, 4, 0), (4, 3, 4, 0), (4, 8, 0, 0), (4, 8, 4, -1)])
def test_impossible_resolution_is_refused(wrong):
    with pytest.raises(ValueError, match=f"got {wrong[0]}, {wrong[1]}, {wrong[2]}, {wrong[3]}"):
        Resolution(*wrong)


def edges_of(mesh: Template) -> list[frozenset]:
    n = mesh.resolution.order
    corner = mesh.nodes[:, [0, n, (n + 1) ** 2 - 1, n * (n + 1)]]
    return [frozenset(pair) for quad in corner.tolist() for pair in zip(quad, quad[1:] + quad[:1], strict=True)]


def test_euler_characteristic_of_a_disk(built):
    """Vertices - edges + faces = 1, counted from the numbers that the corners of the elements got."""
    edges = set(edges_of(built))
    assert len(set().union(*edges)) - len(edges) + built.n_element == 1


def test_a_rotation_by_a_corner_puts_elements_in_the_place_of_others(resolution):
    """Of a triangle in the middle of the film: their nodes lie a third of a turn on."""
    mesh = place(FILM, Polygon.triangle(4.0), (0.0, 0.0), resolution, 0.1)
    for fold in range(3):
        there = mesh.points[mesh.template.rotated(fold, 3)] * np.exp(-2j * np.pi * fold / 3)
        np.testing.assert_allclose(there, mesh.points, atol=1e-12)


def test_points_lie_in_the_parts_of_a_split_element():
    """Quarters of the first, one of them halved across xi; a part's coordinates lead back to the point."""
    base = template(Resolution(2, 8, 1), 3)
    low = np.vstack([[(-1, -1), (0, -1), (-1, 0), (0, 0), (0.5, 0)], np.full((base.n_element - 1, 2), -1.0)])
    size = np.vstack([np.ones((3, 2)), [(0.5, 1.0)] * 2, np.full((base.n_element - 1, 2), 2.0)])
    parent = np.concatenate([np.zeros(5, dtype=int), np.arange(1, base.n_element)])
    rng, refined = np.random.default_rng(0), RefinedTemplate(base, parent, low, size)
    of_base, at = rng.integers(3, size=300), rng.uniform(-1.0, 1.0, (2, 300))
    element, *local = refined.within(of_base, *at)
    np.testing.assert_array_equal(parent[element], of_base)
    assert np.abs(local).max() <= 1.0
    np.testing.assert_allclose(low[element].T + 0.5 * size[element].T * (np.array(local) + 1.0), at)
