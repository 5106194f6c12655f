"""One small dataset and one short training, shared by the tests of this folder."""

import pytest

from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, run_sweep, solve_maps
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network

QUICK = FitConfig(
    NetworkConfig(hidden=(32, 32), misfit_hidden=(24, 24)),
    TrainingConfig(steps=400, misfit_steps=600, misfit_charges=4_000, batch=256),
)


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    """Nothing is kept from one test to another, or in the user's own cache."""
    monkeypatch.setenv("ISOCHARGE_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="session")
def sensor():
    return load_sensor("three-25um-biaxial")


@pytest.fixture(scope="session")
def film(sensor):
    """The forward map: the simulator's own word on every charge."""
    return solve_maps(sensor, (Circle(1e-3),), Sweep())[0]


@pytest.fixture(scope="session")
def dataset(sensor, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "presses"
    return read_dataset(run_sweep(folder, sensor, (Circle(1e-3),), Sweep(samples=6_000)))


@pytest.fixture(scope="session")
def fit(dataset):
    return fit_network(dataset, QUICK)
