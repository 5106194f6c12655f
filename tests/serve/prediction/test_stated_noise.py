"""Standard deviations of released models for a stated noise, against closed formulas and against simulated presses."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from drawn_contacts import draw_contacts
from isocharge.common.errors import ChargeError
from isocharge.serve import Frame, Predictor, TouchStream, device_from_table
from isocharge.serve.live.device import create_stages
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.thermal import Warming
from isocharge.simulate import Circle, ForwardMap, NoiseModel, load_sensor
from kept import kept

NAME = "four-25um-biaxial"

PRESS_pC = np.array([1200.0, 800.0, 700.0, 900.0])
"""Charges of a press, pC."""


@pytest.fixture(scope="module")
def released():
    return Predictor(NAME)


@pytest.fixture(scope="module")
def pressed():
    """Contacts (x, y, F), shape (n, 3), in the working area, and their charges, pC, from the finite-element solver."""
    contact = draw_contacts(3, 1500, 8.0, (0.1, 2.0))
    solved = kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0))  # of the same film
    return contact, replace(solved, sensor=load_sensor(NAME)).charges(contact)


@pytest.mark.parametrize("gain", [0.002, 0.007, 0.015, 0.03])
def test_intervals_for_a_stated_noise_hold_as_often_as_they_state(released, pressed, gain):
    contact, charge_pC = pressed
    noisy_pC = NoiseModel("bench", 1.0, gain).add(charge_pC, np.random.default_rng(1))
    contacts = np.asarray(released.with_noise(1.0, gain).predict_batch(noisy_pC), float)
    error = np.abs(contacts[:, :3] - contact) / contacts[:, 3:6]
    assert 0.65 < np.mean(error < 1.0) < 0.71
    assert 0.93 < np.mean(error < 1.96) < 0.97
    assert np.mean(contacts[:, 6] > 5.0) < 0.01  # few misfits
    assert np.median(contacts[:, 6]) == pytest.approx(0.674, rel=0.2)  # that of the magnitude of a normal variable


def covariance(values):
    """Return the covariance of x, y and the force from the ten values of a contact, shape (3, 3)."""
    correlation = np.eye(3)
    correlation[[0, 0, 1, 1, 2, 2], [1, 2, 2, 0, 0, 1]] = np.tile(values[7:], 2)
    return correlation * np.outer(values[3:6], values[3:6])


def test_covariance_for_a_stated_noise_is_that_of_the_linearised_problem(released):
    """The Jacobian J comes from small changes of the charges: the added covariance is J diag(s'^2 - s^2) J^T."""
    steps = 2.0 * np.eye(4)
    charge_pC = np.concatenate([[PRESS_pC], PRESS_pC + steps, PRESS_pC - steps])
    plain, *stepped = np.asarray(released.predict_batch(charge_pC), float)
    stated = np.asarray(released.with_noise(np.full(4, 2.0), 0.005).predict_batch([PRESS_pC]), float)[0]
    up, down = np.split(np.array(stepped)[:, :3], 2)
    jacobian = (up - down).T / 4.0
    extra = 4.0 - 1.0 + (0.005**2 - 0.002**2) * PRESS_pC**2
    added = jacobian @ np.diag(extra) @ jacobian.T
    np.testing.assert_allclose(covariance(stated) - covariance(plain), added, rtol=0.02, atol=1e-7)
    np.testing.assert_allclose(stated[:3], plain[:3], rtol=1e-5)


def test_smaller_noise_than_in_the_training_changes_nothing(released):
    assert released.with_noise(0.5, 0.001).predict(PRESS_pC) == pytest.approx(released.predict(PRESS_pC), rel=1e-6)


def test_noise_of_a_device_file_and_at_rest_widens_the_contacts_of_a_stream_and_of_predict(released, tmp_path, command):
    device = device_from_table({"noise": {"gain": 0.015}}, "b")
    setup = Setup(released.metadata.electrodes, device, released)
    frame = Frame(None, None, (), charge_pC=PRESS_pC, is_contact=True)
    for rest_noise_pC, white_pC in ((3.0, 3.0), (1.4, 1.0)):
        frame.noise_pC = np.array(rest_noise_pC)
        (prediction,) = create_stages(setup, needs_contact=True)
        prediction.step(frame)
        expected = released.with_noise(white_pC, 0.015).predict(PRESS_pC)
        assert frame.contact == expected
    assert pickle.loads(pickle.dumps(setup.predictor)).predict(PRESS_pC) == expected

    presses, board = tmp_path / "presses.csv", tmp_path / "board.toml"
    presses.write_text("A,B,C,D\n1200,800,700,900\n")
    board.write_text("[noise]\ngain = 0.015\n")
    _, out, _ = command("serve", "predict", NAME, presses, "--json", "--device", board)
    assert json.loads(out)["x_std_mm"] == pytest.approx(expected.x_std_mm, rel=1e-5)


def test_contact_contains_the_error_of_the_warming(released):
    frame = Frame(None, None, (), charge_pC=PRESS_pC, is_contact=True, warming_error_pC=np.full(4, 5.0))
    frame.noise_pC = np.zeros(4)
    (prediction,) = create_stages(Setup(released.metadata.electrodes, predictor=released), needs_contact=True)
    prediction.step(frame)
    drawn_pC = PRESS_pC + np.random.default_rng(0).normal(0.0, 5.0, (2000, 1))
    spread = np.std(np.asarray(released.predict_batch(drawn_pC)), axis=0)[:3]
    np.testing.assert_allclose(frame.contact[3:6], np.hypot(released.predict(PRESS_pC)[3:6], spread), rtol=0.1)


def test_warming_is_estimated_with_the_noise_of_the_device_file(released):
    stream = TouchStream(released, device_from_table({"noise": {"gain": 0.015}, "common_mode": {}}, "b"))
    stream.use(released)
    (warming,) = [stage for stage in stream._stages if isinstance(stage, Warming)]
    assert warming._setup.model.noise.gain == 0.015


@pytest.mark.parametrize("noise", [(-1.0, 0.0), (1.0, np.inf), ([1.0] * 3, 0.0)])
def test_noise_that_is_no_standard_deviation_is_refused(released, noise):
    with pytest.raises(
        ChargeError, match=r"noise(: |\.)(white_pC|gain): expected (a number from 0|one number for each of 4)"
    ):
        released.with_noise(*noise)


def test_charges_of_the_stated_white_noise_are_no_touch(released):
    std_pC = [20.0, 1.0, 20.0, 1.0]
    noise_pC = np.random.default_rng(0).normal(0.0, std_pC, (100, 4))
    assert released.validity.is_touch(noise_pC).mean() > 0.9
    is_touch = released.with_noise(std_pC, 0.002).validity.is_touch
    assert not is_touch(noise_pC).any()
    assert is_touch(noise_pC[:, ::-1]).mean() > 0.9
