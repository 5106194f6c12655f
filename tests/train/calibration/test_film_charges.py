"""Charges of a solved film and of similar films against direct solves, and calibrations of solved films."""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses, with_rig_errors
from tests.train.calibration.conftest import film_values

from isocharge.serve import Predictor
from isocharge.simulate import (
    Circle,
    FilmPrior,
    Finger,
    ForwardMap,
    GrowingFinger,
    load_sensor,
    local_workers,
    parse_probe,
    press,
)
from isocharge.simulate.forward import derivative_maps
from isocharge.simulate.forward.charge_map import differences
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train import CalibrationProblem, FitConfig, TrainingConfig, calibrate, write_calibration
from isocharge.train.calibration.calibrate import _has_accurate_charges, solve_even
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.data.contact_errors import position_error, rms
from isocharge.train.data.presses import draw_contacts
from solved_charges import solved_charges, with_film, with_piezo


def solve_even_at(problem, forces) -> FilmCharges:
    """Solve the axisymmetric film at two distances and a few forces, which suffice for few contacts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(derivative_maps, "few_nodes", lambda *_: NodeCount(2, forces))
        return solve_even(problem)


press_once = lru_cache(press)


@pytest.fixture(autouse=True)
def _each_press_solved_once(monkeypatch):
    """Solve a press once for several electrodes or piezoelectric coefficients, which do not change its stress."""
    monkeypatch.setattr("solved_charges.press", press_once)


@pytest.fixture(scope="module")
def solved(problem) -> FilmCharges:
    """The solved film of the sensor file, for presses like those of `CONTACT`."""
    return solve_even_at(replace(problem, radius=6.0, force_range=(0.2, 1.0)), 4)


@pytest.fixture
def narrow_problem(problem):
    """The problem for presses within 4 mm and of similar forces."""
    return replace(problem, radius=4.0, force_range=(0.4, 0.6))


CONTACT = np.array([[3.0, 2.0, 0.5], [-4.0, 5.0, 1.0], [1.0, -6.0, 0.2]])


def test_charges_of_a_similar_film_agree_with_direct_solves(solved):
    """All properties differ at the same time. The change of the charges is about 5 %."""
    prior = solved.prior
    values = prior.mean + 0.3 * prior.std * np.random.default_rng(1).standard_normal(len(prior.names))
    expected = solved_charges(*prior.film(values), CONTACT)
    np.testing.assert_allclose(solved.charges(values, CONTACT), expected, rtol=0.01)


def test_negative_charges_agree_with_direct_solves(problem, solved):
    """If the wires are swapped, all charges are negative. The logarithms of their magnitudes change linearly."""
    piezo = problem.sensor.piezo
    swapped = with_piezo(problem.sensor, d31=-piezo.d31, d32=-piezo.d32)
    charges = replace(solved, prior=FilmPrior(swapped, problem.probe))
    prior = charges.prior
    values = film_values(prior, pretension=1.76)
    expected = solved_charges(*prior.film(values), CONTACT)
    change = expected - charges.charges(prior.mean, CONTACT)
    np.testing.assert_allclose(charges.charges(values, CONTACT), expected, atol=0.03 * np.abs(change).max())


def test_imperfections_of_the_sensor_file_are_changes_of_the_even_film(narrow_problem):
    """Without the imperfections, the charges would differ by up to 6 %."""
    contact = np.array([[-2.5, 2.9, 0.5]])
    sensor = with_film(narrow_problem.sensor, deviator=(0.6, 0.1), young_ratio=1.3, axis=0.5, oval=0.004, oval_axis=1.0)
    charges = solve_even_at(replace(narrow_problem, sensor=sensor), 2)
    values = charges.prior.mean
    expected = solved_charges(*charges.prior.film(values), contact)
    np.testing.assert_allclose(charges.charges(values, contact), expected, rtol=0.015)
    assert not _has_accurate_charges(charges, values, contact)


def test_uneven_tension_and_described_shear_modulus_are_solved_with_the_film(problem, solved):
    """The uneven tension changes the charges by less than 3 %, but its effect is far from linear."""
    assert _has_accurate_charges(solved, solved.prior.mean, CONTACT)
    assert not _has_accurate_charges(solved, film_values(solved.prior, tension_difference=0.2), CONTACT)
    sensor = with_film(problem.sensor, shear=900.0)
    assert not _has_accurate_charges(
        replace(solved, prior=FilmPrior(sensor, problem.probe)), solved.prior.mean, CONTACT
    )


@pytest.mark.parametrize("finger", [Finger(5.0), pytest.param(GrowingFinger(5.0), marks=pytest.mark.slow)])
def test_fingertip_is_solved_with_its_own_pressure(narrow_problem, finger):
    """A circle of the same area causes charges that differ by up to 1 %."""
    charges = solve_even_at(replace(narrow_problem, probe=finger), 3)
    values = charges.prior.mean
    expected = solved_charges(*charges.prior.film(values), CONTACT[:1])
    np.testing.assert_allclose(charges.charges(values, CONTACT[:1]), expected, rtol=2e-3)


def test_no_contacts_give_no_charges(solved):
    """A file of touches at unknown places contains no press whose charges can be compared with those of a film."""
    charge, _, jacobian = solved.linearised(solved.prior.mean, np.empty((0, 3)))
    assert charge.shape == (0, 4)
    assert jacobian.shape == (0, 4, len(solved.prior.names))


@pytest.mark.parametrize(
    "name", ["young", "thickness", "d31", "d12", "shift_y", "rotation", "crosstalk", "probe_radius", "gain B"]
)
def test_derivatives_are_those_of_direct_solves(solved, name):
    prior = solved.prior
    contact = CONTACT[:1]
    index = prior.index(name)
    step = 0.1 * prior.std[index]
    forward, backward = (
        solved_charges(*prior.film(film_values(prior, **{name: prior.mean[index] + change})), contact)
        for change in (step, -step)
    )
    expected = (forward - backward) / (2.0 * step)
    *_, jacobian = solved.linearised(prior.mean, contact)
    np.testing.assert_allclose(jacobian[:, :, index], expected, atol=0.03 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["pretension", "tension_difference", "tension_shear", "young", "oval_x"])
def test_derivatives_at_a_changed_uneven_film_are_differences_of_the_charges(solved, name):
    prior = solved.prior
    values = film_values(prior, pretension=1.1, tension_difference=0.2, tension_shear=-0.1)
    *_, jacobian = solved.linearised(values, CONTACT)
    step = 1e-5 * (np.array(prior.names) == name)
    expected = (solved.charges(values + step, CONTACT) - solved.charges(values - step, CONTACT)) / 2e-5
    np.testing.assert_allclose(jacobian[:, :, prior.index(name)], expected, rtol=1e-6)


def test_contact_slopes_are_differences_of_the_charges(solved):
    values = solved.prior.mean
    _, slopes, _ = solved.linearised(values, CONTACT)
    expected = differences(partial(solved.charges, values), CONTACT, steps=(1e-4, 1e-4, 1e-4))
    np.testing.assert_allclose(slopes, expected, rtol=1e-3, atol=1e-3 * np.abs(slopes).max())


def five_electrodes():
    """Return the problem of a layout of one's own, which is pressed with a rectangle."""
    table = sensor_to_dict(load_sensor("four-25um-biaxial"))
    table["electrodes"]["E"] = [7.5, 7.5]
    sensor = sensor_from_dict(table | {"name": "five"})
    return CalibrationProblem(sensor, parse_probe("rectangle:4.0x2.0"), radius=5.0, force_range=(0.2, 1.5))


