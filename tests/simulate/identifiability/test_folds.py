"""Folds, twins and the working area on maps whose folds are known, and on the real sensors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    ChargeFunction,
    ChargeSpline,
    Circle,
    Electrode,
    ForwardMap,
    load_sensor,
    noise_model,
    working_area,
)
from isocharge.simulate.identifiability.ambiguities import find_ambiguous_pairs
from isocharge.simulate.identifiability.cramer_rao import limits_at
from isocharge.simulate.identifiability.folds import (
    FINEST,
    fold_points,
    scaled_jacobian,
    singular_values,
    turned_over,
)
from isocharge.simulate.identifiability.nearest_contact import nearest_contact
from isocharge.simulate.numerics.disk import Rings

REFERENCE = noise_model("reference")
CREASE = 3e-3
"""Where the synthetic maps fold, m: x and 2 CREASE - x give the same charges."""


def creased(extra: float | None = None, radius: float = 5e-3) -> ChargeFunction:
    """Three charges that fold at x = CREASE; a fourth, if there is one, rises with x by so much (1/m)."""

    def charge(contact):
        x, y, force = contact.T
        columns = [3.0 + 1e3 * (x - x**2 / (2.0 * CREASE)) / 3.0, 3.0 + 300.0 * y, np.full(len(x), 3.0)]
        if extra is not None:
            columns.append(3.0 + extra * x)
        return 3e-10 * force[:, None] ** (2.0 / 3.0) * np.stack(columns, axis=1)

    return ChargeFunction(charge, radius, (0.05, 2.0))


def linear_charges(*shapes, radius: float = 5e-3) -> ChargeFunction:
    """Charges that follow functions of x and y in mm, and one that tells the force alone."""

    def charge(contact):
        x, y, force = contact.T
        columns = [3.0 + 0.3 * shape(1e3 * x, 1e3 * y) for shape in shapes]
        return 3e-10 * force[:, None] ** (2.0 / 3.0) * np.stack([*columns, np.full(len(x), 3.0)], axis=1)

    return ChargeFunction(charge, radius, (0.05, 2.0), steps=(1e-6, 1e-6, 1e-3))


def squares(film, *places_mm):
    """The film with electrodes of 3 mm at other places."""
    electrodes = [
        Electrode.of_square(name, (1e-3 * x, 1e-3 * y), 3e-3)
        for name, (x, y) in zip("ABCDEFGH", places_mm, strict=False)
    ]
    return replace(film, sensor=replace(film.sensor, electrodes=tuple(electrodes)))


INNER = ((-0.9, 1.4), (8.7, 11.4), (15.2, -18.1), (-14.7, -5.3))
"""Places of four electrodes, mm, one of them within the area: no circle, no fold up to 15 mm."""


@pytest.fixture(scope="module")
def film():
    """One family of presses: other layouts and coefficients are only read differently."""
    return ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3), 11.5e-3)


@pytest.fixture(scope="module")
def charges(film):
    """By sensor, each made once."""
    return cache(lambda name: ChargeSpline.of(replace(film, sensor=load_sensor(name)), spacing=4e-4))


@pytest.fixture(scope="module")
def area(charges):
    """Working areas by sensor, each found once."""
    return cache(lambda name: working_area(charges(name), REFERENCE, twins=False))


@pytest.mark.parametrize("extra", [None, 0.0], ids=["three charges", "a fourth that tells nothing"])
def test_a_known_crease_is_found(extra):
    points = fold_points(creased(extra), Rings.spread(5e-3), 1.0, REFERENCE)
    assert len(points) > 50
    assert points[:, 0] == pytest.approx(CREASE, abs=1e-4)
    assert np.ptp(points[:, 1]) > 7e-3


def test_a_charge_that_tells_the_sides_apart_unfolds_it():
    assert len(fold_points(creased(300.0), Rings.spread(5e-3), 1.0, REFERENCE)) == 0


def test_without_a_crease_there_is_no_fold():
    assert len(fold_points(creased(radius=2.5e-3), Rings.spread(2.5e-3), 1.0, REFERENCE)) == 0


def test_a_fold_smaller_than_the_grid_is_found():
    """The slope of the first charge is negative within 0.1 mm of a point amid places that are 0.2 mm apart."""
    at, width = 1.5 * np.array([np.cos(np.pi * 0.225), np.sin(np.pi * 0.225)]), 0.1

    def pocket(x, y):
        bump = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * width**2))
        return x - 2.0 * (x - at[0]) * bump

    model, rings = linear_charges(pocket, lambda _, y: y), Rings.spread(5e-3, 25, 40)
    scaled = rings.per_ring(scaled_jacobian(model, rings.contacts(1.0), REFERENCE))
    assert not turned_over(scaled[:-1], scaled[1:]).any()
    assert not turned_over(scaled, np.roll(scaled, -1, axis=1)).any()
    points = fold_points(model, rings, 1.0, REFERENCE)
    assert len(points)
    assert np.hypot(*(1e3 * points - at).T).max() < 2.0 * width


def test_a_weak_spot_between_the_rings_ends_the_area():
    """Within 0.03 mm of a point between the rings' places the first charge hardly changes: 20 times the error."""
    at, width = 3.025 * np.array([np.cos(np.pi / 180.0), np.sin(np.pi / 180.0)]), 0.03

    def flat(x, y):
        return x - 0.95 * (x - at[0]) * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * width**2))

    spot, even = (linear_charges(shape, lambda _, y: y) for shape in (flat, lambda x, _: x))
    error = 1e-3
    assert working_area(even, REFERENCE, twins=False, error=error).why == "searched"
    working = working_area(spot, REFERENCE, twins=False, error=error)
    assert working.why == "error"
    assert working.error_radius == pytest.approx(3.025e-3, abs=3e-5)
    assert not len(working.folds)


