"""The mesh that follows the probe: numbering, geometry of the map, finding points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.simulate import Resolution
from isocharge.simulate.membrane import Geometry
from isocharge.simulate.template import CORE, Placement, Template, template

RESOLUTIONS = (
    Resolution(2, 8, 1),
    Resolution(3, 8, 4),
    Resolution(4, 8, 6),
    Resolution(5, 12, 3),
    Resolution(3, 16, 2),
)
PLACEMENTS = ((0.0, 0.02), (0.1, 0.02), (0.4, 0.11), (0.5, 0.002), (0.0, 0.9), (0.3, 0.5))
"""Distance of the footprint's centre and its radius, in film radii."""

NEAR_THE_RIM = ((0.9, 0.05), (0.96, 0.03))


@pytest.fixture(params=RESOLUTIONS, ids=str)
def mesh(request) -> Template:
    return template(request.param)


@pytest.mark.parametrize("wrong", [(1, 8, 4), (4, 4, 4), (4, 10, 4), (4, 8, 0)])
def test_impossible_resolution_is_refused(wrong):
    with pytest.raises(ValueError, match=f"got {wrong[0]}, {wrong[1]}, {wrong[2]}"):
        Resolution(*wrong)


def test_euler_characteristic_of_a_disk(mesh):
    """Vertices - edges + faces = 1, counted from the numbers that the corners of the elements got."""
    n = mesh.resolution.order
    corner = mesh.nodes[:, [0, n, (n + 1) ** 2 - 1, n * (n + 1)]]
    edges = {frozenset(pair) for quad in corner.tolist() for pair in zip(quad, quad[1:] + quad[:1], strict=True)}
    assert len(np.unique(corner)) - len(edges) + mesh.n_element == 1


def test_number_of_nodes_follows_from_vertices_edges_and_faces(mesh):
    """A conforming mesh of order n has V + (n - 1) E + (n - 1)^2 F nodes; its rim has n of them per element."""
    n, faces, around = mesh.resolution.order, mesh.n_element, mesh.resolution.around
    edges = (4 * faces + around) // 2
    vertices = 1 + edges - faces
    assert mesh.n_node == vertices + (n - 1) * edges + (n - 1) ** 2 * faces
    assert mesh.n_node - mesh.n_free == n * around
    assert set(mesh.nodes.ravel()) == set(range(mesh.n_node))


@pytest.mark.parametrize("rho", [1e-4, 0.02, 0.5, 0.95])
def test_nodes_with_one_number_coincide_for_every_probe(mesh, rho):
    """The numbering is made for one rho and must hold for all."""
    z = mesh.element_points(rho)
    np.testing.assert_allclose(mesh.node_points(rho)[mesh.nodes], z, atol=1e-12)
    assert np.unique(np.round(z / rho, 6)).size == mesh.n_node


def test_rim_nodes_come_last(mesh):
    distance = np.abs(mesh.node_points(0.07))
    assert np.all(distance[: mesh.n_free] < 1.0 - 1e-3)
    np.testing.assert_allclose(distance[mesh.n_free :], 1.0, atol=1e-14)


@pytest.mark.parametrize(("distance", "radius"), PLACEMENTS + NEAR_THE_RIM)
def test_footprint_edge_is_the_right_circle(distance, radius):
    """The template's ring |z| = rho lands on the circle with the footprint's radius and centre, the rim on the rim."""
    placement, turn = Placement.of_circle(distance, radius), np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 50))
    np.testing.assert_allclose(np.abs(placement.to_film(placement.rho * turn) - distance), radius, atol=1e-13)
    np.testing.assert_allclose(np.abs(placement.to_film(turn)), 1.0, atol=1e-13)


@pytest.mark.parametrize(("distance", "radius"), PLACEMENTS)
def test_area_of_film_and_of_footprint(distance, radius):
    """pi and pi R^2, from a mesh of high order; all Jacobians positive."""
    mesh = template(Resolution(8, 8, 4))
    geometry = Geometry.build(mesh, Placement.of_circle(distance, radius))
    assert geometry.weights.min() > 0.0
    assert geometry.weights.sum() == pytest.approx(np.pi, rel=2e-8)
    assert geometry.weights[mesh.footprint].sum() == pytest.approx(np.pi * radius**2, rel=2e-8)


def test_area_converges_exponentially_with_the_order():
    place = Placement.of_circle(0.4, 0.11)
    error = [abs(Geometry.build(template(Resolution(n, 8, 4)), place).weights.sum() - np.pi) for n in (2, 4, 6)]
    assert error[1] < error[0] / 50.0
    assert error[2] < error[1] / 50.0


