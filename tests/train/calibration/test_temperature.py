"""Tests of the change of the pretension with temperature: its estimation, and films at other temperatures."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses

from isocharge.common.errors import PressError
from isocharge.common.json_values import plain_values
from isocharge.serve import Predictor, check_presses, read_presses, write_presses
from isocharge.simulate import Circle, load_sensor, press, touch_charge
from isocharge.train import calibrate, read_earlier, write_calibration
from isocharge.train.calibration.calibrate import _with_undetected_mistakes
from isocharge.train.calibration.film_fit import MISTAKE_PROBABILITY
from isocharge.train.calibration.folder import read_moved, result_table
from isocharge.train.calibration.nuisances import PRETENSION_PER_KELVIN
from isocharge.train.calibration.press_data import temperatures
from isocharge.train.calibration.problem import CREEP, DRIFT
from isocharge.train.data.presses import draw_contacts
from kept import kept

pytestmark = pytest.mark.usefixtures("no_closed_backs")

TENSION_LOSS_PER_K = 3000.0 * 7.7e-5 / (1.0 - 0.34)
"""Decrease of the pretension per kelvin, E da / (1 - nu), of a film that expands by 7.7e-5 per kelvin more than its
ring, MPa/K."""

CALIBRATE = ("train", "calibrate", "--sensor", "four-25um-biaxial")

TEMPERATURES_C = np.random.default_rng(2).permutation(np.linspace(20.0, 23.0, 12))
"""Temperature during each of the twelve presses of the fixture `calibration`."""

MEAN_C = 21.5
"""Mean of these temperatures, for which the calibration holds."""

MEAN_PRETENSION_MPa = 1.1
"""Pretension of the film at this temperature."""


def solved_charges(contacts, pretensions):
    """Solve each press directly.

    Args:
        contacts: Contacts (x, y, F), shape (n, 3), mm and N.
        pretensions: Pretension during each press, shape (n,), MPa.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    sensor = load_sensor("four-25um-biaxial")
    solved = []
    for (x, y, force), pretension in zip(contacts, pretensions, strict=True):
        film = replace(sensor.film, pretension=pretension)
        solved.append(touch_charge(replace(sensor, film=film), press(film, Circle(1.0), (x, y), force)))
    return np.array(solved)


def presses_at_temperatures(problem, seed, temperature_C):
    """Return presses of a simulated rig on the film at different temperatures, shape (n,), degrees Celsius."""
    rng = np.random.default_rng(seed)
    count = len(temperature_C)
    contact = draw_contacts(rng, problem.domain.within(7.5), count)
    pretensions = MEAN_PRETENSION_MPa - TENSION_LOSS_PER_K * (temperature_C - MEAN_C)
    charge = problem.noise.add(kept(solved_charges, contact, pretensions), rng)
    contact[:, :2] += 0.1 * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(0.01 * rng.standard_normal(count))
    return replace(measured_presses(problem, contact, charge), temperature_C=temperature_C)


@pytest.fixture(scope="module")
def calibration(problem):
    """A calibration by presses at temperatures from 20 to 23 degrees Celsius."""
    return calibrate(presses_at_temperatures(problem, 5, TEMPERATURES_C), problem)


def write_result(result, folder):
    """Write the part of a calibration that the next calibration reads, and return the folder."""
    (folder / "calibration.json").write_text(json.dumps(plain_values(result_table(result))))
    return folder


def test_change_of_the_pretension_per_kelvin_is_estimated_and_in_the_summary(calibration):
    """The charges are solved directly, and the expected change is the closed form for a film on a ring."""
    warming = calibration.posterior.warming
    assert warming.MPa_per_K == pytest.approx(-TENSION_LOSS_PER_K, abs=2.5 * warming.std)
    assert warming.std < 0.06
    assert calibration.posterior.parameters[0] == pytest.approx(MEAN_PRETENSION_MPa, abs=0.2)
    assert f"The pretension changes by {warming.MPa_per_K:.3g}" in " ".join(calibration.summary)