def test_no_ring_within_the_area_errs_more_than_is_allowed(film):
    """Beside an electrode within the area the error rises between one ring and the next."""
    charges = ChargeSpline.of(squares(film, *INNER))
    for error in (0.3e-3, 1e-3):
        working = working_area(charges, REFERENCE, twins=False, error=error)
        worst = limits_at(charges, Rings.spread(working.radius).contacts(0.05), REFERENCE).position.max()
        assert worst <= error
        assert working.radius == pytest.approx(working.error_radius, abs=1.01e-4)


def test_four_charges_lose_rank_at_a_point():
    """The cross-cap (u^2, u v, v) loses rank at u = v = 0 and nowhere else (Whitney 1944)."""
    model = linear_charges(lambda x, _: (x - 1) ** 2, lambda x, y: (x - 1) * (y + 2), lambda _, y: y)
    points = fold_points(model, Rings.spread(5e-3), 1.0, REFERENCE)
    assert len(points)
    assert 1e3 * points == pytest.approx(np.broadcast_to([1.0, -2.0], points.shape), abs=2e3 * FINEST)


def test_a_map_that_bends_sharply_loses_no_rank():
    """A sheet bent round a cylinder of 0.2 mm: 0.4 mm apart it has turned over, and every place has its own charges."""
    bend = 0.2
    model = linear_charges(lambda x, _: bend * np.cos(x / bend), lambda x, _: bend * np.sin(x / bend), lambda _, y: y)
    near, far = (scaled_jacobian(model, np.array([[x, 0.0, 1.0]]), REFERENCE) for x in (-0.2e-3, 0.2e-3))
    assert turned_over(near, far)
    for rings in (Rings.spread(0.5e-3, 2, 8), Rings.spread(0.5e-3, 20, 40)):
        assert len(fold_points(replace(model, radius=0.5e-3), rings, 1.0, REFERENCE)) == 0


