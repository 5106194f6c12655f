"""Fixtures for calibrations with the released networks for all films, and presses on films drawn from their priors."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, calibrate, write_calibration
from isocharge.train.calibration import calibrate as calibrate_module
from isocharge.train.calibration import contact_error
from isocharge.train.data.presses import draw_contacts
from kept import kept


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Average errors over fewer contacts, and plan with fewer positions.

    A calibration then takes a fourth of the time.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact_error, "N_CONTACTS", 50)
        patch.setattr(contact_error, "N_CANDIDATE_POSITIONS", 30)
        yield


@pytest.fixture(scope="module")
def no_closed_backs():
    """Assume that the back of every film is vented.

    The comparison with a closed back solves each press directly, and takes half of the time of a calibration.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate_module, "has_closed_back", lambda *_: False)
        yield


@pytest.fixture(scope="session", params=["four-25um-biaxial", "three-25um-biaxial"])
def layout(request) -> CalibrationProblem:
    """The calibration problem of a sensor with four electrodes, and that of a sensor with three."""
    return CalibrationProblem.of(load_sensor(request.param), Circle(1.0))


def add_discrepancy(contact: np.ndarray, charge: np.ndarray) -> np.ndarray:
    """Return charges with errors of 3 % that no parameter describes, different for each electrode."""
    x, y, _ = contact.T
    return charge * np.exp(0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(4)]))


def calibration_with_discrepancy(sensor: str):
    """Return the parameters of a film with this discrepancy and its calibration with 20 presses."""
    problem = CalibrationProblem.of(load_sensor(sensor), Circle(1.0))
    truth, presses = rig(problem, 20, seed=41)
    charge = add_discrepancy(presses.contact, presses.charge_pC)
    result = calibrate(measured_presses(problem, presses.contact, charge), problem)
    assert result.summary  # is computed here, so that it is stored with the result
    return truth, result


@pytest.fixture(scope="module")
def film_with_discrepancy():
    """Parameters and calibration of a film with a discrepancy."""
    return kept(calibration_with_discrepancy, "four-25um-biaxial")


def rig(problem, count, seed, position_std_mm=0.1, force_std=0.01) -> tuple[np.ndarray, MeasuredPresses]:
    """Draw a film from the prior, and measure presses on it with a simulated rig.

    Returns:
        Parameters of the film, and presses with noisy charges and with errors of position and force.
    """
    rng = np.random.default_rng(seed)
    parameters = problem.prior.draw(rng, 1)[0]
    contact = draw_contacts(rng, problem.domain, count)
    charge = problem.noise.add(problem.charges.charges(parameters, contact), rng)
    contact[:, :2] += position_std_mm * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(force_std * rng.standard_normal(count))
    return parameters, measured_presses(problem, contact, charge, position_std_mm, force_std)


DEGREE_MPa = 0.35
"""Change of the pretension on an aluminium ring if the temperature changes by one kelvin, MPa."""


def film_of(problem):
    """Return the parameters of a film that differs from the described one, with a pretension of 1 MPa."""
    return np.append(1.0, problem.prior.draw(np.random.default_rng(1), 1)[0][1:])


def calibrated_files(sensor: str, seed: int) -> dict[str, bytes]:
    """Calibrate a film by twenty presses, and return the files of its model folder by their paths."""
    problem = CalibrationProblem.of(load_sensor(sensor), Circle(1.0))
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, problem.domain, 20)
    charge = problem.noise.add(problem.charges.charges(film_of(problem), contact), rng)
    contact *= np.exp([0.0, 0.0, 0.01] * rng.standard_normal((20, 3)))
    contact[:, :2] += 0.1 * rng.standard_normal((20, 2))
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        # The directions of the film need more contacts than the fixture `coarse` sets.
        patch.setattr(contact_error, "N_CONTACTS", 200)
        path = Path(folder) / "mine"
        write_calibration(calibrate(measured_presses(problem, contact, charge), problem), path)
        return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def write_files(folder, files):
    """Write the files of a model folder, which are given as bytes by their paths, and return the folder."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.fixture(scope="module")
def mine(tmp_path_factory) -> Path:
    """The folder of the calibrated film."""
    folder = tmp_path_factory.mktemp("films") / "mine"
    return write_files(folder, kept(calibrated_files, "four-25um-biaxial", 5))


@pytest.fixture(scope="module")
def film(problem):
    """A function that returns the forward map of the film with a pretension, which is rounded to 0.01 MPa."""
    parameters = film_of(problem)

    @cache
    def map_at(hundredths_of_MPa):
        return problem.charges.forward_map(np.append(0.01 * hundredths_of_MPa, parameters[1:]))

    return lambda pretension: map_at(round(100 * pretension))


def follow_touches(follower, charges, interval_s=5.0):
    """Let a follower observe touches, each by its frame with the largest force.

    Args:
        follower: The follower.
        charges: Charge of this frame of each touch, shape (n, 4), pC.
        interval_s: Time between touches, s.
    """
    for number, charge in enumerate(charges):
        contact = follower.predictor.predict(charge)
        flags = follower.predictor.flags(contact)
        follower.observe_frame(charge, contact, flags, interval_s * number)
        follower.observe_frame(None, None, (), interval_s * (number + 0.5))


def touch_charges(problem, film, predictor, pretension, count, seed):
    """Draw contacts below the yield force, shape (n, 3), and return them with their noisy charges, shape (n, 4), pC."""
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, problem.domain, count)
    contact[:, 2] = np.minimum(contact[:, 2], 0.95 * predictor.validity.yield_force_N)
    return contact, problem.noise.add(film(pretension).charges(contact), rng)


def rms_errors(errors):
    """Return the root mean squares of the position errors, mm, and of the force errors, %.

    Args:
        errors: Errors of the position, mm, and of ln F, shape (n, 2).
    """
    return np.sqrt(np.mean(errors**2, axis=0)) * [1.0, 100.0]
