"""A film in a room that warms: what a kelvin does, learned by presses, and the film at another temperature."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.train.calibration.conftest import presses_of

from isocharge.common.errors import PressError
from isocharge.common.json_values import plain_values
from isocharge.serve import Predictor, check_presses, read_presses, write_presses
from isocharge.simulate import Circle, load_sensor, press, touch_charge
from isocharge.train import calibrate, read_earlier, write_calibration
from isocharge.train.calibration.folder import read_moved, result_table
from isocharge.train.calibration.press_data import temperatures
from isocharge.train.calibration.problem import CREEP, DRIFT
from isocharge.train.data.presses import draw_contacts
from kept import kept

PER_K = 3000.0 * 7.7e-5 / (1.0 - 0.34)
"""E da / (1 - nu): what a kelvin takes of the tension of a film that grows by 7.7e-5 more than its ring, MPa."""

CALIBRATE = ("train", "calibrate", "--sensor", "four-25um-biaxial")

DAY = np.random.default_rng(2).permutation(np.linspace(20.0, 23.0, 12))


def charges_at(contacts, pretensions):
    """By a direct solve for each press."""
    sensor = load_sensor("four-25um-biaxial")
    solved = []
    for (x, y, force), pretension in zip(contacts, pretensions, strict=True):
        film = replace(sensor.film, pretension=pretension)
        solved.append(touch_charge(replace(sensor, film=film), press(film, Circle(1.0), (x, y), force)))
    return np.array(solved)


def pressed(problem, seed, temperature_C):
    """Presses on the film of 1.1 MPa at 21.5 C, as a rig reads them."""
    rng = np.random.default_rng(seed)
    count = len(temperature_C)
    contact = draw_contacts(rng, problem.domain.within(7.5), count)
    charge = problem.noise.add(kept(charges_at, contact, 1.1 - PER_K * (temperature_C - 21.5)), rng)
    contact[:, :2] += 0.1 * rng.standard_normal((count, 2))
    contact[:, 2] *= np.exp(0.01 * rng.standard_normal(count))
    return replace(presses_of(problem, contact, charge), temperature_C=temperature_C)


@pytest.fixture(scope="module")
def day(problem):
    return calibrate(pressed(problem, 5, DAY), problem)


def written(result, folder):
    """What the next calibration reads of the folder of this one."""
    (folder / "calibration.json").write_text(json.dumps(plain_values(result_table(result))))
    return folder


def test_what_a_kelvin_does_is_learned_and_said(day):
    """The closed form of the ring, on charges of direct solves."""
    known = day.posterior.warming
    assert known.MPa_per_K == pytest.approx(-PER_K, abs=2.5 * known.std)
    assert known.std < 0.06
    assert day.posterior.parameters[0] == pytest.approx(1.1, abs=0.2)
    assert f"The pretension changes by {known.MPa_per_K:.3g}" in " ".join(day.summary)


def test_pretension_per_kelvin_of_the_film_above_its_ring_is_estimated(problem):
    """Presses with the column film_temperature_C, on charges of direct solves; the ring stays at 21 C."""
    per_film_K = 1e-4 * 3000.0 / (1.0 - 0.34)
    excess_K = np.random.default_rng(3).permutation(np.linspace(-1.0, 1.0, 12))
    rng = np.random.default_rng(6)
    contact = draw_contacts(rng, problem.domain.within(7.5), 12)
    charge = problem.noise.add(kept(charges_at, contact, 1.1 - per_film_K * excess_K), rng)
    ring_C = np.full(12, 21.0)
    presses = replace(
        presses_of(problem, contact, charge, 0.02, 0.003), temperature_C=ring_C, film_temperature_C=ring_C + excess_K
    )
    result = calibrate(presses, problem)
    estimate = result.posterior.nuisances["pretension_per_film_K"]
    assert estimate.value == pytest.approx(-per_film_K, abs=2.5 * estimate.std)
    assert estimate.std < 0.06
    assert result.posterior.parameters[0] == pytest.approx(1.1, abs=0.15)
    assert "per kelvin that the film is warmer than its ring" in " ".join(result.summary)


def test_film_temperature_is_written_read_and_refused_without_that_of_the_ring(problem, tmp_path):
    presses = replace(
        pressed(problem, 5, DAY)[:3],
        temperature_C=np.array([20.0, 20.1, 20.2]),
        film_temperature_C=np.array([20.5, np.nan, 21.0]),
    )
    write_presses(tmp_path / "presses.csv", presses)
    assert "film_temperature_C" in (tmp_path / "presses.csv").read_text()
    assert read_presses(tmp_path / "presses.csv", problem.electrodes) == presses
    with pytest.raises(PressError, match="expected also the temperature of the ring in the column temperature_C"):
        replace(presses, temperature_C=None)


def test_the_film_at_another_temperature(day, tmp_path, command):
    _, out, _ = command(*CALIBRATE, "--from", written(day, tmp_path), "--temperature", "20.5", "--json")
    table = json.loads(out)
    known = day.posterior.warming
    change = 1e-6 * table["parameters"]["pretension"]["value"] - day.posterior.parameters[0]
    assert change == pytest.approx(-known.MPa_per_K * (known.at_C - 20.5))
    assert table["temperature"]["at_C"] == 20.5
    assert table["error_left"]["force_percent"] > day.error_left.force_percent  # by what is not known of a kelvin
    assert table["words"][1].startswith("The film was moved from 21.5 C")


def test_there_and_back_is_the_same_film(day, tmp_path, problem):
    """Film and change are one Gaussian, and a temperature a linear map of it."""
    there = read_moved(written(day, tmp_path), problem, 23.5)
    back = read_moved(written(there, tmp_path), problem, 21.5).posterior
    np.testing.assert_allclose(back.covariance, day.posterior.covariance, atol=2e-5)  # correlations have six digits
    assert back.parameters == pytest.approx(day.posterior.parameters)


def test_a_pretension_drifts_less_where_both_temperatures_are_known(day, problem):
    """By the thermometer's error alone, and by a degree or two unless what a kelvin does is known, too."""
    before = day.posterior
    unknown = replace(day.posterior, warming=None)
    after = [
        estimate.drifted(problem.prior, knows_temperature=knows) for estimate in (before, unknown) for knows in (1, 0)
    ]
    wider = [float(estimate.covariance[0, 0] - before.covariance[0, 0]) for estimate in after]
    assert wider == pytest.approx([CREEP**2, *[DRIFT["pretension"] ** 2] * 3])


