"""Tests of the charge series against the simulator, of its folds, and of the nearest contact against SciPy."""

import numpy as np
import pytest
from tests.train.short_training import short_training

from isocharge.common.errors import DatasetError, TrainingError
from isocharge.serve.model.charge_file import read_charge_map
from isocharge.simulate import Domain, noise_model
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.train import fit, release
from isocharge.train.calibration.compact_map import SERIES_CONTACTS
from isocharge.train.data.charge_fit import fit_charge_series, fit_film_series
from isocharge.train.data.contact_errors import rms
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.training.training_data import TrainingData, invertible_domain

DOMAIN = Domain(8.0, (0.05, 2.0))


def test_charges_agree_with_the_simulator(split, film):
    field = split.field
    contact = draw_contacts(np.random.default_rng(8), DOMAIN, 500)
    relative_error = np.abs(field.charges(contact) / film.charges(contact) - 1.0)
    assert np.median(relative_error) < 2e-4
    assert rms(relative_error) < 2.0 * field.charge_std


def signed_charges(contact):
    """Return charges of both signs that are proportional to the force."""
    return contact[:, 2:] * (contact[:, :2] @ [[10.0, 0.0, 4.0], [0.0, 10.0, -4.0]] + [0.0, 0.0, 50.0])


@pytest.mark.parametrize(("forces", "scatter"), [((0.5,), 0.0), ((0.2, 0.5, 1.0, 1.8), 0.01)])
@pytest.mark.parametrize("is_signed", [False, True])
def test_presses_with_few_forces_determine_no_higher_powers_of_the_force(film, forces, scatter, is_signed):
    """A series of a higher degree would agree at these forces, but be wrong by the size of the charge between them."""
    charges = signed_charges if is_signed else film.charges
    rng = np.random.default_rng(0)
    contact = draw_contacts(rng, DOMAIN, 3000)
    contact[:, 2] = rng.choice(forces, 3000) * np.exp(scatter * rng.standard_normal(3000))
    presses = LabelledPresses(contact, charges(contact))
    series = fit_charge_series(DOMAIN, film.electrodes, presses[500:], presses[:500])
    between = draw_contacts(rng, Domain(8.0, (min(forces), max(forces))), 200)
    expected = charges(between)
    size = rms(expected) if is_signed else expected  # charges of both signs may be zero
    assert rms((series.charges(between) - expected) / size) < 0.01
    if len(forces) > 1:
        slopes = expected if is_signed else film.derivatives(between)[:, :, 2]
        size = rms(slopes) if is_signed else slopes
        assert rms((series.linearised(between)[1][:, :, 2] - slopes) / size) < 0.05


def test_too_few_presses_are_refused():
    few = draw_presses(np.ones_like, 50)
    with pytest.raises(TrainingError, match="expected at least 448 presses"):
        fit_charge_series(DOMAIN, ("A", "B", "C"), few, few)


REFERENCE = noise_model("reference")


def draw_presses(charges, count=3000):
    """Draw presses without noise.

    Args:
        charges: Function from contacts, shape (n, 3), mm and N, to charges, shape (n, n_electrode), pC.
        count: Number of presses.
    """
    contact = draw_contacts(np.random.default_rng(0), DOMAIN, count)
    return LabelledPresses(contact, charges(contact))


def fit_field(charges, count=3000):
    """Fit a charge series to the presses of `draw_presses`, of which a sixth are for the validation.

    Returns:
        The series and the presses.
    """
    presses = draw_presses(charges, count)
    is_validation = np.arange(count) % 6 == 0
    return fit_charge_series(DOMAIN, ("A", "B", "C"), presses[~is_validation], presses[is_validation]), presses


def charges_folded_at(fold_x):
    """Return a function from contacts to charges whose map folds at x = `fold_x`.

    The logarithm of the second charge is 0.1 (x - x^2 / (2 fold_x)), whose slope changes its sign there.
    """

    def charges(contact):
        x, y, force = contact.T
        log_ratios = np.stack([0.0 * x, 0.1 * (x - x**2 / (2.0 * fold_x)), 0.1 * y], axis=1)
        return force[:, None] ** 0.7 * np.exp(log_ratios)

    return charges


def test_field_of_a_taut_film_follows_the_change_of_the_exponent_of_the_force():
    """The charges grow with F below 0.3 N and with F^(2/3) above it; two powers of ln F leave an error of 1 %."""

    def charges(contact):
        x, y, force = contact.T
        growth = force / np.cbrt(1.0 + force / 0.3)
        return 500.0 * growth[:, None] * np.exp(0.05 * np.stack([x + y, x - y, -x], axis=1))

    assert fit_field(charges)[0].charge_std < 1e-3


def test_error_of_small_charges_of_both_signs_is_below_their_white_noise():
    presses = draw_presses(lambda contact: 0.02 * signed_charges(contact))
    series = fit_charge_series(DOMAIN, ("A", "B", "C"), presses[500:], presses[:500], white_pC=0.1)
    assert rms(series.charges(presses.contact) - presses.charge) < 0.01


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_contacts_of_a_calibration_suffice_for_a_degree_with_an_error_below_the_noise(film, sign):
    """Negative charges, which have no logarithm, need a high degree in the position."""
    contact = draw_contacts(np.random.default_rng(0), DOMAIN, SERIES_CONTACTS)
    charge = sign * film.charges(contact)
    series = fit_film_series(DOMAIN, film.electrodes, contact, charge[:, None], np.zeros(1))
    assert series.charge_std < 1e-3


