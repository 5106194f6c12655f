"""The forward map against direct solves."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate import (
    Circle,
    ForwardMap,
    Polygon,
    Probe,
    Resolution,
    Sensor,
    SolveSettings,
    Theory,
    load_sensor,
    parse_probe,
    press,
    touch_charge,
)
from isocharge.simulate.forward.family import Family
from isocharge.simulate.forward.forward_map import INTERPOLATION_ERROR

MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)
QUICK_SETTINGS = SolveSettings(theory=MEMBRANE, resolution=Resolution(5, 8, 4))
QUICK = {"radius": 4e-3, "force_range": (0.7, 1.0), "settings": QUICK_SETTINGS}
"""A small family without bending: few and cheap solves."""
PROBES = {
    "triangle": Polygon.triangle(2.5e-3),
    "turned rectangle": parse_probe("rectangle:4x2@30"),
}


@pytest.fixture(scope="module")
def four_map() -> ForwardMap:
    """Wide enough that the probe comes to lie on the electrodes."""
    return ForwardMap.build(load_sensor("four-25um-biaxial"), Circle(1e-3), radius=10e-3)


@pytest.fixture(scope="module", params=PROBES.values(), ids=PROBES.keys())
def turned_map(request) -> ForwardMap:
    """A probe whose orientation matters; on the electrodes, for these are moved inwards."""
    return ForwardMap.build(near_electrodes(), request.param, **QUICK)


def near_electrodes(**changes) -> Sensor:
    """Uniaxial, the electrodes 5 mm from the centre."""
    sensor = load_sensor("four-25um-uniaxial")
    inward = tuple(
        replace(e, corners=tuple((x - 0.5 * e.centre[0], y - 0.5 * e.centre[1]) for x, y in e.corners))
        for e in sensor.electrodes
    )
    return replace(sensor, electrodes=inward, **changes)


def direct(
    made: ForwardMap, x: np.ndarray, y: np.ndarray, force: np.ndarray, turn: np.ndarray | float = 0.0
) -> np.ndarray:
    """The same presses solved one by one, on the map's mesh and with its theory."""
    sensor, settings = made.sensor, made.settings
    presses = zip(x.tolist(), y.tolist(), force.tolist(), np.broadcast_to(turn, x.shape).tolist(), strict=True)
    return np.array(
        [touch_charge(sensor, press(sensor.film, made.probe.turned(t), (a, b), f, settings)) for a, b, f, t in presses]
    )


def errors(made: ForwardMap, *presses: np.ndarray | float) -> np.ndarray:
    """Relative errors of all charges, small ones counted against a tenth of their press's largest."""
    expected = direct(made, *presses)
    scale = np.maximum(np.abs(expected), 0.1 * np.abs(expected).max(axis=1, keepdims=True))
    return np.abs(made.forward(*presses) - expected) / scale


