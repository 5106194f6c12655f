"""Triangulation against circles (trilateration is classical), against presses, and in its refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from isocharge.common.errors import ChargeError, SceneError, SensorError
from isocharge.simulate import (
    Circle,
    Film,
    ForwardMap,
    Meeting,
    Polygon,
    Resolution,
    SolveSettings,
    Theory,
    Triangulation,
    load_sensor,
    noise_model,
)
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.mechanics.scaling import amplitude_squared

RADIUS, FORCES = 8e-3, (0.2, 2.0)
QUICK = SolveSettings(theory=Theory(stretching=True, bending=False, pretensioned=False), resolution=Resolution(4, 8, 4))
LAYOUTS = {name: load_sensor(f"{name}-25um-biaxial") for name in ("three", "four")}


def circles(film: Film, centres: np.ndarray):
    """Charges that fall with the distance from each electrode, so that contours are circles; and the inverse."""

    def forward(x, y, force):
        distance = np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1])
        return (1e-3 * amplitude_squared(film, force))[:, None] / (1.0 + (distance / 12e-3) ** 2)

    def distance(charge, force):
        return 12e-3 * np.sqrt((1e-3 * amplitude_squared(film, force))[:, None] / charge - 1.0)

    return forward, distance


def round_table(sensor) -> tuple[ChargeSpline, object, object, np.ndarray]:
    centres = np.array([electrode.centre for electrode in sensor.electrodes])
    forward, distance = circles(sensor.film, centres)
    nodes = np.geomspace(*FORCES, 3)
    table = ChargeSpline.fit(forward, sensor.electrode_names, sensor.film, RADIUS, nodes, FORCES, 0.6e-3)
    return table, forward, distance, centres


def draw(count: int, seed: int, radius: float = 7e-3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    r, angle = radius * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    return r * np.cos(angle), r * np.sin(angle), np.exp(rng.uniform(*np.log(FORCES), count))


def intersections(first, second, r1, r2) -> np.ndarray:
    """Where two circles meet, shape (2, 2), NaN where they do not: the textbook formula."""
    between = np.linalg.norm(second - first)
    along = (between**2 + r1**2 - r2**2) / (2.0 * between)
    across = np.sqrt(r1**2 - along**2)
    unit = (second - first) / between
    return first + along * unit + across * np.array([[1.0], [-1.0]]) * np.array([-unit[1], unit[0]])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_circles_are_trilaterated(layout):
    table, forward, _, _ = round_table(LAYOUTS[layout])
    x, y, force = draw(300, seed=1)
    fix = Triangulation(table).locate(forward(x, y, force), force)
    assert fix.found.mean() > 0.98  # two contours touch on the line between their electrodes
    assert np.hypot(fix.x - x, fix.y - y)[fix.found].max() < 1e-6
    assert np.median(fix.spread[fix.found]) < 1e-8


def test_the_mean_of_three_crossings_is_the_textbooks():
    """With charges that fit no single press: three circles, three crossings apart from each other, their mean."""
    table, forward, distance, centres = round_table(LAYOUTS["three"])
    x, y, force = draw(60, seed=2, radius=3e-3)
    charge = forward(x, y, force) * (1.0 + 0.01 * np.random.default_rng(3).standard_normal((60, 3)))
    fix = Triangulation(table).locate(charge, force)
    assert fix.found.sum() > 50
    radii = distance(charge, force)
    for i in np.flatnonzero(fix.found):
        corners = []
        for a, b in ((0, 1), (0, 2), (1, 2)):
            both = intersections(centres[a], centres[b], radii[i, a], radii[i, b])
            corners.append(both[np.argmin(np.linalg.norm(both - [x[i], y[i]], axis=1))])
        mean = np.mean(corners, axis=0)
        np.testing.assert_allclose([fix.x[i], fix.y[i]], mean, atol=2e-6)
        assert fix.spread[i] == pytest.approx(np.linalg.norm(corners - mean, axis=1).max(), abs=3e-6)


def test_four_electrodes_average_four_triples():
    table, forward, distance, centres = round_table(LAYOUTS["four"])
    x, y, force = np.array([1.5e-3]), np.array([2.5e-3]), np.array([1.0])
    charge = forward(x, y, force) * (1.0 + 0.003 * np.array([1.0, -1.0, 0.5, -0.5]))
    fix = Triangulation(table).locate(charge, force)
    radii, crossing = distance(charge, force)[0], {}
    for a in range(4):
        for b in range(a + 1, 4):
            both = intersections(centres[a], centres[b], radii[a], radii[b])
            crossing[a, b] = both[np.argmin(np.linalg.norm(both - [x[0], y[0]], axis=1))]
    triples = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
    means = [np.mean([crossing[a, b], crossing[a, c], crossing[b, c]], axis=0) for a, b, c in triples]
    assert fix.triples.tolist() == [4]
    np.testing.assert_allclose([fix.x[0], fix.y[0]], np.mean(means, axis=0), atol=2e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_force_is_found_with_the_position(layout):
    table, forward, _, _ = round_table(LAYOUTS[layout])
    x, y, force = draw(200, seed=4)
    fix = Triangulation(table).locate_with_force(forward(x, y, force))
    good = fix.found
    assert good.mean() > 0.95
    assert np.median(np.hypot(fix.x - x, fix.y - y)[good]) < 1e-7
    assert np.median(np.abs(fix.force / force - 1.0)[good]) < 1e-5


def test_closest_to_meeting_is_scipys_least_squares():
    """Force unknown, four charges that fit no press: the same minimum as a general least-squares solver finds."""
    sensor = LAYOUTS["four"]
    table, forward, _, _ = round_table(sensor)
    charge = forward(np.array([2e-3]), np.array([-1e-3]), np.array([0.8])) * (1.0 + 0.01 * np.array([1, 1, -1, -1.5]))
    fix = Triangulation(table).locate_with_force(charge)

    def away(contact):
        position, force = contact[None, :2] * 1e-3, np.exp(contact[2:])
        value, slope, _ = table.first_order(position, force)
        return 1e3 * ((value - charge) / np.linalg.norm(slope, axis=2))[0]

    best = least_squares(away, [2.0, -1.0, np.log(0.8)], xtol=1e-12, ftol=1e-12)
    np.testing.assert_allclose([1e3 * fix.x[0], 1e3 * fix.y[0]], best.x[:2], atol=5e-3)
    assert 1e3 * fix.spread[0] == pytest.approx(np.sqrt(np.mean(best.fun**2)), rel=1e-2)


@pytest.fixture(scope="module")
def triangle_map() -> ForwardMap:
    return ForwardMap.build(LAYOUTS["three"], Polygon.triangle(4e-3), 8e-3, (1.0, 1.0), QUICK)


@pytest.fixture(scope="module")
def on_film(triangle_map) -> Triangulation:
    return Triangulation.from_map(triangle_map, spacing=0.4e-3)


def test_round_trip_of_presses_of_a_triangle(triangle_map, on_film):
    """The issue's figure: within 0.005 mm at the median, known force, no noise."""
    x, y, _ = draw(300, seed=5, radius=8e-3)
    fix = on_film.locate(triangle_map.forward(x, y, 1.0), 1.0)
    error = np.hypot(fix.x - x, fix.y - y)[fix.found]
    assert fix.found.mean() > 0.98
    assert np.median(error) < 1e-6
    assert error.max() < 0.05e-3


