"""Where the map folds: a made-up one with its fold known, and the layouts that are known for theirs."""

import re
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError
from isocharge.simulate import Domain, Electrode, Sweep, load_sensor, noise_model, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit, release
from isocharge.train.data.charge_field import ChargeField, invertible_domain
from isocharge.train.data.presses import LabelledPresses, draw_contacts

TINY = FitConfig(
    network=NetworkConfig(hidden=(8, 8), misfit_hidden=(8, 8)),
    training=TrainingConfig(steps=5, misfit_steps=5, misfit_charges=1_000),
)
REFERENCE = noise_model("reference")


def field_of(charges, noise=0.0):
    rng, domain = np.random.default_rng(0), Domain(8.0, (0.05, 2.0))
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
    u, v = 0.1 * x, 0.1 * y
    shapes = np.stack([0 * u, u**2, u * (u**2 - 0.09), v], axis=1)
    return 1e4 * force[:, None] ** 0.7 * np.exp(shapes)


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
    (caution,) = caplog.messages
    assert "seems to fold about 0." in caution or "seems to fold about 1." in caution
    assert model.metadata.made_with["cautions"] == [caution]
    assert f"- {caution}." in (model.folder / "card.md").read_text("utf-8")


def test_five_electrodes_with_one_in_the_middle_do_not_fold(film, sensor, tmp_path, caplog):
    five = layout(sensor, (0.0, 0.0), (12.0, 0.0), (0.0, 12.0), (-12.0, 0.0), (0.0, -12.0))
    dataset = swept(tmp_path, film, 3_000, five, radius=5.0)
    fitted = fit(dataset, TINY)
    assert not caplog.messages
    assert all(np.isfinite(part).all() for part in fitted.predict(dataset.samples.charge_pC[:50]))


def test_three_uniaxial_electrodes_fold_inside_five_mm(film, tmp_path, caplog):
    uniaxial = load_sensor("three-25um-uniaxial")
    fitted = fit(swept(tmp_path, film, 6_000, uniaxial, radius=6.0), TINY)
    assert 1.0 < fitted.domain.radius < 5.0
    assert fitted.asked.radius == 6.0
    assert np.hypot(*fitted.test.contact[:, :2].T).max() <= fitted.domain.radius
    assert fitted.cautions == tuple(caplog.messages)
