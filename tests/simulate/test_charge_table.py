"""The tabled charges against the map they were made from, and their slopes against differences."""

import numpy as np
import pytest

from isocharge.errors import SceneError
from isocharge.simulate import Circle, ForwardMap, Resolution, Theory, load_sensor
from isocharge.simulate.charge_table import ChargeTable

QUICK = {"theory": Theory(stretching=True, bending=False, pretensioned=False), "resolution": Resolution(5, 8, 5)}


@pytest.fixture(scope="module")
def made() -> ForwardMap:
    return ForwardMap.build(load_sensor("four-25um-uniaxial"), Circle(1e-3), 10e-3, (0.1, 1.0), **QUICK)


@pytest.fixture(scope="module")
def table(made) -> ChargeTable:
    return ChargeTable.of(made)


def presses(count: int, radius: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    r, angle = radius * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1), np.exp(rng.uniform(np.log(0.1), 0.0, count))


def test_table_is_the_map(made, table):
    at, force = presses(800, 10e-3)
    direct = made.forward(*at.T, force)
    error = np.abs(table.charge(at, force) / direct - 1.0).max(axis=1)
    assert np.median(error) < 3e-5
    assert error.max() < 5e-3
    assert table.error < 5e-3


def test_closer_knots_are_better(made, table):
    assert table.error < 0.5 * ChargeTable.of(made, spacing=1e-3).error


def test_slopes_are_differences(table):
    at, force = presses(100, 9.9e-3)
    value, slope, by_force = table.slopes(at, force)
    np.testing.assert_allclose(value, table.charge(at, force), rtol=1e-13)
    step = 1e-7
    for axis, aside in enumerate(step * np.eye(2)):
        difference = (table.charge(at + aside, force) - table.charge(at - aside, force)) / (2.0 * step)
        np.testing.assert_allclose(slope[..., axis], difference, atol=1e-5 * np.abs(slope).max())
    ratio = np.exp(1e-4)
    difference = (table.charge(at, force * ratio) - table.charge(at, force / ratio)) / 2e-4
    np.testing.assert_allclose(by_force, difference, rtol=1e-6)


def test_beyond_the_edge_is_the_edge(table):
    out, edge = np.array([[0.0, 12e-3]]), np.array([[0.0, 10e-3]])
    np.testing.assert_allclose(table.charge(out, 1.0), table.charge(edge, 1.0), rtol=1e-13)


@pytest.mark.parametrize("radius", [0.0, -1e-3, 11e-3, np.nan])
def test_impossible_radius_is_refused(made, radius):
    with pytest.raises(SceneError, match=r"radius: expected up to the forward map's 10 mm"):
        ChargeTable.of(made, radius)
