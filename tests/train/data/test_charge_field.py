"""The forward map as a series, against the simulator; its folds; the nearest contact, against SciPy."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from isocharge.common.errors import DatasetError, TrainingError
from isocharge.serve.model.charge_series import read_charges
from isocharge.simulate import Domain, Electrode, Sweep, noise_model, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.simulate.forward.charge_map import differences
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.simulate.numerics.disk_least_squares import into_domain
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit, release
from isocharge.train.data.charge_field import ChargeField, invertible_domain
from isocharge.train.data.misfit_charges import draw_misfit_examples
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.training.source import TrainingData

DOMAIN = Domain(8.0, (0.05, 2.0))


def test_charges_agree_with_the_simulator(trained, film):
    field = trained.split.field
    contact = draw_contacts(np.random.default_rng(8), DOMAIN, 500)
    error = np.abs(field.charges(contact) / film.charges(contact) - 1.0)
    assert np.median(error) < 2e-4
    assert np.sqrt(np.mean(error**2)) < 2.0 * field.error


def test_the_derivatives_are_those_of_the_charges(trained):
    field = trained.split.field  # the series ends at its domain's ends
    inner = Domain(7.0, (0.06, 1.9))
    contact = draw_contacts(np.random.default_rng(3), inner, 200)
    expected = differences(field.charges, contact, steps=(1e-3, 1e-3, 1e-4))
    assert np.allclose(field.derivatives(contact), expected, rtol=1e-4, atol=1e-2)


def test_too_few_presses():
    few = LabelledPresses(draw_contacts(np.random.default_rng(0), DOMAIN, 50), np.ones((50, 3)))
    with pytest.raises(TrainingError, match="expected at least 448 presses"):
        ChargeField.fit(DOMAIN, ("A", "B", "C"), few, few)


TINY = FitConfig(
    network=NetworkConfig(hidden=(8, 8), misfit_hidden=(8, 8)),
    training=TrainingConfig(steps=5, misfit_steps=5, misfit_charges=1_000),
)
REFERENCE = noise_model("reference")


def field_of(charges, noise=0.0):
    rng = np.random.default_rng(0)
    domain = Domain(8.0, (0.05, 2.0))
    contact = draw_contacts(rng, domain, 3000)
    charge = charges(*contact.T)
    presses = LabelledPresses(contact, charge * np.exp(noise * rng.standard_normal(charge.shape)))
    held = np.arange(3000) % 6 == 0
    return ChargeField.fit(domain, ("A", "B", "C"), presses[~held], presses[held]), presses


def folded_at(fold):
    """ln Q_1 - ln Q_0 = 0.1 (x - x^2 / (2 fold)): its slope changes sign at x = fold."""

    def charges(x, y, force):
        return force[:, None] ** 0.7 * np.exp(np.stack([0 * x, 0.1 * (x - x**2 / (2 * fold)), 0.1 * y], axis=1))

    return charges


def test_field_of_a_taut_film_follows_the_change_of_the_exponent_of_the_force():
    """The charges grow with F below 0.3 N and with F^(2/3) above it; two powers of ln F leave an error of 1 %."""

    def charges(x, y, force):
        growth = force / np.cbrt(1.0 + force / 0.3)
        return 500.0 * growth[:, None] * np.exp(0.05 * np.stack([x + y, x - y, -x], axis=1))

    field, presses = field_of(charges)
    error = field.charges(presses.contact) / presses.charge - 1.0
    assert np.sqrt(np.mean(error**2)) < 1e-3
    assert field.error < 1e-3


@pytest.mark.parametrize("fold", [2.0, 5.0])
def test_a_fold_at_a_known_place_ends_the_domain(fold):
    field, presses = field_of(folded_at(fold))
    domain, (caution,) = invertible_domain(field, presses, REFERENCE)
    assert domain.radius == pytest.approx(fold, abs=0.11)
    assert domain.force_range == field.domain.force_range
    assert f"folds beyond {domain.radius:g} mm" in caution
    assert f"on {len(presses.within(domain.radius))} of 3000 presses" in caution


def test_a_fold_outside_the_domain_is_none_of_its_concern():
    field, presses = field_of(folded_at(9.0))
    assert invertible_domain(field, presses, REFERENCE) == (field.domain, ())


def test_where_hardly_anything_is_left_it_is_refused():
    with pytest.raises(DatasetError, match=r"folds 1\.\d+ mm from the centre, of 8 mm asked for"):
        invertible_domain(*field_of(folded_at(1.2)), REFERENCE)


@pytest.mark.parametrize(("fold", "seen"), [(2.0, ["2"]), (30.0, [])])
def test_noisy_charges_show_a_fold_but_not_for_certain(fold, seen):
    """Measured charges, 0.3 % of noise: the same map, whose fold is reported and not cut off."""
    field, presses = field_of(folded_at(fold), noise=3e-3)
    domain, cautions = invertible_domain(field, presses, REFERENCE)
    assert domain.radius == 8.0
    assert [f"{float(caution.split()[10]):.0f}" for caution in cautions] == seen


def crossing(x, y, force):
    """ln Q along a nodal cubic (u^2, u^3 - a^2 u): x = 3 mm and x = -3 mm have the same charges, and nothing folds."""
    u = 0.1 * x
    v = 0.1 * y
    return 1e4 * force[:, None] ** 0.7 * np.exp(np.stack([0 * u, u**2, u * (u**2 - 0.09), v], axis=1))


def test_contacts_far_apart_with_the_same_charges_are_a_caution():
    field, presses = field_of(crossing)
    domain, (caution,) = invertible_domain(field, presses, REFERENCE)
    assert domain.radius == 8.0
    assert caution.startswith("contacts far apart can have the same charges: 0.05 N at (")
    places = np.array([float(x) for x in re.findall(r"at \((\S+),", caution)])
    assert np.sort(places) == pytest.approx([-3.0, 3.0], abs=0.5)
    assert not invertible_domain(replace(field, error=1e-2), presses, REFERENCE)[1]  # too poor to decide


def swept(folder, film, samples, sensor, radius=8.0):
    """A dataset of another sensor on the same film, whose equilibria serve all layouts and readouts."""
    sweep = Sweep(samples=samples, radius=radius)
    return read_dataset(write_sweep(folder / "presses", (replace(film, sensor=sensor),), sweep))


def layout(sensor, *centres):
    squares = (Electrode.of_square(name, centre, 3.0) for name, centre in zip("ABCDE", centres, strict=False))
    return replace(sensor, electrodes=tuple(squares))


def test_a_fit_across_a_fold_is_in_log_card_and_metadata(film, sensor, tmp_path, caplog):
    """One of three electrodes at the centre, where the map folds at once (0.2 mm by `identify`)."""
    central = layout(sensor, (0.0, 0.0), (8.66, 5.0), (-8.66, 5.0))
    model = release(fit(swept(tmp_path, film, 2_000, central), TINY), tmp_path / "models" / "centre")
    caution, *_ = caplog.messages  # a network that learned so little may say so
    assert "seems to fold about 0." in caution or "seems to fold about 1." in caution
    assert model.metadata.made_with["cautions"] == [caution]
    assert f"- {caution}." in (model.folder / "card.md").read_text("utf-8")


def test_where_the_map_folds_for_certain_the_charges_of_all_contacts_go_beside_the_model(sensor, trained, tmp_path):
    contact = draw_contacts(np.random.default_rng(0), DOMAIN, 3000)
    presses = LabelledPresses(contact, 1000.0 * folded_at(5.0)(*contact.T))
    data = TrainingData(sensor=sensor, probes=("circle:1.0",), domain=DOMAIN, presses=presses, sha256="0" * 64)
    fitted = fit(data, TINY)
    (tmp_path / "charges.npz").write_bytes(fitted.provenance.files["charges.npz"])
    known = read_charges(tmp_path, 3)
    charge, _ = known.linearised(np.column_stack([contact[:, :2], np.log(contact[:, 2])]))
    assert np.allclose(charge, presses.charge, rtol=2e-3)
    assert fitted.domain.radius < 5.2 < known.radius_mm
    assert "'serve stream --track' follows contacts to 8 mm" in fitted.cautions[0]
    assert trained.split.folded_charges is None


NOISE = noise_model("reference")
FAULTS = {
    "noisy": lambda charge, rng: NOISE.add(charge, rng),
    "wrong gain": lambda charge, _: charge * [1.0, 1.3, 1.0],
    "far too hard": lambda charge, _: 4.0 * charge,
    "dead electrode": lambda charge, _: np.maximum(charge * [1.0, 0.0, 1.0], 1.0),
    "anything": lambda charge, rng: 10.0 ** rng.uniform(0.0, 4.0, charge.shape),
}


@pytest.fixture(scope="module")
def field(trained):
    return trained.split.field


@pytest.fixture(scope="module")
def held(trained):
    return trained.split.test


def by_scipy(field, charge, start):
    """min over the domain of |(Q - Q(c)) / sigma|, the disk and the range of forces as constraints."""
    sigma = np.hypot(1.0, 0.002 * charge)

    def square(unit):
        return float((((charge - field.charges(field.domain.to_contact(unit[None]))[0]) / sigma) ** 2).sum())

    inside = {"type": "ineq", "fun": lambda unit: 1.0 - unit[0] ** 2 - unit[1] ** 2}
    bounds = [(-1, 1), (-1, 1), (-1, 1)]
    found = minimize(square, start, bounds=bounds, constraints=inside, options={"ftol": 1e-12})
    return np.sqrt(square(into_domain(found.x[None])[0]))  # it may end a little outside


@pytest.mark.parametrize("fault", FAULTS)
def test_nobody_finds_a_nearer_one(field, held, fault):
    rng = np.random.default_rng(1)
    charge = FAULTS[fault](held.charge[:12], rng)
    contact, residual = search(field, charge, NOISE.sigma(charge), starts=3)
    assert np.allclose(residual, (charge - field.charges(contact)) / np.hypot(1.0, 0.002 * charge), atol=1e-8)
    assert ((np.hypot(contact[:, 0], contact[:, 1]) <= 8.0) & (contact[:, 2] >= 0.05) & (contact[:, 2] <= 2.0)).all()
    for row, found in enumerate(np.linalg.norm(residual, axis=1)):
        starts = [field.domain.to_unit(contact)[row], *into_domain(rng.uniform(-0.7, 0.7, (3, 3)))]
        best = min(by_scipy(field, charge[row], start) for start in starts)
        assert found <= best + 0.01 + 1e-3 * best


def test_examples_are_of_all_kinds_and_good_ones_are_near(field, trained):
    """A third are presses with their noise: three charges explain nearly all of it, so these are near."""
    (charge, residual), again = (draw_misfit_examples(trained.split.train, field, NOISE, 600, seed=1) for _ in range(2))
    np.testing.assert_array_equal(again, [charge, residual])
    distance = np.linalg.norm(residual, axis=1)
    assert 0.3 < np.mean(distance < 3.0) < 0.8
    assert np.mean(distance > 100.0) > 0.1
    assert 1.0 <= charge.min() <= charge.max() <= 1e6
