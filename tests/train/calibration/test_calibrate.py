"""Tests of `calibrate` on films whose charges are a closed formula: cautions and refused presses."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses
from tests.train.calibration.conftest import film_values, rig, rig_presses
from tests.train.calibration.synthetic_film import SyntheticFilm

from isocharge.common.errors import PressError, SceneError, SensorError
from isocharge.simulate import Circle, NoiseModel, load_sensor
from isocharge.train import CalibrationProblem, calibrate, next_presses
from isocharge.train.calibration import calibrate as calibrate_module
from isocharge.train.calibration import estimator
from isocharge.train.calibration.estimator import FORCE_SCATTERS
from isocharge.train.calibration.press_data import PressData
from solved_charges import with_film

pytestmark = pytest.mark.usefixtures("never_solved", "few_hypotheses")


@pytest.fixture
def fit(problem, synthetic):
    """Function that calibrates the synthetic film."""
    return partial(calibrate, problem=problem, start=synthetic, accurate=False)


@pytest.fixture
def press_film(problem, synthetic):
    """Function that presses the synthetic film, and returns the measured presses; see `rig`."""
    return partial(rig_presses, problem, synthetic)


def test_errors_become_smaller_and_the_sentences_name_them(fit, problem, synthetic):
    values, _, presses = rig(problem, synthetic, 12, seed=11)
    result = fit(presses)
    after, before = result.film_error, result.film_error_before
    assert after.position_mm < 0.3 * before.position_mm
    assert after.force_percent < 0.2 * before.force_percent
    assert f"errors of {after.position_mm:.2g} mm and {after.force_percent:.2g} %" in result.summary[0]
    assert result.cautions == ()
    shares = [100.0 * share for share in (result.estimation.hypothesis.discrepancy, result.film.noise.gain)]
    assert "about {:.2g} % of a charge; noise: about {:.2g} % and ".format(*shares) in result.summary[-1]
    assert result.properties["pretension"].identified
    assert re.search(r"changes from the sensor file \(.*\): mean pretension .*; ln of d31 ", result.summary[1])
    estimated, std = np.array([(one.value, one.std) for one in result.properties.values()]).T
    assert (np.abs(estimated - values) < 4.0 * std).all()
    sensor, _ = result.sensor_and_probe
    assert sensor.film.pretension == result.film.value("pretension")


def test_film_is_solved_beyond_the_radius_but_not_at_the_clamp(problem):
    """A probe near the clamp would need a very fine mesh."""
    film, probe = problem.sensor.film, problem.probe
    assert problem.solved_domain.radius > problem.radius
    near_clamp = replace(problem, radius=film.radius - 1.5 * probe.reach)
    assert near_clamp.radius <= near_clamp.solved_domain.radius < film.radius - 1.2 * probe.reach


def test_described_film_that_cannot_be_found_is_refused(problem):
    with pytest.raises(SensorError, match=r"pretension_MPa: expected at most 4 MPa.*got 8; train on many presses"):
        replace(problem, sensor=with_film(problem.sensor, pretension=8.0))
    with pytest.raises(SceneError, match="at least three electrodes"):
        replace(problem, sensor=replace(problem.sensor, electrodes=problem.sensor.electrodes[:2]))


@pytest.mark.parametrize("radius", [44.5, np.nan])
def test_working_area_beyond_the_clamp_is_refused(problem, radius):
    with pytest.raises(SceneError, match="radius"):
        replace(problem, radius=radius)


@pytest.mark.parametrize(("name", "offset"), [("offset", [-20.0, 0.0, 10.0, 30.0]), ("force_offset", [0.03])])
def test_offsets_of_charges_or_forces_are_found_with_their_signs(fit, press_film, name, offset):
    """The channels of an amplifier may have different offsets, which one common offset would not describe."""
    presses = press_film(15, seed=12)
    readings = presses.charge_pC if name == "offset" else presses.contact[:, 2:]
    readings += offset
    result = fit(presses)
    is_offset = [unknown.startswith(name) for unknown in result.film.layout.names]
    std = np.sqrt(np.diag(result.film.covariance))[is_offset]
    assert (np.abs(result.film.values[is_offset] - offset) < 3.0 * std).all()
    assert std.max() < 0.1 * max(offset)
    # A wrong zero of the load cell causes no error of a later contact.
    only_force_offset = np.diag(np.array(result.film.layout.names) == "force_offset")
    assert result.sensitivity.film_error(only_force_offset).force_percent == 0.0
    (caution,) = result.cautions
    assert re.search(r"contain an offset of (-?\d+)", caution)[1].startswith("-") == (offset[0] < 0.0)


def test_bad_press_and_press_outside_are_named_by_their_lines(fit, press_film):
    presses = press_film(12, seed=13)
    presses.contact[4, 1] -= 3.0
    presses.contact[8] = [9.5, 0.0, 1.0]
    result = fit(presses)
    assert result.bad_lines == (6,)
    assert result.cautions[0].startswith("line 10: a calibration takes presses within 8.5 mm")
    assert "'line 6: does not agree" in str(result.cautions)


def test_copies_of_presses_do_not_reduce_the_stated_error(fit, press_film):
    presses = press_film(5, seed=11)
    file_with_copies = presses[[0, 1, 2, 3, 4, 1, 2, 3, 4]]
    file_with_copies = replace(file_with_copies, lines=tuple(range(2, 11)))
    result = fit(file_with_copies)
    assert result.cautions[0] == "lines 7, 8, 9, 10: the charges of an earlier press; left out"
    assert result.film_error == fit(presses).film_error


@pytest.mark.parametrize(
    ("scatter", "caution"),
    [
        (0.04, "more than stated, by about 3 % of each force and 0 % of"),
        (0.15, r"the best film by 1\.\d times their errors, so the model may err by as many times more"),
    ],
)
def test_forces_that_scatter_more_than_stated_are_named(fit, press_film, scatter, caution):
    presses = press_film(25, seed=14)
    presses.contact[:, 2] *= np.exp(scatter * np.random.default_rng(0).standard_normal(25))
    assert re.search(caution, str(fit(presses).cautions))


def test_presses_at_one_place_share_the_error_of_their_position(problem, press_film):
    """The encoder of a stage reads the place of four presses with a difference of 5 um."""
    presses = press_film(7, seed=14)
    presses.contact[1:4, :2] = presses.contact[0, :2] + [0.005, 0.0]
    presses.contact[6] = np.nan
    std = PressData.of(presses, problem.noise, problem.solved_domain).contact_std[:, 0]
    assert std.tolist() == [0.2, 0.2, 0.2, 0.2, 0.1, 0.1, np.inf]


def test_noise_of_the_load_cell_is_not_taken_for_an_offset_of_the_forces(fit, press_film, synthetic, monkeypatch):
    """A noise of 20 mN is up to 40 % of the forces."""
    monkeypatch.setattr(estimator, "FORCE_SCATTERS", FORCE_SCATTERS)
    presses = press_film(25, seed=16, values=synthetic.values)
    noisy_force = presses.contact[:, 2] + 0.02 * np.random.default_rng(0).standard_normal(25)
    presses.contact[:, 2] = np.maximum(noisy_force, 0.041)  # within the range that a calibration takes
    result = fit(presses)
    (caution,) = result.cautions
    assert "0 % of each force and 12 % of their geometric mean: is the load cell zero" in caution
    assert result.bad_lines == ()


def presses_on_changed_film(problem, press_film, **changes):
    return press_film(20, 15, film_values(problem.prior.layout.prior, **changes))


@pytest.mark.parametrize(("name", "value"), [("shift_x", 1.1), ("gain A", -0.7)])
def test_film_far_from_its_description_is_found_and_named(fit, press_film, problem, name, value):
    result = fit(presses_on_changed_film(problem, press_film, **{name: value}))
    assert "those of the film, are the forces in N" in str(result.cautions)
    assert result.film.value(name) / value > 0.5  # the other gains, and the coefficients, may explain the rest


def test_electrodes_that_are_farther_away_than_considered_are_refused(fit, press_film, problem):
    """The film would otherwise be fitted with the largest shift, and its uncertainty would not contain the rest."""
    with pytest.raises(
        PressError, match=r"along x: the presses agree best with 1\.2 mm, which is an end .* the origin"
    ):
        fit(presses_on_changed_film(problem, press_film, shift_x=2.0))


def test_presses_at_one_place_are_named(fit, problem, synthetic):
    """A stage reads the same place with a scatter of 5 um; only positions near the centre may be metres."""
    contact = np.column_stack([np.full((8, 2), 3.0), np.geomspace(0.1, 1.9, 8)])
    charge = synthetic.charges(synthetic.values, contact)
    contact[:, :2] += 0.005 * np.random.default_rng(0).standard_normal((8, 2))
    cautions = fit(measured_presses(problem, contact, charge)).cautions
    assert "at one place" in str(cautions)


def test_presses_with_few_known_values_change_nothing(fit, press_film):
    """Two known values do not determine a contact, and state nothing about the film."""
    presses = press_film(12, seed=17)
    presses.charge_pC[11, :2] = np.nan
    presses.contact[11] = np.nan
    presses.position_std_mm[11] = 5.0
    without = fit(presses[:11]).film
    result = fit(presses)
    assert not result.cautions
    np.testing.assert_allclose(result.film.film_values, without.film_values, atol=0.01)
    assert result.film.std("pretension") == pytest.approx(without.std("pretension"), rel=0.01)


def test_one_press_states_nothing_about_the_noise(fit, press_film):
    presses = press_film(1, seed=18)
    (caution,) = fit(presses).cautions
    assert caution.startswith("all known positions are at one place")


@pytest.mark.parametrize("is_exact", [True, False])
def test_uneven_film_whose_solution_changes_the_estimate_again_is_a_caution(fit, press_film, monkeypatch, is_exact):
    monkeypatch.setattr(SyntheticFilm, "solved", lambda film, *_: film, raising=False)
    monkeypatch.setattr(calibrate_module, "_has_accurate_charges", lambda *_: is_exact)
    presses = press_film(12, seed=11)
    cautions = fit(presses, accurate=True).cautions
    assert cautions == (() if is_exact else (calibrate_module.NOT_CONVERGED,))


def test_three_charges_need_a_known_contact_inside():
    three = CalibrationProblem(load_sensor("three-25um-biaxial"), Circle(1.0))
    film = SyntheticFilm(three.prior.layout.prior, three.solved_domain)
    presses = rig_presses(three, film, 4, seed=3)
    presses.contact[:2, 0] = 9.5
    presses.contact[2:] = np.nan
    with pytest.raises(PressError, match=r"^lines 2, 3: a calibration takes presses within 8\.5 mm"):
        calibrate(presses, three, start=film, accurate=False)


def test_continued_calibration_needs_fewer_presses(fit, press_film, problem, synthetic):
    values, _, presses = rig(problem, synthetic, 20, seed=19)
    earlier = fit(presses).film.drifted()
    values[0] += 0.2 if values[0] < 2.0 else -0.2
    three = press_film(3, seed=20, values=values)
    continued = fit(three, problem=replace(problem, earlier=earlier))
    fresh = fit(three)
    assert continued.film_error.position_mm < 0.5 * fresh.film_error.position_mm
    assert abs(continued.film.value("pretension") - values[0]) < 3.0 * continued.film.std("pretension")


def test_proposed_presses_reduce_the_errors_as_announced(fit, press_film, problem, synthetic):
    """The announced errors are those of a calibration with the proposed presses; random presses leave larger ones."""
    proposed = next_presses(problem, synthetic, 6)
    errors = [press.position_mm for press in proposed]
    assert errors == sorted(errors, reverse=True)
    contact = np.array([press.contact for press in proposed])
    charge = synthetic.charges(synthetic.values, contact)
    chosen = fit(measured_presses(problem, contact, charge)).film_error.position_mm
    assert chosen == pytest.approx(errors[-1], rel=0.6)
    random_presses = (press_film(6, seed, values=synthetic.values) for seed in range(3))
    assert chosen < np.mean([fit(presses).film_error.position_mm for presses in random_presses])


def test_proposed_force_is_not_always_the_largest_of_small_forces(problem, synthetic):
    (proposed,) = next_presses(replace(problem, force_range=(0.004, 0.04)), synthetic, 1)
    assert proposed.force_N < 0.04


def test_errors_that_are_announced_after_noisy_presses_contain_the_noise(fit, problem, synthetic):
    """With the noise of a good amplifier, the announced errors would be a tenth too small."""
    noisy = replace(problem, noise=NoiseModel("bench", 1.0, 0.016))
    values, _, presses = rig(noisy, synthetic, 12, seed=22)
    proposed = next_presses(problem, synthetic, 8, fit(presses).film)
    further = np.array([press.contact for press in proposed])
    charge = noisy.noise.add(synthetic.charges(values, further), np.random.default_rng(23))
    all_presses = measured_presses(
        problem, np.vstack([presses.contact, further]), np.vstack([presses.charge_pC, charge])
    )
    after = fit(all_presses).film_error
    assert proposed[-1].position_mm == pytest.approx(after.position_mm, rel=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda p: replace(p, contact=p.contact + np.array([20.0, 0.0, 0.0])),
            r"and of .* N \(--radius, --force\); is it",
        ),
        (lambda p: replace(p, contact=p.contact[::-1].copy()), "no film of 'four-25um-biaxial' explains these 12"),
        (
            lambda p: replace(p, contact=p.contact + np.where(np.arange(12) < 5, 3.0, 0.0)[:, None] * [0.0, 1.0, 0.0]),
            r"5 of them do not agree with the others, and the charges .* of the others by \d",
        ),
    ],
)
def test_presses_that_no_film_explains_are_refused(fit, press_film, change, message):
    with pytest.raises(PressError, match=message):
        fit(change(press_film(12, seed=21)), accurate=True)  # before an uneven film is solved


def test_four_charges_of_unknown_contacts_are_accepted(fit, press_film):
    presses = press_film(3, seed=21)
    presses.contact[:] = np.nan
    assert len(fit(presses).presses) == 3