@pytest.mark.parametrize("fold_x", [2.0, 5.0])
def test_domain_is_reduced_to_a_fold(fold_x):
    field, presses = fit_field(charges_folded_at(fold_x))
    domain, (caution,) = invertible_domain(field, presses, REFERENCE)
    assert domain.radius == pytest.approx(fold_x, abs=0.11)
    assert domain.force_range == field.domain.force_range
    assert f"folds beyond {domain.radius:g} mm" in caution
    assert f"on {len(presses.within(domain.radius))} of 3000 presses" in caution


def test_domain_is_not_reduced_by_a_fold_outside():
    field, presses = fit_field(charges_folded_at(9.0))
    assert invertible_domain(field, presses, REFERENCE) == (field.domain, ())


def test_probable_fold_of_presses_with_two_probes_is_stated():
    """The charges of the second probe are smaller by 2 % at the edge, so that no series describes both probes."""
    charges = charges_folded_at(3.0)
    has_second_probe = np.random.default_rng(1).random(3000) < 0.5

    def of_two_probes(contact):
        x, y, _ = contact.T
        return charges(contact) * (1.0 - 0.02 * has_second_probe * np.hypot(x, y) / 8.0)[:, None]

    field, presses = fit_field(of_two_probes)
    domain, (caution,) = invertible_domain(field, presses, REFERENCE)
    assert domain == field.domain
    assert "probably folds beyond about 2.9 mm" in caution
    assert "choose a smaller radius" in caution


def test_spurious_folds_of_a_poor_fit_are_not_stated(film):
    field, presses = fit_field(film.charges, 600)
    assert field.charge_std > 1e-3
    assert invertible_domain(field, presses, REFERENCE) == (DOMAIN, ())


def test_fold_near_the_centre_is_refused():
    field, presses = fit_field(charges_folded_at(1.2))
    with pytest.raises(DatasetError, match=r"folds 1\.\d+ mm from the centre, of 8 mm asked for"):
        invertible_domain(field, presses, REFERENCE)


def test_charge_series_of_the_whole_domain_and_a_caution_are_released_if_the_domain_is_reduced(
    sensor, split, tmp_path, caplog
):
    charges = charges_folded_at(5.0)
    presses = draw_presses(lambda contact: 1000.0 * charges(contact))
    data = TrainingData(sensor=sensor, probes=("circle:1.0",), domain=DOMAIN, presses=presses, sha256="0" * 64)
    fitted = fit(data, short_training(8, 8, 5, 5, 1_000))
    assert split.folded_charges is None

    model = release(fitted, tmp_path / "models" / "folded")
    series = read_charge_map(model.folder, ("A", "B", "C"))
    assert np.allclose(series.charges(presses.contact), presses.charge, rtol=2e-3)
    assert fitted.domain.radius < 5.2 < series.domain.radius
    [caution] = caplog.messages
    assert "'serve stream --track' follows contacts to 8 mm" in caution
    assert model.metadata.made_with["cautions"] == [caution]
    assert f"- {caution}." in (model.folder / "card.md").read_text("utf-8")


FAULTS = {
    "noisy": lambda charge, rng: REFERENCE.add(charge, rng),
    "anything": lambda charge, rng: 10.0 ** rng.uniform(0.0, 4.0, charge.shape),
}
"""Functions that give charges a fault, by the name of the fault."""


@pytest.mark.parametrize("fault", FAULTS)
def test_no_drawn_contact_is_nearer_than_the_one_that_the_search_finds(split, fault):
    """Between drawn contacts, the distance falls further, which SciPy tests for the steps of the search."""
    field = split.field
    rng = np.random.default_rng(1)
    charge = FAULTS[fault](split.test.charge[:12], rng)
    sigma = REFERENCE.sigma(charge)
    contact, residual = search(field, charge, sigma)
    assert np.allclose(residual, (charge - field.charges(contact)) / sigma, atol=1e-8)
    assert DOMAIN.contains(contact).all()
    drawn_charge = field.charges(draw_contacts(rng, DOMAIN, 20_000))
    drawn_distance = np.linalg.norm((charge[:, None] - drawn_charge) / sigma[:, None], axis=2)
    assert (np.linalg.norm(residual, axis=1) <= drawn_distance.min(axis=1)).all()


def test_series_of_a_film_at_several_pretensions_agrees_with_its_closed_form():
    """ln Q falls by 0.3 per MPa, by more beside an electrode; the exponent of the force does not change."""
    contact = draw_contacts(np.random.default_rng(0), DOMAIN, 2000)
    x, y, force = contact.T
    node_MPa = np.array([-0.5, -0.2, 0.0, 0.3])

    def charges(tension_MPa):
        falls = tension_MPa * (0.3 + 0.02 * np.stack([x, y, -x], axis=1))
        return 500.0 * force[:, None] ** 0.7 * np.exp(0.05 * np.stack([x + y, x - y, -x], axis=1) - falls)

    node_charge = np.stack([charges(tension_MPa) for tension_MPa in node_MPa], axis=1)
    series = fit_film_series(DOMAIN, ("A", "B", "C"), contact, node_charge, node_MPa)
    np.testing.assert_allclose(series.in_state(contact, [0.1]).charge_pC, charges(0.1), rtol=1e-4)
    np.testing.assert_allclose(series.charges(contact), charges(0.0), rtol=1e-4)
