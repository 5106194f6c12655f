"""Fixtures for the tests of this folder: a small dataset, a network after a short training, and a film."""

import pytest
from tests.train.short_training import short_training

from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.simulate.identifiability import working_area
from isocharge.train import CalibrationProblem, TrainingData, fit
from isocharge.train.training import contact_training, cross_fit
from isocharge.train.training.training_data import Split
from kept import kept

QUICK = short_training(32, 24, 150, 200, 2_000)


@pytest.fixture(scope="module", autouse=True)
def rough_training():
    """Search for folds on few rings, train fewer networks in a cross-validation, and fit the covariance roughly."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(working_area, "RADIUS_STEP", 0.5)
        patch.setattr(cross_fit, "N_FOLDS", 3)
        patch.setattr(contact_training, "REFIT_PRESSES", 1)
        patch.setattr(contact_training, "LOSS_TOLERANCE", 1e-3)
        yield


@pytest.fixture(scope="session")
def sensor():
    return load_sensor("three-25um-biaxial")


@pytest.fixture(scope="session")
def film(sensor):
    """The simulated map from contacts to charges of the sensor."""
    return kept(ForwardMap.build, sensor, Circle(1.0))


@pytest.fixture(scope="session")
def dataset_folder(film, tmp_path_factory):
    return write_sweep(tmp_path_factory.mktemp("data") / "presses", (film,), Sweep(samples=6_000, outside=2_000))


@pytest.fixture(scope="session")
def dataset(dataset_folder):
    return read_dataset(dataset_folder)


@pytest.fixture(scope="module")
def split(dataset):
    """The dataset, split into presses for training and for the test, with the charge series of all presses."""
    return kept(Split.by_position, TrainingData.of(dataset), QUICK.training)


@pytest.fixture(scope="module")
def fitted(dataset):
    """A network after a short training, with everything that a release needs."""
    return kept(fit, dataset, QUICK)


@pytest.fixture(scope="session")
def problem():
    """The calibration problem of a sensor with four electrodes."""
    return CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))