def draw(made: ForwardMap, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Presses over all that the map covers: x, y, force, turn."""
    rng = np.random.default_rng(seed)
    z = made.radius * np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))
    force = np.exp(rng.uniform(*np.log(made.force_range), count))
    return z.real, z.imag, force, rng.uniform(-np.pi, np.pi, count)


def test_three_electrodes(three_map):
    error = errors(three_map, *draw(three_map, 12, seed=0))
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


def test_four_electrodes_with_the_probe_on_them_too(four_map):
    """Half of the presses within 2 mm of an electrode's centre."""
    x, y, force, turn = draw(four_map, 12, seed=1)
    rng = np.random.default_rng(2)
    on = rng.uniform(8e-3, 10e-3, 6) * np.exp(1j * (0.5 * np.pi * rng.integers(0, 4, 6) + rng.uniform(-0.15, 0.15, 6)))
    x[:6], y[:6] = on.real, on.imag
    error = errors(four_map, x, y, force, turn)
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


@pytest.mark.first_cases(1)
def test_random_orientations(turned_map):
    """Over electrodes and beside them."""
    error = errors(turned_map, *draw(turned_map, 10, seed=10))
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


def test_orientation_matters_and_has_the_probes_period(turned_map):
    x, y, force, turn = draw(turned_map, 50, seed=11)
    charge = turned_map.forward(x, y, force, turn)
    np.testing.assert_allclose(turned_map.forward(x, y, force, turn + turned_map.probe.period), charge, rtol=1e-6)
    assert np.abs(turned_map.forward(x, y, force, turn + 0.5 * turned_map.probe.period) / charge - 1.0).max() > 1e-2


def test_orientation_adds_to_the_probes_own_angle():
    """A probe given at an angle is the probe turned by it."""
    probe, family = Polygon.triangle(2e-3), {**QUICK, "radius": 2e-3}
    plain, turned = (ForwardMap.build(near_electrodes(), each, **family) for each in (probe, probe.turned(0.6)))
    x, y, force, turn = draw(plain, 20, seed=12)
    np.testing.assert_allclose(turned.forward(x, y, force, turn), plain.forward(x, y, force, turn + 0.6), rtol=2e-3)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_ends_of_the_range(four_map, share):
    """At the centre and at the very edge, with the smallest and the largest force."""
    distance = share * four_map.radius
    x, y, force = np.array([distance, -distance]), np.zeros(2), np.array(four_map.force_range)
    assert errors(four_map, x, y, force).max() < 1e-3


def test_error_that_the_map_knows_of_is_small_and_true(four_map):
    x, y, force, _ = draw(four_map, 8, seed=3)
    assert 0.0 < four_map.error <= INTERPOLATION_ERROR
    assert errors(four_map, x, y, force).max() < 3.0 * four_map.error


@pytest.mark.parametrize("changes", [{"readout": "edge"}, {"name": "uniaxial"}])
def test_one_family_of_solves_serves_every_readout(four_map, changes):
    sensor = load_sensor("four-25um-uniaxial") if "name" in changes else replace(four_map.sensor, **changes)
    x, y, force, _ = draw(four_map, 5, seed=4)
    assert errors(replace(four_map, sensor=sensor), x, y, force).max() < 1e-3


def test_calibrated_sensor(four_map):
    """Gains, shift and rotation reach the map as they reach a direct solve."""
    calibration = replace(four_map.sensor.calibration, gain={"A": 1.1}, shift=(0.5e-3, -1e-3), rotation=0.2)
    sensor = replace(four_map.sensor, calibration=calibration)
    x, y, force, _ = draw(four_map, 5, seed=5)
    assert errors(replace(four_map, sensor=sensor), x, y, force).max() < 1e-3


def test_contact_pressure(four_map, turned_map):
    """d33 counts on the electrode under the probe, whichever way the probe is turned."""
    for made in (four_map, turned_map):
        sensor = replace(made.sensor, piezo=replace(made.sensor.piezo, d33=-30e-12))
        presses = draw(made, 40, seed=6)
        distance = np.min(
            [np.hypot(presses[0] - e.centre[0], presses[1] - e.centre[1]) for e in sensor.electrodes], axis=0
        )
        nearest = np.argsort(distance)[:4]
        near = tuple(values[nearest] for values in presses)
        with_d33 = replace(made, sensor=sensor)
        assert errors(with_d33, *near).max() < 1e-3
        extra = with_d33.forward(*near) - made.forward(*near)
        assert extra.max() > 1e-12


def with_theory(theory: Theory) -> dict[str, SolveSettings]:
    return {"settings": replace(QUICK_SETTINGS, theory=theory)}


FILMS = {
    "pretension": ({"pretension": 0.5e6}, with_theory(Theory(stretching=True, bending=False, pretensioned=True))),
    "plate": ({"thickness": 1e-3}, with_theory(Theory(stretching=False, bending=True, pretensioned=False))),
    "110 um": ({"thickness": 110e-6}, {"settings": SolveSettings(), "radius": 2e-3}),
}


@pytest.mark.parametrize(("film", "how"), FILMS.values(), ids=FILMS.keys())
def test_other_films(film, how):
    sensor = near_electrodes()
    sensor = replace(sensor, film=replace(sensor.film, **film))
    made = ForwardMap.build(sensor, Circle(1e-3), **{**QUICK, **how})
    x, y, force, _ = draw(made, 6, seed=7)
    assert errors(made, x, y, force).max() < 1e-3


def test_surface():
    """Bending is in though nobody asked for it."""
    sensor = replace(load_sensor("four-25um-uniaxial"), surface="top")
    sensor = replace(sensor, film=replace(sensor.film, thickness=110e-6))
    made = ForwardMap.build(sensor, Circle(1e-3), radius=2e-3, force_range=(0.7, 1.0))
    assert made.theory.bending
    x, y, force, _ = draw(made, 6, seed=8)
    assert np.quantile(errors(made, x, y, force), 0.9) < 2e-3


def test_one_force():
    made = ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(2e-3), **{**QUICK, "force_range": (0.7, 0.7)})
    x, y, force = np.array([1e-3, 0.0]), np.array([2e-3, -3e-3]), np.full(2, 0.7)
    np.testing.assert_allclose(made.forward(x, y, force), direct(made, x, y, force), rtol=1e-3)