@pytest.mark.parametrize(
    ("std", "to_C", "why"),
    [(0.3, 20.5, "contains the change of the film with temperature"), (0.03, 60.0, "nearer to that of the presses")],
)
def test_a_film_is_not_moved_farther_than_is_known(day, problem, tmp_path, std, to_C, why):
    vague = replace(day.posterior, warming=day.posterior.warming._replace(std=std))
    with pytest.raises(PressError, match=why):
        read_moved(written(replace(day, posterior=vague), tmp_path), problem, to_C)


def test_another_morning_tells_more(day, tmp_path, problem):
    """Three presses two degrees on: the film is given at their temperature, and a kelvin is known better."""
    earlier = read_earlier(written(day, tmp_path), problem, knows_temperature=True)
    later = calibrate(pressed(problem, 6, np.full(3, 23.5)), replace(problem, earlier=earlier)).posterior
    assert later.warming.at_C == pytest.approx(23.5)
    assert later.warming.std < day.posterior.warming.std
    assert later.parameters[0] == pytest.approx(1.1 - 2.0 * PER_K, abs=0.2)


def test_temperatures_in_a_file(tmp_path, problem):
    """Unknown ones lie between those before and after; what none can be is named."""
    presses = replace(pressed(problem, 5, DAY)[:4], temperature_C=np.array([20.0, np.nan, 22.0, np.nan]))
    write_presses(tmp_path / "presses.csv", presses)
    again = read_presses(tmp_path / "presses.csv", problem.electrodes)
    assert again == presses
    np.testing.assert_allclose(temperatures(again), [20.0, 21.0, 22.0, 22.0])
    assert not again[[1, 3]].knows_temperature
    with pytest.raises(PressError, match=r"line 3, column 'temperature_C': expected a temperature of -100 to 200"):
        replace(presses, temperature_C=np.array([20.0, 295.0, 20.0, 20.0]))


@pytest.mark.slow
def test_the_folder_at_another_temperature_fits(day, problem, tmp_path, command):
    """Presses at 20.5 C fit the film of that temperature, and not that of the day."""
    write_calibration(day, tmp_path / "day")
    assert command(*CALIBRATE, "--from", tmp_path / "day", "--temperature", "20.5", "-o", tmp_path / "cold")[0] == 0
    assert "-biaxial`, moved from 21.5 C, day/1, to 20.5 C by the" in (tmp_path / "cold" / "card.md").read_text()
    presses = replace(pressed(problem, 7, np.full(10, 20.5)), temperature_C=None)
    checks = [check_presses(Predictor(tmp_path / name), presses) for name in ("day", "cold")]
    assert [check.fits for check in checks] == [False, True]
