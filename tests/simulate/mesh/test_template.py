"""The mesh's topology: what Euler and counting know of it."""

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


def edges_of(mesh: Template) -> list[frozenset]:
    n = mesh.resolution.order
    corner = mesh.nodes[:, [0, n, (n + 1) ** 2 - 1, n * (n + 1)]]
    return [frozenset(pair) for quad in corner.tolist() for pair in zip(quad, quad[1:] + quad[:1], strict=True)]


def test_euler_characteristic_of_a_disk(built):
    """Vertices - edges + faces = 1, counted from the numbers that the corners of the elements got."""
    edges = set(edges_of(built))
    vertices = set().union(*edges)
    assert len(vertices) - len(edges) + built.n_element == 1