@pytest.mark.parametrize(("distance", "radius"), PLACEMENTS + NEAR_THE_RIM)
def test_the_two_maps_are_inverse(distance, radius):
    placement = Placement.of_circle(distance, radius)
    film = _disk_points(np.random.default_rng(3), 200)
    np.testing.assert_allclose(placement.to_film(placement.to_template(film)), film, atol=1e-11)


@given(
    seed=st.integers(0, 2**32 - 1),
    distance=st.floats(0.0, 0.93),
    share=st.floats(1e-3, 0.95),
    resolution=st.sampled_from(RESOLUTIONS),
)
@settings(derandomize=True, deadline=None, max_examples=60)
def test_located_points_are_where_they_were(seed, distance, share, resolution):
    """Film point -> template -> element and local coordinates -> interpolated template point -> the same place."""
    mesh, placement = template(resolution), Placement.of_circle(distance, share * (1.0 - distance))
    z = placement.to_template(_disk_points(np.random.default_rng(seed), 40))
    element, xi, eta = mesh.locate(z, placement.rho)
    assert np.abs(np.concatenate([xi, eta])).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(_exact_place(mesh, element, xi, eta, placement.rho), z, atol=1e-11)


@pytest.mark.parametrize("resolution", RESOLUTIONS, ids=str)
def test_nodes_are_located_on_themselves(resolution):
    """Corners and edges of elements, the rim, the footprint's edge, the centre: every seam between the formulas."""
    mesh, rho = template(resolution), 0.07
    z = mesh.node_points(rho)
    element, xi, eta = mesh.locate(z, rho)
    np.testing.assert_allclose(_exact_place(mesh, element, xi, eta, rho), z, atol=1e-12)
    values, _ = mesh.basis_at(xi, eta)
    np.testing.assert_allclose(np.sum(values * mesh.element_points(rho)[element], axis=1), z, atol=1e-9)


def test_one_footprint_radius_per_point():
    mesh, rho = template(Resolution(4, 8, 6)), np.array([0.02, 0.3, 0.02, 0.3])
    z = np.array([0.1 + 0.1j, 0.1 + 0.1j, 0.01 - 0.005j, -0.25j])
    together = mesh.locate(z, rho)
    for i in range(4):
        alone = mesh.locate(z[i : i + 1], float(rho[i]))
        assert [part[i] for part in together] == [part[0] for part in alone]


def test_basis_derivatives_agree_with_differences(coarse):
    xi, eta = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 20))
    _, by_local = coarse.basis_at(xi, eta)
    h = 1e-6
    numeric = np.stack(
        [
            (coarse.basis_at(xi + h, eta)[0] - coarse.basis_at(xi - h, eta)[0]) / (2 * h),
            (coarse.basis_at(xi, eta + h)[0] - coarse.basis_at(xi, eta - h)[0]) / (2 * h),
        ]
    )
    np.testing.assert_allclose(by_local, numeric, atol=1e-8)


def test_template_is_made_once():
    assert template(Resolution(4, 8, 6)) is template(Resolution(4, 8, 6))


def _disk_points(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))


def _exact_place(mesh: Template, element: np.ndarray, xi: np.ndarray, eta: np.ndarray, rho: float) -> np.ndarray:
    """Template points of local coordinates from the blocks' formulas, written down once more."""
    m, around, rings = mesh.per_side, mesh.resolution.around, mesh.resolution.rings
    places = []
    for e, s, t in zip(element.tolist(), xi.tolist(), eta.tolist(), strict=True):
        s, t = 0.5 * (s + 1.0), 0.5 * (t + 1.0)
        if e < m * m:
            row, column = divmod(e, m)
            places.append(rho * CORE * complex(2 * (column + s) / m - 1, 2 * (row + t) / m - 1))
        elif e < mesh.n_inner:
            side, along = divmod(e - m * m, m)
            up = 2 * (along + t) / m - 1
            straight, arc = CORE * complex(1, up), np.exp(0.25j * np.pi * up)
            places.append(rho * 1j**side * ((1 - s) * straight + s * arc))
        else:
            ring, sector = divmod(e - mesh.n_inner, around)
            turn = -0.25 * np.pi + 2 * np.pi * (sector + t) / around
            places.append(rho ** (1 - (ring + s) / rings) * np.exp(1j * turn))
    return np.array(places)