def test_pretension_per_kelvin_of_the_film_above_its_ring_is_estimated(problem):
    """The presses have the column film_temperature_C, and the ring stays at 21 degrees Celsius."""
    per_film_K = 1e-4 * 3000.0 / (1.0 - 0.34)
    excess_K = np.random.default_rng(3).permutation(np.linspace(-1.0, 1.0, 12))
    rng = np.random.default_rng(6)
    contact = draw_contacts(rng, problem.domain.within(7.5), 12)
    charge = problem.noise.add(kept(solved_charges, contact, MEAN_PRETENSION_MPa - per_film_K * excess_K), rng)
    ring_C = np.full(12, 21.0)
    presses = replace(
        measured_presses(problem, contact, charge, 0.02, 0.003),
        temperature_C=ring_C,
        film_temperature_C=ring_C + excess_K,
    )
    result = calibrate(presses, problem)
    estimate = result.posterior.nuisances["pretension_per_film_K"]
    assert estimate.value == pytest.approx(-per_film_K, abs=2.5 * estimate.std)
    assert estimate.std < 0.06
    assert result.posterior.parameters[0] == pytest.approx(1.1, abs=0.15)
    assert "per kelvin that the film is warmer than its ring" in " ".join(result.summary)


def test_film_temperature_is_written_and_read_and_refused_without_the_ring_temperature(problem, tmp_path):
    presses = replace(
        presses_at_temperatures(problem, 5, TEMPERATURES_C)[:3],
        temperature_C=np.array([20.0, 20.1, 20.2]),
        film_temperature_C=np.array([20.5, np.nan, 21.0]),
    )
    write_presses(tmp_path / "presses.csv", presses)
    assert "film_temperature_C" in (tmp_path / "presses.csv").read_text()
    assert read_presses(tmp_path / "presses.csv", problem.electrodes) == presses
    with pytest.raises(PressError, match="expected also the temperature of the ring in the column temperature_C"):
        replace(presses, temperature_C=None)


def test_calibrate_moves_a_film_to_another_temperature(calibration, tmp_path, command):
    folder = write_result(calibration, tmp_path)
    _, out, _ = command(*CALIBRATE, "--from", folder, "--temperature", "20.5", "--json")
    table = json.loads(out)
    warming = calibration.posterior.warming
    change_MPa = 1e-6 * table["parameters"]["pretension"]["value"] - calibration.posterior.parameters[0]
    assert change_MPa == pytest.approx(-warming.MPa_per_K * (warming.at_C - 20.5))
    assert table["temperature"]["at_C"] == 20.5
    # The change per kelvin is uncertain, so the error is larger at another temperature.
    assert table["error_left"]["force_percent"] > calibration.film_error.force_percent
    assert table["words"][1].startswith("The film was moved from 21.5 C")


def test_moving_a_film_to_a_temperature_and_back_restores_the_film(calibration, tmp_path, problem):
    warm = read_moved(write_result(calibration, tmp_path), problem, 23.5)
    restored = read_moved(write_result(warm, tmp_path), problem, MEAN_C).posterior
    expected = calibration.posterior
    np.testing.assert_allclose(restored.covariance, expected.covariance, atol=2e-5)  # correlations have six digits
    assert restored.parameters == pytest.approx(expected.parameters)


@pytest.mark.parametrize("knows_temperature", [False, True])
@pytest.mark.parametrize("knows_change", [False, True])
def test_pretension_drifts_by_creep_only_if_temperature_and_change_per_kelvin_are_known(
    calibration, problem, knows_temperature, knows_change
):
    estimate = calibration.posterior
    if not knows_change:
        estimate = replace(estimate, warming=None)
    drifted = estimate.drifted(problem.prior, knows_temperature=knows_temperature)
    added_variance = drifted.covariance[0, 0] - estimate.covariance[0, 0]
    expected_std = CREEP if knows_temperature and knows_change else DRIFT["pretension"]
    assert added_variance == pytest.approx(expected_std**2)