@pytest.mark.parametrize("force", [0.05, 1.0])
def test_an_electrode_within_the_area_is_no_fold(film, force):
    """A grid of 0.1 mm shows none; neighbours 0.3 mm apart did seem to turn over 1.7 mm from the centre."""
    charges = ChargeSpline.of(squares(film, *INNER), 4e-3)
    coarse, steps = Rings.spread(4e-3, 13, 60), 1e-4 * np.arange(-39, 40)
    scaled = coarse.per_ring(scaled_jacobian(charges, coarse.contacts(force), REFERENCE))
    assert turned_over(scaled[:-1], scaled[1:]).any()
    assert len(fold_points(charges, coarse, force, REFERENCE)) == 0
    x, y = np.meshgrid(steps, steps)
    inside = np.hypot(x, y) < 3.9e-3
    places = np.where(inside[..., None], np.stack([x, y], axis=-1), 0.0).reshape(-1, 2)
    contacts = np.column_stack([places, np.full(len(places), force)])
    grid = scaled_jacobian(charges, contacts, REFERENCE).reshape(*x.shape, 4, 3)
    across = turned_over(grid[:-1], grid[1:]) & inside[:-1] & inside[1:]
    along = turned_over(grid[:, :-1], grid[:, 1:]) & inside[:, :-1] & inside[:, 1:]
    assert not across.any()
    assert not along.any()


def test_the_nearest_fold_is_that_of_a_grid_of_a_tenth_of_a_millimetre(charges, area):
    """Brute force, with derivatives by differences: signs of det J."""
    model = charges("three-25um-uniaxial")
    differences = ChargeFunction(model.charge, model.radius, model.force_range, steps=(1e-5, 1e-5, 1e-3))
    steps = 1e-4 * np.arange(-50, 51)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    sign = np.sign(np.linalg.det(differences.jacobian(np.stack([x, y, np.full(x.size, 0.316)], axis=1))))
    turned = sign != sign[x.size // 2]
    assert area("three-25um-uniaxial").fold_radius == pytest.approx(np.hypot(x, y)[turned].min(), abs=1e-4)


def test_coarse_rings_find_the_same_nearest_fold(charges):
    for name in ("three-25um-biaxial", "three-25um-uniaxial", "four-25um-biaxial"):
        nearest = [
            np.hypot(*fold_points(charges(name), rings, 1.0, REFERENCE)[0])
            for rings in (Rings.spread(11.5e-3, 200, 360), Rings.spread(11.5e-3, 50, 90))
        ]
        assert nearest[0] == pytest.approx(nearest[1], abs=0.1e-3)


def test_six_electrodes_on_a_circle_fold_there_and_one_in_the_middle_unfolds_three(film):
    circle = [(10.0 * np.cos(a), 10.0 * np.sin(a)) for a in np.pi / 3.0 * np.arange(6)]
    six, middle = (
        working_area(ChargeSpline.of(squares(film, *places), spacing=4e-4), REFERENCE, twins=False)
        for places in (circle, [(0.0, 0.0), *circle[::2]])
    )
    assert 9.7e-3 < six.fold_radius < 10.1e-3
    assert "both sides of the points where it loses rank" in six.words
    assert np.isinf(middle.fold_radius)
    assert (middle.radius, middle.why) == (11.5e-3, "searched")


def test_a_third_electrode_in_the_middle_folds_at_once(film):
    charges = ChargeSpline.of(squares(film, (0.0, 0.0), (8.66, 5.0), (-8.66, 5.0)), 3e-3)
    working = working_area(charges, REFERENCE, twins=False)
    assert 0.1e-3 < working.fold_radius < 0.3e-3
    assert "both sides of the fold" in working.words


def test_two_charges_determine_nothing():
    with pytest.raises(SceneError, match="expected at least three electrodes, got 2"):
        working_area(linear_charges(lambda x, _: x), REFERENCE)


def test_turning_over_is_the_sign_of_the_determinant():
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 200, 3, 3)) * [1e6, 1e6, 1.0]
    np.testing.assert_array_equal(turned_over(first, second), np.linalg.det(first) * np.linalg.det(second) < 0.0)