def test_symmetry_of_the_layout(triangle_map, on_film):
    """Turning the charges by one electrode turns the position by a third, the mirrored triangle pointing up."""
    x, y = np.array([2.1e-3]), np.array([-3.2e-3])
    charge = triangle_map.forward(x, y, np.array([1.0]))
    fix, turned = on_film.locate(charge, 1.0), on_film.locate(np.roll(charge, 1, axis=1), 1.0)
    third = (fix.x + 1j * fix.y) * np.exp(2j * np.pi / 3.0)
    np.testing.assert_allclose(turned.x + 1j * turned.y, third, atol=2e-6)  # A to B to C turns anticlockwise


def test_noise_spreads_the_crossings(triangle_map, on_film):
    x, y, _ = draw(300, seed=6)
    charge = noise_model("reference").add(triangle_map.forward(x, y, 1.0), np.random.default_rng(7))
    fix = on_film.locate(charge, 1.0)
    error = np.hypot(fix.x - x, fix.y - y)[fix.found]
    assert 0.02e-3 < np.median(error) < 0.2e-3
    assert np.isnan(fix.x[~fix.found]).all()
    assert np.isnan(fix.y[~fix.found]).all()


# What has no answer


def test_charges_that_no_contour_reaches(on_film):
    fix = on_film.locate(np.array([[9e-9, 9e-9, 9e-9], [1e-12, 8e-10, 8e-10]]), 1.0)
    assert fix.status.tolist() == [Meeting.no_contour] * 2
    assert np.isnan([fix.x, fix.y, fix.spread]).all()