@pytest.mark.parametrize(
    ("std_MPa_per_K", "to_C", "message"),
    [(0.3, 20.5, "contains the change of the film with temperature"), (0.03, 60.0, "nearer to that of the presses")],
    ids=["change per kelvin is uncertain", "temperature is far"],
)
def test_film_is_not_moved_by_an_uncertain_change_or_to_an_impossible_pretension(
    calibration, problem, tmp_path, std_MPa_per_K, to_C, message
):
    posterior = calibration.posterior
    changed = replace(posterior, warming=posterior.warming._replace(std=std_MPa_per_K))
    folder = write_result(replace(calibration, posterior=changed), tmp_path)
    with pytest.raises(PressError, match=message):
        read_moved(folder, problem, to_C)


def test_presses_at_another_temperature_improve_the_change_per_kelvin(calibration, tmp_path, problem):
    """The film after three presses at 23.5 degrees Celsius is given at the temperature of these presses."""
    earlier = read_earlier(write_result(calibration, tmp_path), problem, knows_temperature=True)
    warm_presses = presses_at_temperatures(problem, 6, np.full(3, 23.5))
    later = calibrate(warm_presses, replace(problem, earlier=earlier)).posterior
    assert later.warming.at_C == pytest.approx(23.5)
    assert later.warming.std < calibration.posterior.warming.std
    assert later.parameters[0] == pytest.approx(MEAN_PRETENSION_MPa - 2.0 * TENSION_LOSS_PER_K, abs=0.2)


def test_missing_temperatures_of_a_file_are_interpolated_and_impossible_ones_are_refused(tmp_path, problem):
    temperature_C = np.array([20.0, np.nan, 22.0, np.nan])
    presses = replace(presses_at_temperatures(problem, 5, TEMPERATURES_C)[:4], temperature_C=temperature_C)
    write_presses(tmp_path / "presses.csv", presses)
    read = read_presses(tmp_path / "presses.csv", problem.electrodes)
    assert read == presses
    np.testing.assert_allclose(temperatures(read), [20.0, 21.0, 22.0, 22.0])
    assert not read[[1, 3]].knows_temperature
    with pytest.raises(PressError, match=r"line 3, column 'temperature_C': expected a temperature of -100 to 200"):
        replace(presses, temperature_C=np.array([20.0, 295.0, 20.0, 20.0]))


@pytest.mark.slow
def test_presses_at_another_temperature_fit_the_moved_model_only(calibration, problem, tmp_path, command):
    write_calibration(calibration, tmp_path / "day")
    assert command(*CALIBRATE, "--from", tmp_path / "day", "--temperature", "20.5", "-o", tmp_path / "cold")[0] == 0
    assert "-biaxial`, moved from 21.5 C, day/1, to 20.5 C by the" in (tmp_path / "cold" / "card.md").read_text()
    cold_presses = replace(presses_at_temperatures(problem, 7, np.full(10, 20.5)), temperature_C=None)
    assert not check_presses(Predictor(tmp_path / "day"), cold_presses).fits
    assert check_presses(Predictor(tmp_path / "cold"), cold_presses).fits


@pytest.mark.parametrize("has_earlier_change", [False, True])
def test_undetected_mistakes_increase_the_std_of_the_pretension_per_kelvin(calibration, problem, has_earlier_change):
    """With half of the presses left out, the variance is the mean of the variances after and before the presses."""
    posterior = calibration.posterior
    is_left_out = np.zeros(4, dtype=bool)
    is_left_out[:2] = True  # 2 of 4 presses: the probability of a mistake is 0.5, and 0.02 for the two used presses
    before = problem.before
    std_before = PRETENSION_PER_KELVIN.std_with_temperatures
    if has_earlier_change:
        std_before = 3.0 * posterior.warming.std
        before = replace(before, warming=posterior.warming._replace(std=std_before))
    uncertain = _with_undetected_mistakes(replace(posterior, bad=is_left_out), before)
    probability = 0.5 + 2 * MISTAKE_PROBABILITY
    variance = (1.0 - probability) * posterior.warming.std**2 + probability * std_before**2
    assert uncertain.warming.std == pytest.approx(np.sqrt(variance))
    # The covariance of all unknowns together with the change per kelvin has no negative eigenvalues.
    covariance = uncertain.warming.covariance[:, None]
    joint = np.block([[uncertain.joint, covariance], [covariance.T, uncertain.warming.std**2]])
    assert np.linalg.eigvalsh(joint).min() > -1e-9 * np.linalg.eigvalsh(joint).max()