FILMS = {
    "T1 / T2 = 1.7 and E1 / E2 = 1.3": (
        lambda: CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0)),
        {"pretension": 1.0, "tension_difference": 0.25, "stiffness_xy": 0.26, "d31": 0.2},
        ("pretension", "tension_difference", "d31"),
    ),
    "five electrodes": (five_electrodes, {"pretension": 1.2, "shift_x": 0.3}, ("shift_x",)),
}
"""Problems, properties that differ from the described film, and the properties of them that the presses determine."""


@pytest.mark.slow
@pytest.mark.parametrize("film", FILMS)
def test_film_is_calibrated_and_its_model_finds_contacts(film, tmp_path):
    """All presses are solved."""
    make_problem, changes, determined = FILMS[film]
    problem = make_problem()
    prior = problem.prior.layout.prior
    sensor_and_probe = prior.film(film_values(prior, **changes))
    rng = np.random.default_rng(3)
    contact = draw_contacts(rng, problem.domain, 55)
    contact[:, 2] = np.clip(contact[:, 2], 0.15, 1.5)
    charge = problem.noise.add(solved_charges(*sensor_and_probe, contact), rng)
    presses = measured_presses(problem, with_rig_errors(contact[:15], rng), charge[:15])
    quick = FitConfig(training=TrainingConfig(steps=600, misfit_steps=200, misfit_charges=2_000))
    with local_workers(2) as executor:
        result = calibrate(presses, problem, executor=executor)
        write_calibration(result, tmp_path / "film", config=quick, executor=executor)
    for name in determined:
        assert abs(result.film.value(name) - changes[name]) < 4.0 * result.film.std(name)
    answers = Predictor(tmp_path / "film").predict_batch(charge[15:])
    assert rms(position_error(np.stack(answers[:2], axis=1), contact[15:])) < 0.3
    assert rms(answers.force_N / contact[15:, 2] - 1.0) < 0.03


@pytest.mark.slow
def test_film_with_charges_of_both_signs_is_calibrated():
    """The electrodes on the x axis have positive charges, and those on the y axis negative charges."""
    sensor = with_piezo(load_sensor("four-25um-biaxial"), d31=12.0, d32=-8.0)
    problem = CalibrationProblem(sensor, Circle(1.0), radius=5.0, force_range=(0.1, 1.0))
    prior = problem.prior.layout.prior
    film = ForwardMap.build(*prior.film(film_values(prior, pretension=1.2)), 5.2, (0.08, 1.2))
    rng = np.random.default_rng(2)
    contact = draw_contacts(rng, problem.domain, 15)
    charge = film.charges(contact)
    assert 0.3 < (charge < 0.0).mean() < 0.7
    presses = measured_presses(problem, with_rig_errors(contact, rng), problem.noise.add(charge, rng))
    result = calibrate(presses, problem)
    assert abs(result.film.value("pretension") - 1.2) < 4.0 * result.film.std("pretension") < 1.2
    residual = result.charges.charges(result.film.film_values, contact) - charge
    assert rms(residual / problem.noise.sigma(charge)) < 3.0