def test_zero_force_is_no_charge(three_map):
    """Anywhere: an untouched film has no position; alone and among others."""
    assert not three_map.forward(np.zeros(2), np.zeros(2), np.zeros(2)).any()
    x, force = np.array([1e-3, 50e-3, np.nan, 2e-3]), np.array([0.0, 0.0, 0.0, 1.0])
    charge = three_map.forward(x, np.zeros(4), force)
    assert not charge[:3].any()
    assert np.all(charge[3] > 0.0)


def test_many_presses_are_each_of_them(three_map, turned_map):
    """More than a chunk, and the order kept; untouched rows among them."""
    for made in (three_map, turned_map):
        x, y, force, turn = draw(made, 600, seed=8)
        force[::7] = 0.0
        charge = made.forward(x, y, force, turn)
        assert charge.shape == (600, len(made.sensor.electrodes))
        for i in (0, 1, 255, 256, 300, 512, 599):
            one = made.forward(*(values[i : i + 1] for values in (x, y, force, turn)))[0]
            np.testing.assert_allclose(charge[i], one, rtol=1e-11)


def test_no_presses_and_one_force_for_all(three_map):
    assert three_map.forward(np.empty(0), np.empty(0), np.empty(0)).shape == (0, 3)
    one = three_map.forward(np.zeros(3), np.array([0.0, 1e-3, 2e-3]), np.array(1.0))
    assert one.shape == (3, 3)


@pytest.mark.parametrize(
    ("x", "force", "shown"),
    [
        (
            8.1e-3,
            1.0,
            r"press 1 at \(8\.1, 0\) mm with 1 N is outside .* at most 8 mm from the centre and 0\.05 to 2 N",
        ),
        (1e-3, 2.1, r"press 1 at \(1, 0\) mm with 2\.1 N"),
        (1e-3, 0.04, r"press 1 at \(1, 0\) mm with 0\.04 N"),
        (1e-3, -1.0, r"press 1 at \(1, 0\) mm with -1 N"),
        (np.nan, 1.0, r"press 1 at \(nan, 0\) mm"),
        (1e-3, np.nan, r"with nan N"),
    ],
)
def test_press_outside_is_shown(three_map, x, force, shown):
    with pytest.raises(SceneError, match=shown):
        three_map.forward(np.array([0.0, x]), np.zeros(2), np.array([1.0, force]))


def test_press_outside_is_counted_among_all_presses(three_map):
    """Untouched ones, whose place does not matter, are counted too."""
    x, force = np.array([0.0, 0.05, 1e-3, 8.1e-3]), np.array([0.0, 0.0, 1.0, 1.0])
    assert not three_map.forward(x[:2], np.zeros(2), force[:2]).any()
    with pytest.raises(SceneError, match=r"press 3 at \(8\.1, 0\) mm"):
        three_map.forward(x, np.zeros(4), force)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"force_range": (0.0, 1.0)}, r"force range: expected 0 < MIN <= MAX in N, got 0\.0 to 1\.0"),
        ({"force_range": (2.0, 1.0)}, "force range"),
        ({"force_range": (0.1, np.inf)}, "force range"),
        ({"force_range": (np.nan, 1.0)}, "force range"),
        ({"radius": 0.0}, r"radius: expected a positive number, got 0\.0 mm"),
        ({"radius": np.nan}, "radius: expected a positive number"),
        (
            {"radius": 44.5e-3},
            r"radius: presses up to 44\.5 mm from the centre with circle:1\.0, which reaches",
        ),
        ({"force_range": (0.1, 500.0)}, "beyond small strains"),
    ],
)
def test_impossible_families_are_refused(arguments, message):
    with pytest.raises(SceneError, match=message):
        ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3), **arguments)


def test_a_map_that_interpolates_badly_is_refused(monkeypatch):
    """An error that cannot be reached is not passed over."""
    monkeypatch.setattr("isocharge.simulate.forward.forward_map.INTERPOLATION_ERROR", 1e-13)
    with pytest.raises(SolveError, match=r"up to 4 mm and 1 N interpolates to .* only, expected 1e-13"):
        ForwardMap.build(
            load_sensor("three-25um-biaxial"),
            Circle(1e-3),
            **{**QUICK, "settings": replace(QUICK_SETTINGS, resolution=Resolution(3, 8, 2))},
        )


