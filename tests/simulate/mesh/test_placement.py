"""Position of the mesh: areas, edges, load, and the location of points."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Ellipse, Film, Polygon, Probe, SolveSettings
from isocharge.simulate.mesh.oval import oval_displacement
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.template import Template, locate_points
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.solver.load_case import LoadCase, choose_mesh

RADIUS = 45.0
FILM = Film(RADIUS, 0.025, 3000.0, 0.34)
COMMON = settings(derandomize=True, deadline=None, max_examples=15)


@st.composite
def probes(draw) -> Probe:
    """Circles, ellipses, rectangles, triangles and other convex polygons, rotated by any angle."""
    size = RADIUS * 10.0 ** draw(st.floats(-3.0, -0.7))
    angle = draw(st.floats(0.0, 2.0 * np.pi))
    width = max(0.02, 2.0 * size * draw(st.floats(0.1, 1.0)))
    gaps = np.array(draw(st.lists(st.floats(0.4, 1.0), min_size=4, max_size=8)))
    corners = size * np.exp(2j * np.pi * np.cumsum(gaps) / gaps.sum())
    shapes = [
        Circle(size),
        Ellipse(2.0 * size, max(width, 0.4 * size), angle),
        Polygon.rectangle(2.0 * size, width, angle),
        Polygon.triangle(1.7 * size, angle),
        Polygon.of(to_corners(corners), angle),
    ]
    return draw(st.sampled_from(shapes))


@st.composite
def presses(draw):
    """Generate accepted presses up to the rim: probe, position, template and placed mesh."""
    probe = draw(probes())
    layer = 10.0 ** draw(st.floats(-3.0, -1.0))
    share = draw(st.one_of(st.floats(0.0, 0.97), st.floats(0.9, 0.999)))
    angle = draw(st.floats(-np.pi, np.pi))
    distance = share * (RADIUS - probe.reach)
    at = (distance * np.cos(angle), distance * np.sin(angle))
    film = replace(FILM, oval=draw(st.sampled_from([0.0, -0.05])))
    try:
        placed = choose_mesh(LoadCase(film, probe, at, 1e-3, SolveSettings(layer=layer)))
    except SceneError:
        assume(False)
    return probe, at, placed.template, placed


def exact_points(placement: Placement, mesh: Template, xi: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """Film points of the same local coordinates in every element, shape (n_element, n)."""
    other = copy.copy(mesh)
    other.xi = xi
    other.eta = eta
    return placement.element_points(other)


def found_again(placement: Placement, mesh: Template, film: np.ndarray) -> np.ndarray:
    """Return the points of the local coordinates that `locate` finds. These coordinates must lie in [-1, 1]."""
    element, xi, eta, _ = (found[0] for found in locate_points(placement[None], mesh, film[None]))
    assert np.abs(np.concatenate([xi, eta])).max() <= 1.0 + 1e-7
    return exact_points(placement, mesh, xi, eta)[element, np.arange(film.size)]


def accuracy(film: np.ndarray, placement: Placement) -> np.ndarray:
    """Return the tolerance for each point, which is 1e-9 of the size of the elements near the point.

    Elements are small near a small probe, and between a probe and a near rim.
    """
    (distance,) = np.abs(film[None] - placement.corners.mean())
    room = 1.0 - np.abs(placement.corners).max()
    return 1e-9 * np.minimum(1.0, np.maximum(distance, 1e-3 * room) + np.ptp(np.abs(placement.corners)) + 1e-3)


@given(scene=presses(), seed=st.integers(0, 2**32 - 1))
@COMMON
def test_locate_is_the_inverse_of_the_element_map(scene, seed):
    """The points lie all over the film, on the rim, at the nodes and on the edge of the footprint."""
    probe, _, mesh, placed = scene
    placement = placed.placement
    rng = np.random.default_rng(seed)
    disk = np.sqrt(rng.random(120)) * np.exp(2j * np.pi * rng.random(120))
    near = placement.corners.mean() + 3.0 * probe.reach / RADIUS * disk[:100]
    rim = np.exp(2j * np.pi * rng.random(20))
    circular = np.concatenate([disk, near[np.abs(near) < 1.0], rim])
    on_film = circular + oval_displacement(circular, placement.oval)
    film = np.concatenate([on_film, placement.element_points(mesh).ravel()[::7]])
    if mesh.half:
        film = film.real + 1j * np.abs(film.imag)
    np.testing.assert_array_less(np.abs(found_again(placement, mesh, film) - film), accuracy(film, placement))


def test_points_beyond_an_oval_rim_have_the_displacement_of_the_rim():
    """A search for electrode positions examines squares that lie partly or completely beyond the rim."""
    film = replace(FILM, oval=0.06, oval_axis=0.7)
    placement = choose_mesh(LoadCase(film, Circle(1.0), (3.0, 1.0), 0.1, SolveSettings())).placement
    points = np.array([1.1j, -1.5, 2.0 + 1.0j, 8.0])
    circular = placement.to_circular_film(points)
    rim = circular / np.abs(circular)
    np.testing.assert_allclose(circular + oval_displacement(rim, placement.oval), points, atol=1e-12)


@given(scene=presses())
@COMMON
def test_no_element_is_folded_and_the_footprint_has_the_area_centroid_and_load_of_the_probe(scene):
    """The Jacobian is positive at every integration point and node, and the total area is that of the film.

    Area, centroid and load of the footprint are exact for polygons, and accurate to the mesh error for curved probes.
    """
    probe, at, mesh, placed = scene
    assert placed.weights.min() > 0.0
    assert placed.node_weights.min() > 0.0
    assert mesh.copies * placed.weights.sum() == pytest.approx(np.pi, rel=3e-3)
    distance = float(np.hypot(*at)) / RADIUS
    exact = 1e-9 if isinstance(probe, Polygon) else 1e-4
    inner = placed.weights[mesh.footprint]
    assert mesh.copies * inner.sum() == pytest.approx(probe.area / RADIUS**2, rel=exact)
    assert mesh.copies * placed.load.sum() == pytest.approx(1.0, rel=1e-12)
    mean = mesh.copies * placed.load @ placed.node_points
    assert mean.real == pytest.approx(distance, abs=exact * probe.reach / RADIUS)
    if not mesh.half:
        assert mean.imag == pytest.approx(0.0, abs=exact * probe.reach / RADIUS)