def test_singular_values_are_the_deviations_by_direction():
    contact = np.array([[1e-3, 1e-3, 1.0]])
    model = creased(200.0)
    values = singular_values(scaled_jacobian(model, contact, REFERENCE))
    covariance = limits_at(model, contact, replace(REFERENCE, gain=1e-9)).covariance[0, :2, :2]
    values_white = singular_values(scaled_jacobian(model, contact, replace(REFERENCE, gain=1e-9)))
    assert 1.0 / values_white[0] ** 2 == pytest.approx(np.linalg.eigvalsh(covariance), rel=1e-6)
    assert (values < values_white).all()


def test_twins_are_mirror_images_in_the_crease():
    twins = find_ambiguous_pairs(creased(), REFERENCE, 0.5, places=400)
    assert len(twins) > 20
    assert twins.first[:, 0] + twins.second[:, 0] == pytest.approx(2.0 * CREASE, abs=5e-4)
    assert twins.first[:, 1] == pytest.approx(twins.second[:, 1], abs=5e-4)
    assert (twins.distance < 3.0).all()
    assert np.median(twins.distance) < 0.01
    assert (np.diff(twins.reach) >= 0.0).all()


def test_no_twins_where_the_sides_are_told_apart():
    assert len(find_ambiguous_pairs(creased(300.0), REFERENCE, 0.5, places=400)) == 0


def test_the_nearest_contact_is_the_right_one():
    model = creased(300.0)
    truth = np.array([[1e-3, -2e-3, 0.7], [-3e-3, 1e-3, 0.1]])
    contact, distance = nearest_contact(model, REFERENCE, model.charge(truth), np.array([[0.0, 0.0, 0.3]] * 2))
    np.testing.assert_allclose(contact, truth, rtol=1e-4)
    assert distance == pytest.approx(0.0, abs=0.01)


def test_the_nearest_contact_of_a_model_with_one_force_has_that_force():
    model = replace(creased(300.0), force_range=(0.5, 0.5))
    truth = np.array([[1e-3, -2e-3, 0.5]])
    contact, distance = nearest_contact(model, REFERENCE, model.charge(truth), np.array([[0.0, 0.0, 0.5]]))
    np.testing.assert_allclose(contact, truth, rtol=1e-4)
    assert distance == pytest.approx(0.0, abs=0.01)


def test_the_crease_bounds_the_working_area():
    working = working_area(creased(), REFERENCE, error=np.inf)
    assert working.fold_radius == pytest.approx(CREASE, abs=6e-5)
    assert working.why == "fold"
    assert working.radius == working.unfolded == pytest.approx(2.9e-3, abs=1.1e-4)
    assert "folds 3" in working.words


def test_the_allowed_error_bounds_it_earlier():
    working = working_area(creased(), REFERENCE, error=0.2e-3, twins=False)
    assert working.why == "error"
    ring = working.error_radius * np.exp(2j * np.pi * np.arange(360) / 360)
    contact = np.stack([ring.real, ring.imag, np.full(360, 0.05)], axis=1)
    assert limits_at(creased(), contact, REFERENCE).position.max() == pytest.approx(0.2e-3, rel=0.01)
    assert "exceeds 0.2 mm at 0.05 N" in working.words


def test_where_nothing_ends_it_the_search_does():
    working = working_area(creased(radius=1e-3), REFERENCE, error=1.0)
    assert (working.radius, working.why) == (1e-3, "searched")
    assert "search ended at 1 mm" in working.words


def test_where_nothing_is_known_there_is_none():
    assert working_area(creased(), REFERENCE, error=1e-6, twins=False).radius == 0.0


def test_three_biaxial_electrodes_fold_outside_of_8_mm(area):
    """The prototype found none within 8 mm, and some from about 9.5 mm."""
    assert 9.3e-3 < area("three-25um-biaxial").fold_radius < 10.1e-3
    assert 7e-3 < area("three-25um-biaxial").radius < 8.5e-3


