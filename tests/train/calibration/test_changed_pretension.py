"""Tests of films whose pretension has changed since their calibration."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.calibration.conftest import film_values, rig, uneven_film
from tests.train.calibration.synthetic_film import SyntheticFilm

from isocharge.serve.model.charge_series import interpolation_weights
from isocharge.train import calibrate
from isocharge.train.calibration import compact_map
from isocharge.train.calibration.calibrate import solve_even
from isocharge.train.calibration.compact_map import _ChangedFilm, _nodes
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.data.presses import draw_contacts
from solved_charges import solved_charges, with_film

CONTACT = np.array([[3.0, 2.0, 0.5], [-5.0, 1.0, 1.5]])


@pytest.mark.slow
def test_charges_of_an_uneven_film_after_warming_agree_with_full_solves(problem):
    """Each press is solved before and after the change, with the same difference of the tensions in MPa."""
    film = uneven_film(problem)
    sensor, probe = film.layout.prior.film(film.film_values)
    contact = np.array([[0.0, 0.0, 0.5], [5.0, 1.0, 0.3], [-3.0, 4.0, 1.0], [2.0, -6.0, 0.5], [-6.0, -2.0, 1.5]])
    before = solved_charges(sensor, probe, contact)
    later = with_film(sensor, pretension=sensor.film.pretension - 0.4)
    after = solved_charges(later, probe, contact)

    charges = solve_even(problem, values=film.film_values)
    calibrated = _ChangedFilm(0.0, charges, film.film_values, np.eye(film.film_values.size))
    first, second = (calibrated.changed(change, None).charge(contact) for change in (0.0, -0.4))
    np.testing.assert_allclose(second / first, after / before, rtol=1e-3)


def test_derivatives_of_a_film_after_warming_are_those_with_respect_to_the_calibrated_film(
    problem, synthetic, monkeypatch
):
    """If the calibrated film was tauter or more uneven than estimated, so is the film after warming."""
    monkeypatch.setattr(FilmCharges, "of_even_film", lambda *_: synthetic)

    def charges_after(values, change_MPa=-0.3):
        calibrated = _ChangedFilm(0.0, synthetic, values, np.eye(values.size))
        return calibrated.changed(change_MPa, None).linearised(CONTACT)

    values = uneven_film(problem).film_values
    _, derivatives = charges_after(values)
    for name in ("pretension", "tension_difference", "young"):
        index = synthetic.prior.index(name)
        step = 1e-4 * np.eye(values.size)[index]
        expected = (charges_after(values + step)[0] - charges_after(values - step)[0]) / 2e-4
        np.testing.assert_allclose(derivatives[:, :, index], expected, rtol=1e-4)
    values[synthetic.prior.index("pretension")] = 0.0
    assert all(np.isfinite(array).all() for array in charges_after(values, 0.0))


@pytest.mark.parametrize("pretension_MPa", [0.6, 0.005])
def test_no_node_makes_a_film_slack_in_one_direction(problem, pretension_MPa):
    """The nodes of a nearly slack film are not so near that the interpolation would amplify the errors of charges."""
    film = uneven_film(problem)
    film.values[film.layout.index("pretension")] = pretension_MPa
    node_MPa = _nodes(film)
    assert 0.0 < 0.75 * pretension_MPa + node_MPa.min() < 0.05
    assert interpolation_weights(node_MPa, np.array([0.2]))[0].max() < 50.0


def test_errors_of_an_offset_and_of_d31_partly_cancel_in_the_directions(problem, synthetic, monkeypatch):
    """The presses of the calibration determine their sum better than each of them."""
    monkeypatch.setattr(compact_map, "_nodes", lambda _: np.zeros(1))
    film = uneven_film(problem)
    unknowns = [film.layout.index(name) for name in ("d31", "offset B")]
    covariance = np.array([[0.002, -0.4], [-0.4, 100.0]])
    film.covariance[np.ix_(unknowns, unknowns)] = covariance
    film.values[unknowns[1]] = 7.0
    series = compact_map.compact_charges(problem.domain, synthetic, film, None)
    *_, (changes,) = series.in_state(CONTACT[:1], np.zeros(1 + series.direction_count))
    *_, (by_property,) = synthetic.linearised(film.film_values, CONTACT[:1])
    only_b = np.array([0.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(series.offset_pC, 7.0 * only_b)
    slopes = np.column_stack([by_property[:, unknowns[0]], only_b])
    np.testing.assert_allclose(changes @ changes.T, slopes @ covariance @ slopes.T, rtol=0.02)


def test_node_at_which_the_charges_are_unknown_is_left_out(problem, synthetic, monkeypatch, caplog):
    """Otherwise, the fit to its charges would also spoil the charges at the other nodes."""

    def charge(film, contact):
        factor = np.random.default_rng(3).uniform(0.1, 1.9, (len(contact), 4))
        return film.charges.charges(film.values, contact) * (factor if film.change_MPa == 0.9 else 1.0)

    monkeypatch.setattr(_ChangedFilm, "charge", charge)
    monkeypatch.setattr(FilmCharges, "of_even_film", lambda *_: synthetic)
    series = compact_map.compact_charges(problem.domain, synthetic, uneven_film(problem), None)
    assert series.node_MPa.tolist() == [-0.7, -0.3, 0.0, 0.4]
    assert "changes from -0.7 to +0.4 MPa can be followed" in caplog.text
    expected = synthetic.charges(uneven_film(problem).film_values, CONTACT)
    np.testing.assert_allclose(series.charges(CONTACT), expected, rtol=0.01)


def test_charges_change_their_sign_with_the_pretension(problem, synthetic, monkeypatch):
    charges = SyntheticFilm.charges
    monkeypatch.setattr(SyntheticFilm, "charges", lambda *arguments: charges(*arguments) - 30.0)
    monkeypatch.setattr(FilmCharges, "of_even_film", lambda *_: synthetic)
    series = compact_map.compact_charges(problem.domain, synthetic, uneven_film(problem), None)
    contact = draw_contacts(np.random.default_rng(4), problem.domain, 300)
    later = film_values(synthetic.prior, pretension=2.1, tension_difference=-0.3 / 2.1)
    found = series.in_state(contact, [0.9]).charge_pC
    np.testing.assert_allclose(found, synthetic.charges(later, contact), atol=2.5)


@pytest.mark.slow
def test_estimate_does_not_depend_on_the_film_that_is_solved_first(problem):
    """Touches at unknown places show the pretension, although the first solved film is far from the real film."""
    layout = problem.prior.layout
    tension, difference = layout.index("pretension"), layout.index("tension_difference")
    earlier = replace(uneven_film(problem), covariance=0.01 * problem.film_before.covariance)
    later = earlier.film_values.copy()
    later[[tension, difference]] = 0.8, -0.25 * 1.2 / 0.8
    film = solve_even(problem, values=later)
    _, _, touches = rig(problem, film, 60, seed=23, values=later)
    touches.contact[:] = np.nan
    continued = replace(problem, earlier=earlier.drifted())
    found = []
    for first_MPa in (1.0, 0.6):
        later[tension] = first_MPa
        found.append(calibrate(touches, continued, start=solve_even(problem, values=later), accurate=False).film)
    std = found[0].std("pretension")
    assert abs(found[0].value("pretension") - found[1].value("pretension")) < 0.4 * std
    assert abs(found[0].value("pretension") - 0.8) < 2.0 * std
