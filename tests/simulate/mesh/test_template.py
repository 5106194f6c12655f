"""The mesh's topology: what Euler and counting know of it."""

import numpy as np
import pytest

from isocharge.simulate import Resolution
from isocharge.simulate.mesh.template import Template, template

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


def test_resolution_is_described_as_in_a_manifest():
    assert Resolution(5, 8, 6, 1).description == "order 5, around 8, rings 6, rim 1"


def edges_of(mesh: Template) -> list[frozenset]:
    n = mesh.resolution.order
    corner = mesh.nodes[:, [0, n, (n + 1) ** 2 - 1, n * (n + 1)]]
    return [frozenset(pair) for quad in corner.tolist() for pair in zip(quad, quad[1:] + quad[:1], strict=True)]


def test_euler_characteristic_of_a_disk(built):
    """Vertices - edges + faces = 1, counted from the numbers that the corners of the elements got."""
    edges = set(edges_of(built))
    vertices = set().union(*edges)
    assert len(vertices) - len(edges) + built.n_element == 1


def test_edges_have_at_most_two_elements(built):
    """Those that have one are the rim and, for a half disk, the line of symmetry."""
    edges = edges_of(built)
    count = {edge: edges.count(edge) for edge in set(edges)}
    assert set(count.values()) == {1, 2}
    alone = set().union(*(edge for edge, times in count.items() if times == 1))
    n = built.resolution.order
    vertices = np.unique(built.nodes[:, [0, n, (n + 1) ** 2 - 1, n * (n + 1)]])
    boundary = np.flatnonzero(built.on_rim | built.on_axis)
    assert alone == set(vertices) & set(boundary)


def test_number_of_nodes_follows_from_vertices_edges_and_faces(built):
    """A conforming mesh of order n has V + (n - 1) E + (n - 1)^2 F nodes."""
    n, edges = built.resolution.order, set(edges_of(built))
    vertices = set().union(*edges)
    assert built.n_node == len(vertices) + (n - 1) * len(edges) + (n - 1) ** 2 * built.n_element
    assert set(built.nodes.ravel()) == set(range(built.n_node))
    rim = n * built.n_sector + (1 if built.half else 0)
    assert built.on_rim.sum() == rim


def test_template_is_half_a_disk_for_circles_only(built):
    assert built.half == (built.corners == 0)
    assert built.copies == (2 if built.half else 1)
    assert built.on_axis.any() == built.half