def test_three_uniaxial_electrodes_fold_within_5_mm(area):
    assert area("three-25um-uniaxial").fold_radius < 5e-3
    assert area("three-25um-uniaxial").radius < 3e-3
    assert "no method can tell them apart" in area("three-25um-uniaxial").words


@pytest.mark.parametrize("name", ["four-25um-biaxial", "four-25um-uniaxial"])
def test_four_electrodes_are_usable_to_8_or_10_mm(area, name):
    assert 7.8e-3 < area(name).radius < 10e-3
    assert area(name).fold_radius > 8e-3


def test_twins_of_a_biaxial_film_are_mirror_images_in_the_electrodes_circle(charges):
    """Inversion: the product of their distances from the centre is the square of the circle's radius, 10 mm."""
    twins = find_ambiguous_pairs(charges("four-25um-biaxial"), REFERENCE, 1.0, places=400)
    product = np.hypot(*twins.first[:, :2].T) * np.hypot(*twins.second[:, :2].T)
    assert len(twins) > 10
    assert np.median(product) == pytest.approx(1e-4, rel=0.05)


def test_another_solver_finds_the_twins(charges):
    """SciPy's least squares, started at a twin, stays there; started all over the film, it meets no nearer pair."""
    model = charges("three-25um-uniaxial")
    twins = find_ambiguous_pairs(model, REFERENCE, 0.2, places=400)

    def residuals(unknown, charge):
        position = 11.4e-3 * unknown[:2] / max(1.0, np.hypot(*unknown[:2]))
        force = np.clip(np.exp(unknown[2]), 0.05, 2.0)
        return (model.charge(np.array([[*position, force]]))[0] - charge) / REFERENCE.sigma(charge)

    def solve(start, charge):
        solved = least_squares(residuals, [*(start[:2] / 11.4e-3), np.log(start[2])], args=(charge,), xtol=1e-12)
        return np.array([*(11.4e-3 * solved.x[:2]), np.exp(solved.x[2])]), np.linalg.norm(solved.fun)

    for first, second in zip(twins.first[:5], twins.second[:5], strict=True):
        contact, error = solve(second, model.charge(first[None])[0])
        assert error < 3.1
        assert np.hypot(*(contact - first)[:2]) > 1e-3
    rng = np.random.default_rng(0)
    for angle in rng.uniform(-np.pi, np.pi, 6):
        known = np.array([0.5 * twins.reach[0] * np.cos(angle), 0.5 * twins.reach[0] * np.sin(angle), 0.2])
        for start in rng.uniform(-1.0, 1.0, (4, 2)) * 0.7 * twins.reach[0]:
            contact, error = solve(np.array([*start, 0.2]), model.charge(known[None])[0])
            twin = error < 0.5 and np.hypot(*(contact - known)[:2]) > 1e-3
            assert not twin or np.hypot(*contact[:2]) > 0.9 * twins.reach[0]


@pytest.mark.parametrize(
    ("name", "reach", "force", "position", "relative"),
    [
        ("three-25um-biaxial", 8e-3, 1.0, 0.07e-3, 0.0024),
        ("three-25um-biaxial", 8e-3, 0.1, 0.19e-3, 0.0065),
        ("four-25um-biaxial", 10e-3, 1.0, 0.05e-3, 0.002),
        ("four-25um-biaxial", 10e-3, 0.1, 0.13e-3, 0.005),
    ],
)
def test_limits_of_the_prototype(charges, name, reach, force, position, relative):
    """Medians over the area, as the design notes them, to one or two digits."""
    rings = Rings.spread(reach)
    limits = limits_at(charges(name), rings.contacts(force), REFERENCE)
    area_weights = np.repeat(rings.distance, rings.position.shape[1])
    order = np.argsort(limits.position)
    half = np.searchsorted(np.cumsum(area_weights[order]), 0.5 * area_weights.sum())
    assert limits.position[order][half] == pytest.approx(position, rel=0.1)
    assert np.median(limits.force) == pytest.approx(relative, rel=0.25)