def test_contours_that_do_not_meet(triangle_map, on_film):
    charge = triangle_map.forward(np.array([1e-3]), np.array([1e-3]), np.array([1.0]))
    fix = on_film.locate(charge * [1.3, 1.3, 1.3], 1.0)
    assert fix.status.tolist() == [Meeting.apart]
    assert np.isnan(fix.x[0])
    assert "no intersection" in Meeting(fix.status[0]).words


def test_contours_that_meet_twice():
    """Electrodes on a line: the circles meet again in the mirror."""
    sensor = LAYOUTS["three"]
    centres = np.array([[-9e-3, 0.0], [0.0, 0.0], [9e-3, 0.0]])
    forward, _ = circles(sensor.film, centres)
    table = ChargeSpline.fit(forward, ("A", "B", "C"), sensor.film, RADIUS, np.array([1.0]), (1.0, 1.0), 0.6e-3)
    fix = Triangulation(table).locate(forward(np.array([1e-3]), np.array([3e-3]), np.array([1.0])), 1.0)
    assert fix.status.tolist() == [Meeting.twice]
    assert np.isnan([fix.x[0], fix.y[0]]).all()


def test_folded_map_says_that_there_are_two():
    """Three electrodes, uniaxial, force unknown: two contacts with the same charges, found from either."""
    uniaxial = load_sensor("three-25um-uniaxial")
    forward_map = ForwardMap.build(uniaxial, Circle(1e-3), 8e-3, FORCES, QUICK)
    triangulation = Triangulation.from_map(forward_map, spacing=0.5e-3)
    x, y, force = draw(200, seed=8)
    fix = triangulation.locate_with_force(forward_map.forward(x, y, force))
    assert (fix.status == Meeting.twice).sum() > 10
    error = np.hypot(fix.x - x, fix.y - y)[fix.found]
    assert np.quantile(error, 0.95) < 0.05e-3


@pytest.mark.parametrize(
    ("charge", "force", "error", "message"),
    [
        (np.ones((1, 2)), 1.0, ChargeError, r"shape \(n, 3\) for \('A', 'B', 'C'\), got shape \(1, 2\)"),
        (
            np.array([[1.0, np.nan, 1.0]]),
            1.0,
            ChargeError,
            "charge of 'B' in press 0: .* finite number, got nan",
        ),
        (np.ones((2, 3)), 2.5, SceneError, "force of press 0: expected 1 to 1 N, which the table covers, got 2.5 N"),
        (np.ones((2, 3)), np.array([1.0, np.nan]), SceneError, "force of press 1: .* got nan N"),
    ],
)
def test_wrong_input_is_shown(on_film, charge, force, error, message):
    with pytest.raises(error, match=message):
        on_film.locate(charge, force)


def test_fewer_than_three_electrodes_are_refused(triangle_map):
    two = replace(LAYOUTS["three"], electrodes=LAYOUTS["three"].electrodes[:2])
    with pytest.raises(SensorError, match=r"at least three electrodes, got \('A', 'B'\)"):
        Triangulation.from_map(replace(triangle_map, sensor=two))


def test_radius_beyond_the_map_is_refused(triangle_map):
    with pytest.raises(SceneError, match=r"up to the forward map's 8 mm, got 9 mm"):
        Triangulation.from_map(triangle_map, radius=9e-3)


def test_no_presses_give_no_fixes(on_film):
    assert on_film.locate(np.zeros((0, 3)), 1.0).x.shape == (0,)
    assert on_film.locate_with_force(np.zeros((0, 3))).force.shape == (0,)


def test_a_fix_as_json_has_a_position_in_mm_or_none():
    table, forward, _, _ = round_table(LAYOUTS["three"])
    charge = forward(np.array([2e-3, 2e-3]), np.array([1e-3, 1e-3]), np.array([1.0, 1.0]))
    charge[1] *= [1.0, 1.0, 9.0]
    fix = Triangulation(table).locate(charge, 1.0)
    assert fix.to_dict(0) == {
        "status": "met",
        "words": "the contours meet",
        "at_mm": pytest.approx([2.0, 1.0], abs=1e-3),
    }
    assert fix.to_dict(1)["status"] == "no_contour"
    assert fix.to_dict(1)["at_mm"] is None
