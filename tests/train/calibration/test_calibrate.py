"""A calibration: what is left, what is said, and what is refused, by files as people write them."""

import numpy as np
import pytest
from tests.train.calibration.conftest import contacts, presses_of, rig

from isocharge.common.errors import ModelError, PressError, SceneError
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, Polygon, load_sensor, sensor_from_dict, sensor_to_dict
from isocharge.train import calibrate, films_for, next_presses
from isocharge.train.calibration.calibrate import loosened
from isocharge.train.calibration.contact_error import ContactSensitivity
from isocharge.train.calibration.next_press import information_of


def quietly(presses, scene, earlier=None):
    return calibrate(presses, scene, earlier, warn=lambda _: None)


@pytest.mark.first_cases(1)
def test_the_error_left_is_near_the_linearised_limit(layout):
    """Asked: at most 1.25 times the limit at the true film, median over films; none beyond 2.5 times."""
    scene, ratios = layout.scene, []
    charges, scale = scene.charges, scene.charges.prior.std
    for seed in range(8):
        truth, presses = rig(charges, 8, seed=200 + seed)
        calibration = quietly(presses, scene)
        at_truth = ContactSensitivity.at(charges, truth, scene.domain, scene.noise)
        information = np.eye(truth.size) + information_of(charges, truth, presses.contact, scene.noise, 0.1, 0.01).sum(
            0
        )
        limit = at_truth.left(np.linalg.inv(information))
        wrong = at_truth.by_parameter @ ((calibration.posterior.parameters - truth) / scale)
        ratios.append(np.sqrt((wrong[:, :2] ** 2).sum(axis=1).mean()) / limit.position_mm)
    assert np.median(ratios) < 1.25
    assert max(ratios) < 2.5


def test_what_presses_tell_is_told_and_what_not_is_not(scene):
    truth, presses = rig(scene.charges, 12, seed=1)
    calibration = quietly(presses, scene)
    table = calibration.quantities
    assert table["pretension_MPa"].identified
    assert table["response_percent"].identified
    assert table["gain_A_percent"].identified
    assert not table["young_percent"].identified
    assert not table["thickness_percent"].identified
    text = " ".join(calibration.words)
    assert "cannot tell" in text
    assert "Young's modulus by itself" in text
    low, high = table["pretension_MPa"].interval_95
    assert low < 1e-6 * truth[0] < high


def test_a_few_presses_are_taken_and_said_to_be_few(scene):
    _, presses = rig(scene.charges, 1, seed=2)
    calibration = quietly(presses, scene)
    assert any("only 1 press" in caution for caution in calibration.cautions)
    assert calibration.left.position_mm > 0.2


def test_presses_in_one_place_leave_a_large_error_and_say_so(scene):
    truth = scene.charges.prior.mean
    at = np.tile([2.0, 1.0, 1.0], (8, 1))
    presses = presses_of(at, scene.charges.charge_pC(truth, at), scene.charges.prior.sensor.electrode_names)
    calibration = quietly(presses, scene)
    assert any("within 0 mm of each other" in caution for caution in calibration.cautions)
    assert calibration.left.position_mm > 0.3


def test_presses_too_far_out_are_left_out(scene):
    _, presses = rig(scene.charges, 8, seed=3)
    presses.contact[2, :2] = [12.0, 0.0]
    calibration = quietly(presses, scene)
    assert len(calibration.presses) == 7
    assert any("line 4" in caution and "left out" in caution for caution in calibration.cautions)


MISTAKES = {
    "columns": (lambda c, q: (c, q[:, [1, 0, 2, 3]]), "columns are swapped: those named A, B, C, D hold B, A, C, D"),
    "turned": (lambda c, q: (c @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]), q), "turned by -?90 degrees"),
    "mirrored": (lambda c, q: (c * [-1.0, 1.0, 1.0], q), "x is mirrored"),
    "grams": (lambda c, q: (c / [1.0, 1.0, 9.80665e-3], q), "forces are in g, not N"),
    "millinewtons": (lambda c, q: (c / [1.0, 1.0, 1e-3], q), "forces are in mN, not N"),
    "centimetres": (lambda c, q: (c / [10.0, 10.0, 1.0], q), "positions are in cm, not mm"),
    "nanocoulombs": (lambda c, q: (c, q / 1e3), "charges are in nC, not pC"),
    "metres": (lambda c, q: (c / [1e3, 1e3, 1.0], q), "written in metres"),
    "micrometres": (lambda c, q: (c * [1e3, 1e3, 1.0], q), "off the film"),
    "dead": (lambda c, q: (c, np.where(np.arange(4) == 2, 0.4, q)), "electrode 'C' is dead"),
    "negative": (lambda c, q: (c, q * [1.0, -1.0, 1.0, 1.0]), "electrode 'B': 12 of its 12 charges are negative"),
    "missing": (lambda c, q: (c, np.where(np.arange(4) == 3, np.nan, q)), "electrode 'D': no press has a charge"),
    "other rows": (lambda c, q: (c, np.roll(q, 3, axis=0)), "no film of 'four-25um-biaxial' explains"),
}


