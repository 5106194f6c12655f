"""Fixtures for calibrations with the released networks for all films, and presses on films drawn from their priors."""

import numpy as np
import pytest

from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, calibrate
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
    """Change charges by 3 % that no parameter describes, differently for each electrode."""
    x, y, _ = contact.T
    return charge * np.exp(0.03 * np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(4)]))


def calibration_with_discrepancy(sensor: str):
    """Return the parameters of a film with this discrepancy and its calibration with 20 presses."""
    problem = CalibrationProblem.of(load_sensor(sensor), Circle(1.0))
    truth, presses = rig(problem, 20, seed=41)
    charge = add_discrepancy(presses.contact, presses.charge_pC)
    return truth, calibrate(presses_of(problem, presses.contact, charge), problem)


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
    return parameters, presses_of(problem, contact, charge, position_std_mm, force_std)


def presses_of(problem, contact, charge, position_std_mm=0.1, force_std=0.01) -> MeasuredPresses:
    """Return measured presses, which are on the lines 2, 3, ... of a file."""
    count = len(contact)
    return MeasuredPresses(
        contact=contact,
        charge_pC=charge,
        position_std_mm=np.full(count, position_std_mm),
        force_std=np.full(count, force_std),
        electrodes=problem.electrodes,
        lines=tuple(range(2, count + 2)),
    )
