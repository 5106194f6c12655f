"""The forward map against direct solves."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.errors import SceneError, SolveError
from isocharge.simulate import Circle, ForwardMap, Resolution, Sensor, load_sensor, press, touch_charge
from isocharge.simulate.forward import INTERPOLATION_ERROR, Nodes


@pytest.fixture(scope="module")
def four_map() -> ForwardMap:
    """Wide enough that the probe comes to lie on the electrodes."""
    return ForwardMap.build(load_sensor("four-25um-biaxial"), Circle(1e-3), radius=10e-3)


def direct(sensor: Sensor, x: np.ndarray, y: np.ndarray, force: np.ndarray, radius: float = 1e-3) -> np.ndarray:
    presses = zip(x.tolist(), y.tolist(), force.tolist(), strict=True)
    return np.array([touch_charge(sensor, press(sensor.film, Circle(radius), (a, b), f)) for a, b, f in presses])


def draw(made: ForwardMap, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Presses over all that the map covers."""
    rng = np.random.default_rng(seed)
    z = made.radius * np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))
    return z.real, z.imag, np.exp(rng.uniform(*np.log(made.force_range), count))


def test_three_electrodes(three_map):
    x, y, force = draw(three_map, 40, seed=0)
    error = np.abs(three_map.forward(x, y, force) / direct(three_map.sensor, x, y, force) - 1.0)
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


def test_four_electrodes_with_the_probe_on_them_too(four_map):
    """Half of the presses within 2 mm of an electrode's centre."""
    x, y, force = draw(four_map, 40, seed=1)
    rng = np.random.default_rng(2)
    on = rng.uniform(8e-3, 10e-3, 20) * np.exp(
        1j * (0.5 * np.pi * rng.integers(0, 4, 20) + rng.uniform(-0.15, 0.15, 20))
    )
    x[:20], y[:20] = on.real, on.imag
    error = np.abs(four_map.forward(x, y, force) / direct(four_map.sensor, x, y, force) - 1.0)
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_ends_of_the_range(four_map, share):
    """At the centre and at the very edge, with the smallest and the largest force."""
    distance = share * four_map.radius
    x, y, force = np.array([distance, -distance]), np.zeros(2), np.array(four_map.force_range)
    np.testing.assert_allclose(four_map.forward(x, y, force), direct(four_map.sensor, x, y, force), rtol=1e-3)


def test_error_that_the_map_knows_of_is_small_and_true(four_map):
    x, y, force = draw(four_map, 30, seed=3)
    found = np.abs(four_map.forward(x, y, force) / direct(four_map.sensor, x, y, force) - 1.0)
    assert 0.0 < four_map.error <= INTERPOLATION_ERROR
    assert found.max() < 3.0 * four_map.error


@pytest.mark.parametrize("changes", [{"readout": "edge"}, {"name": "uniaxial"}])
def test_one_family_of_solves_serves_every_readout(four_map, changes):
    sensor = load_sensor("four-25um-uniaxial") if "name" in changes else replace(four_map.sensor, **changes)
    x, y, force = draw(four_map, 8, seed=4)
    other = replace(four_map, sensor=sensor)
    np.testing.assert_allclose(other.forward(x, y, force), direct(sensor, x, y, force), rtol=1e-3)


def test_calibrated_sensor(four_map):
    """Gains, shift and rotation reach the map as they reach a direct solve."""
    calibration = replace(four_map.sensor.calibration, gain={"A": 1.1}, shift=(0.5e-3, -1e-3), rotation=0.2)
    sensor = replace(four_map.sensor, calibration=calibration)
    x, y, force = draw(four_map, 8, seed=5)
    other = replace(four_map, sensor=sensor)
    np.testing.assert_allclose(other.forward(x, y, force), direct(sensor, x, y, force), rtol=1e-3)


def test_another_probe():
    made = ForwardMap.build(load_sensor("three-25um-uniaxial"), Circle(2e-3), radius=5e-3, force_range=(0.5, 1.0))
    x, y, force = draw(made, 8, seed=6)
    np.testing.assert_allclose(made.forward(x, y, force), direct(made.sensor, x, y, force, 2e-3), rtol=1e-3)