REPEATS = ("turned", "mirrored", "centimetres")
"""Mistakes that are found as those before and after them are."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in REPEATS else name for name in MISTAKES]
)
def test_a_file_written_wrongly_is_refused_with_the_reason(scene, name):
    mistake, words = MISTAKES[name]
    _, presses = rig(scene.charges, 12, seed=7)
    contact, charge = mistake(presses.contact, presses.charge_pC)
    with pytest.raises(PressError, match=words):
        quietly(presses_of(contact, charge, presses.electrodes), scene)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("seed", [41, 42, 43])
def test_four_presses_with_swapped_columns_find_no_strange_film(scene, seed):
    """So few that a film may explain most of them: still refused."""
    _, presses = rig(scene.charges, 4, seed=seed)
    with pytest.raises(PressError, match="no film of 'four-25um-biaxial' explains these 4"):
        quietly(presses_of(presses.contact, presses.charge_pC[:, [1, 0, 2, 3]], presses.electrodes), scene)


def test_another_layout_is_refused(scene):
    other = films_for(load_sensor("four-25um-uniaxial"), Circle(1e-3)).scene
    _, presses = rig(other.charges, 12, seed=8)
    with pytest.raises(PressError, match="is it this layout and this probe"):
        quietly(presses, scene)


def test_proposed_presses_tell_more_than_random_ones(scene):
    proposed = next_presses(scene.charges, scene.domain, scene.noise, 5)
    left = [press.position_mm for press in proposed]
    assert left == sorted(left, reverse=True)
    prior = scene.charges.prior
    sensitivity = ContactSensitivity.at(scene.charges, prior.mean, scene.domain, scene.noise)
    at_random = []
    for seed in range(8):
        at = contacts(np.random.default_rng(seed), 5)
        information = information_of(scene.charges, prior.mean, at, scene.noise, 0.1, 0.01).sum(axis=0)
        at_random.append(sensitivity.left(np.linalg.inv(np.eye(prior.mean.size) + information)).position_mm)
    assert left[-1] < 0.8 * np.median(at_random)


def test_an_earlier_calibration_is_the_prior_of_the_next(scene):
    truth, presses = rig(scene.charges, 20, seed=9)
    first = quietly(presses, scene)
    earlier = loosened(scene, first.posterior.parameters, first.posterior.covariance)
    drifted = truth.copy()
    drifted[0] += 0.2e6
    rng = np.random.default_rng(10)
    at = contacts(rng, 3)
    charge = scene.charges.charge_pC(drifted, at)
    charge = charge + np.hypot(1.0, 0.002 * charge) * rng.standard_normal(charge.shape)
    again = quietly(presses_of(at, charge, presses.electrodes), scene, earlier)
    alone = quietly(presses_of(at, charge, presses.electrodes), scene)
    assert again.left.position_mm < 0.7 * alone.left.position_mm
    std = again.quantities["pretension_MPa"].std
    assert abs(again.quantities["pretension_MPa"].value - 1e-6 * drifted[0]) < 4.0 * std


def test_a_sensor_of_the_same_layout_is_calibrated_by_the_same_network():
    table = sensor_to_dict(load_sensor("four-25um-biaxial"))
    table["name"], table["film"]["young_GPa"], table["film"]["pretension_MPa"] = "ours", 2.7, 1.0
    chosen = films_for(sensor_from_dict(table), Circle(1e-3))
    prior = chosen.films.prior
    assert chosen.described.parameters[prior.names.index("young")] == pytest.approx(np.log(2.7 / 3.0))
    assert chosen.described.parameters[0] == 1e6


def test_a_layout_without_a_network_is_refused_with_what_to_do():
    table = sensor_to_dict(load_sensor("four-25um-biaxial"))
    table["electrodes"]["A"] = [12.0, 0.0]
    with pytest.raises(ModelError, match="train fit --films"):
        films_for(sensor_from_dict(table), Circle(1e-3))
    with pytest.raises(SceneError, match="expected a round one"):
        films_for(load_sensor("four-25um-biaxial"), Polygon.triangle(4e-3))


def test_presses_without_any_place_or_force(scene):
    """Charges alone tell next to nothing: allowed, and said."""
    _, presses = rig(scene.charges, 6, seed=12)
    presses.contact[:] = np.nan
    calibration = quietly(presses, scene)
    assert any("no place is known" in caution for caution in calibration.cautions)
    assert calibration.left.force_percent > 5.0
    assert isinstance(calibration.presses, MeasuredPresses)