@pytest.mark.slow
def test_map_over_most_of_the_film():
    """Far out the mesh is finer, and the electrodes are still met."""
    made = ForwardMap.build(load_sensor("four-25um-biaxial"), Circle(1e-3), radius=22e-3, force_range=(0.5, 1.0))
    x, y, force, _ = draw(made, 20, seed=9)
    assert errors(made, x, y, force).max() < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("probe", PROBES.values(), ids=PROBES.keys())
def test_the_issues_ranges(probe):
    """0.05 to 2 N, r <= 10 mm, random orientation, with bending: 95 % within 0.1 %, all within 0.5 %."""
    made = ForwardMap.build(load_sensor("four-25um-uniaxial"), probe, radius=10e-3)
    error = errors(made, *draw(made, 40, seed=13))
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("probe", [Circle(1e-3), Polygon.triangle(4e-3)], ids=["circle", "triangle"])
def test_result_does_not_depend_on_the_executor(two_processes, probe: Probe):
    sensor, family = load_sensor("three-25um-biaxial"), {**QUICK, "force_range": (0.9, 1.0), "radius": 1e-3}
    here = ForwardMap.build(sensor, probe, **family)
    there = ForwardMap.build(sensor, probe, **family, map_jobs=two_processes.map)
    assert here.table.tobytes() == there.table.tobytes()
    assert here.error == there.error


def test_progress_is_told():
    told = []
    ForwardMap.build(
        load_sensor("three-25um-biaxial"),
        Circle(1e-3),
        **QUICK,
        progress=lambda done, total: told.append((done, total)),
    )
    _, total = told[-1]
    assert total > 1
    assert told[-total:] == [(i, total) for i in range(1, total + 1)]


# Where a family is solved


def test_nodes_are_chebyshevs_in_the_distance_and_in_the_logarithm_of_the_force():
    family = Family.spread(8e-3, (0.05, 2.0), (8, 3), 0.0)
    low, high = np.log([0.05, 2.0])
    np.testing.assert_allclose(family.distance, 4e-3 * (1.0 + np.polynomial.chebyshev.chebpts1(8)), rtol=1e-12)
    expected = 0.5 * (low + high) + 0.5 * (high - low) * np.polynomial.chebyshev.chebpts1(3)
    np.testing.assert_allclose(np.log(family.force), expected, rtol=1e-12)
    assert family.turn.tolist() == [0.0]


@pytest.mark.parametrize("folds", [1, 2, 3, 4, 5])
def test_orientations_are_spread_evenly_and_solved_once_each(folds):
    family = Family.spread(8e-3, (0.05, 2.0), (3, 2), 2.0 * np.pi / folds)
    assert family.folds == folds
    assert family.turn.size % folds == 0
    np.testing.assert_allclose(np.diff(family.turn), 2.0 * np.pi / family.turn.size, rtol=1e-12)
    assert np.all(family.solved_turns < 2.0 * np.pi / folds - 1e-9)
    assert family.solved_turns.size * folds == family.turn.size


@pytest.mark.parametrize(("folds", "turns"), [(0, 1), (1, 14), (2, 14), (3, 15), (4, 16)])
def test_a_second_try_has_more_orientations(folds, turns):
    """Whole sets of those that look different; a round probe has one whatever is asked."""
    period = 2.0 * np.pi / folds if folds else 0.0
    assert Family.spread(8e-3, (0.05, 2.0), (8, 5), period, 14).turn.size == turns


@pytest.mark.parametrize("period", [2 * np.pi, np.pi, 2 * np.pi / 3])
def test_nodes_interpolate_what_charges_look_like(period):
    """A power of the force, a smooth function of the distance, the first harmonics of the orientation."""
    rng = np.random.default_rng(9)
    distance, force = 8e-3 * np.sqrt(rng.random(200)), np.exp(rng.uniform(np.log(0.05), np.log(2.0), 200))
    turn = rng.uniform(-7.0, 7.0, 200)

    def smooth(d: np.ndarray, f: np.ndarray, t: np.ndarray) -> np.ndarray:
        return f**0.02 / (1.0 + (d / 12e-3) ** 2) + 0.1 * np.cos(t - 0.3) + 0.05 * np.sin(3.0 * t)

    for count, expected in (((8, 3), 1e-4), ((15, 8), 1e-7)):
        family = Family.spread(8e-3, (0.05, 2.0), count, period)
        grid = np.meshgrid(family.distance, family.force, family.turn, indexing="ij")
        found = family.weights(distance, force, turn) @ smooth(*grid).ravel()
        np.testing.assert_allclose(found, smooth(distance, force, turn), rtol=expected)