def test_one_force():
    made = ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3), radius=4e-3, force_range=(0.7, 0.7))
    x, y, force = np.array([1e-3, 0.0]), np.array([2e-3, -3e-3]), np.full(2, 0.7)
    np.testing.assert_allclose(made.forward(x, y, force), direct(made.sensor, x, y, force), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("pretension", [0.1e6, 0.5e6, 1.5e6])
def test_pretensioned_film(pretension):
    """No power law in the force any more: more solves, the same accuracy."""
    sensor = load_sensor("four-25um-biaxial")
    sensor = replace(sensor, film=replace(sensor.film, pretension=pretension))
    made = ForwardMap.build(sensor, Circle(1e-3), radius=10e-3)
    x, y, force = draw(made, 40, seed=7)
    error = np.abs(made.forward(x, y, force) / direct(sensor, x, y, force) - 1.0)
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3


def test_zero_force_is_no_charge(three_map):
    """Anywhere: an untouched film has no position; alone and among others."""
    assert not three_map.forward(np.zeros(2), np.zeros(2), np.zeros(2)).any()
    x, force = np.array([1e-3, 50e-3, np.nan, 2e-3]), np.array([0.0, 0.0, 0.0, 1.0])
    charge = three_map.forward(x, np.zeros(4), force)
    assert not charge[:3].any()
    assert np.all(charge[3] > 0.0)


def test_many_presses_are_each_of_them(three_map):
    """More than a chunk, and the order kept; untouched rows among them."""
    x, y, force = draw(three_map, 600, seed=8)
    force[::7] = 0.0
    charge = three_map.forward(x, y, force)
    assert charge.shape == (600, 3)
    for i in (0, 1, 255, 256, 300, 512, 599):
        np.testing.assert_allclose(
            charge[i], three_map.forward(x[i : i + 1], y[i : i + 1], force[i : i + 1])[0], rtol=1e-12
        )


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"force_range": (0.0, 1.0)}, r"force range: expected 0 < MIN <= MAX in N, got 0\.0 to 1\.0"),
        ({"force_range": (2.0, 1.0)}, "force range"),
        ({"force_range": (0.1, np.inf)}, "force range"),
        ({"force_range": (np.nan, 1.0)}, "force range"),
        ({"radius": 0.0}, "radius: expected a positive number, got 0.0 mm"),
        ({"radius": np.nan}, "radius: expected a positive number"),
        ({"radius": 44.5e-3}, r"probe off the film: centre \(44\.5, 0\) mm"),
    ],
)
def test_impossible_families_are_refused(arguments, message):
    with pytest.raises(SceneError, match=message):
        ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3), **arguments)


def test_too_thick_a_film_is_refused():
    sensor = load_sensor("three-25um-biaxial")
    thick = replace(sensor, film=replace(sensor.film, thickness=110e-6))
    with pytest.raises(SceneError, match=r"a film of 110 um at 0\.05 N carries about 8% of its load by bending"):
        ForwardMap.build(thick, Circle(1e-3))


def test_a_map_that_interpolates_badly_is_refused():
    """The stress of a mesh too coarse is no smooth function of the place, and more solves do not help."""
    family = {"radius": 4e-3, "force_range": (0.5, 1.0), "resolution": Resolution(3, 8, 2)}
    with pytest.raises(SolveError, match=r"up to 4 mm and 1 N interpolates to 0\.\d+ only, expected 0\.0005"):
        ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3), **family)


@pytest.mark.slow
def test_map_over_most_of_the_film():
    """Far out the mesh is finer, and the electrodes are still met."""
    made = ForwardMap.build(load_sensor("four-25um-biaxial"), Circle(1e-3), radius=22e-3, force_range=(0.5, 1.0))
    assert made.resolution.order > 4
    x, y, force = draw(made, 20, seed=9)
    error = np.abs(made.forward(x, y, force) / direct(made.sensor, x, y, force) - 1.0)
    assert error.max() < 5e-3


def test_result_does_not_depend_on_the_executor(two_processes):
    sensor, family = load_sensor("three-25um-biaxial"), {"radius": 4e-3, "force_range": (0.5, 1.0)}
    here = ForwardMap.build(sensor, Circle(1e-3), **family)
    there = ForwardMap.build(sensor, Circle(1e-3), **family, executor=two_processes)
    assert here.table.tobytes() == there.table.tobytes()
    assert here.error == there.error


def test_progress_is_told():
    told = []
    made = ForwardMap.build(
        load_sensor("three-25um-biaxial"),
        Circle(1e-3),
        radius=4e-3,
        force_range=(0.9, 1.0),
        progress=lambda done, total: told.append((done, total)),
    )
    count = made.nodes.distance.size
    assert told[-count:] == [(i, count) for i in range(1, count + 1)]


def test_nodes_are_chebyshevs_in_the_distance_and_in_the_logarithm_of_the_force():
    nodes = Nodes.spread(8e-3, (0.05, 2.0), (8, 3))
    low, high = np.log([0.05, 2.0])
    np.testing.assert_allclose(nodes.distance, 4e-3 * (1.0 + np.polynomial.chebyshev.chebpts1(8)), rtol=1e-12)
    expected = 0.5 * (low + high) + 0.5 * (high - low) * np.polynomial.chebyshev.chebpts1(3)
    np.testing.assert_allclose(np.log(nodes.force), expected, rtol=1e-12)


def test_nodes_interpolate_what_charges_look_like():
    """A power of the force times a smooth function of the distance, at the first and at the last number of nodes."""
    rng = np.random.default_rng(9)
    distance, force = 8e-3 * np.sqrt(rng.random(200)), np.exp(rng.uniform(np.log(0.05), np.log(2.0), 200))

    def smooth(d: np.ndarray, f: np.ndarray) -> np.ndarray:
        return f**0.02 / (1.0 + (d / 12e-3) ** 2)

    for count, expected in (((8, 3), 1e-4), ((15, 8), 1e-7)):
        nodes = Nodes.spread(8e-3, (0.05, 2.0), count)
        values = smooth(nodes.distance[:, None], nodes.force[None, :]).ravel()
        np.testing.assert_allclose(nodes.weights(distance, force) @ values, smooth(distance, force), rtol=expected)
        assert nodes.distance.min() > 0.0
        assert nodes.force.max() < 2.0
