"""Settings and fixtures that the tests of the simulator share: a film, forward maps and a dataset."""

from pathlib import Path

import pytest

from isocharge.simulate import Circle, Film, ForwardMap, Resolution, SolveSettings, Sweep, Theory, load_sensor
from isocharge.simulate.dataset.sweep import write_sweep
from kept import kept

COARSE = SolveSettings(theory=Theory(bending=False), resolution=Resolution(4, 8, 4))
"""Membrane theory on a coarse mesh. A small family is solved in half a second."""


@pytest.fixture(scope="session")
def film() -> Film:
    """The film of the built-in sensors."""
    return load_sensor("three-25um-biaxial").film


@pytest.fixture(scope="session")
def three_map() -> ForwardMap:
    """Forward map of the sensor three-25um-biaxial."""
    return kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0))


@pytest.fixture(scope="session")
def small_dataset(three_map: ForwardMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 500 samples. Tests must not change it."""
    return write_sweep(
        tmp_path_factory.mktemp("data") / "presses", (three_map,), Sweep(samples=500, seed=7, outside=2048)
    )
