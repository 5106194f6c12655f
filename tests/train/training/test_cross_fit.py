"""Tests of models of measured presses alone, for a sensor whose smallest error is known in closed form."""

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.train.measured import measured_presses
from tests.train.short_training import short_training

from isocharge.cli.train import fit as fit_command
from isocharge.common.contact_domain import with_log_force
from isocharge.common.errors import PressError
from isocharge.serve import Contact, Predictor, read_presses
from isocharge.serve.prediction.press_check import check_presses
from isocharge.serve.presses.measured_presses import write_presses
from isocharge.simulate import NoiseModel
from isocharge.train import LabelledPresses, evaluate, fit_presses
from isocharge.train.data.channel_noise import LocalPlanes
from isocharge.train.data.measured_sensor import PressedArea, outline
from isocharge.train.data.presses import position_ranks
from isocharge.train.model_release.evaluate import contact_errors
from isocharge.train.model_release.release import release
from isocharge.train.training.cross_fit import usable_presses
from kept import ROOT

QUICK = short_training(24, 24, 250, 150, 4_000)
QUICKER = short_training(16, 16, 60, 40, 1_000)
"""Training of a network whose errors are not compared with the smallest possible errors."""

SLOPES = np.array([[0.6, 0.1, 2.0], [-0.5, 0.4, 1.0], [0.1, -0.6, 2.0], [0.2, 0.2, -4.0]])
"""Derivatives of the charges with respect to (x, y, ln F), shape (4, 3), pC/mm and pC. Half of the charges are
negative."""

NOISE_pC = np.array([0.3, 0.2, 0.3, 0.4])
"""Standard deviation of the white noise of each channel, pC."""

REAL_PAD = ROOT / "tests/data/tactile_fsi.csv"
"""Presses on a real pad of TactileFSI."""

CHANNELS = ("Q1", "Q2", "Q3", "Q4")

FORCES_N = (0.2, 5.0)
"""Smallest and largest force of the presses, N."""


def draw_forces(rng, count):
    """Draw log-uniform forces, shape (count,), N."""
    return np.exp(rng.uniform(*np.log(FORCES_N), count))


def contacts_on_l(count, seed):
    """Draw contacts on an area with the shape of an L, of 1,200 mm^2, whose middle is not the origin."""
    rng = np.random.default_rng(seed)
    square = rng.uniform((0.0, -25.0), (40.0, 15.0), (3 * count, 2))
    is_on_l = (square[:, 0] < 20.0) | (square[:, 1] < -5.0)
    return np.column_stack([square[is_on_l][:count], draw_forces(rng, count)])


def charges_on_l(contact, seed):
    """Return charges with white noise, shape (n, 4), pC, that are linear in x, y and ln F.

    The contacts (x, y, F) have the shape (n, 3), mm and N. A force of 1 N on the middle of the L gives no charge.
    """
    noise = NOISE_pC * np.random.default_rng(seed).standard_normal((len(contact), 4))
    return (with_log_force(contact) - [20.0, -5.0, 0.0]) @ SLOPES.T + noise


def presses_on_l():
    """Return the presses on the L with which the network is trained."""
    contact = contacts_on_l(1_200, 0)
    return measured_presses(contact, charges_on_l(contact, 1), CHANNELS)


@pytest.fixture(scope="module")
def fitted_pad():
    """The network that was trained on the presses on the L."""
    return fit_presses(presses_on_l(), "pad", QUICK)


@pytest.fixture(scope="module")
def fresh():
    """Presses on the L that were not used in the training."""
    contact = contacts_on_l(4_000, 2)
    return LabelledPresses(contact, charges_on_l(contact, 3))


def errors_on(fitted, presses):
    """Return the errors of a network on measured presses, by name."""
    contact, std, _ = fitted.predict(presses.charge)
    return contact_errors(contact, std, presses.contact)


def test_the_noise_of_the_channels_is_estimated(fitted_pad):
    np.testing.assert_allclose(fitted_pad.noise.sigma(np.zeros((1, 4)))[0], NOISE_pC, rtol=0.1)
    assert (fitted_pad.noise.gain < 0.03).all()


def test_errors_are_those_of_weighted_least_squares(fitted_pad, fresh):
    """Weighted least squares has the smallest variance of all linear estimators.

    The network may have slightly smaller errors, because it learns the edges of the area.
    """
    x_variance, y_variance, force_variance = np.diag(np.linalg.inv(SLOPES.T @ np.diag(NOISE_pC**-2.0) @ SLOPES))
    errors = errors_on(fitted_pad, fresh)
    assert errors["position_rms_mm"] == pytest.approx(np.sqrt(x_variance + y_variance), rel=0.12)
    assert errors["force_rms_percent"] == pytest.approx(100.0 * np.sqrt(force_variance), rel=0.12)


def test_errors_and_intervals_hold_for_presses_at_other_places(fitted_pad, fresh):
    stated_errors = evaluate(fitted_pad)
    fresh_errors = errors_on(fitted_pad, fresh)
    assert stated_errors["position_rms_mm"] == pytest.approx(fresh_errors["position_rms_mm"], rel=0.08)
    assert fresh_errors["coverage_68"] == pytest.approx(0.683, abs=0.04)
    assert fresh_errors["coverage_95"] == pytest.approx(0.95, abs=0.02)


def test_charges_that_no_press_gives_have_a_large_misfit(fitted_pad, fresh):
    limit = evaluate(fitted_pad)["misfit_p99"]
    _, _, misfit = fitted_pad.predict(fresh.charge)
    assert np.mean(misfit > limit) < 0.03
    # The last left singular vector is perpendicular to all charges that contacts give.
    left_singular_vectors, _, _ = np.linalg.svd(SLOPES / NOISE_pC[:, None])
    impossible_charge = fresh.charge + 15.0 * NOISE_pC * left_singular_vectors[:, 3]
    _, _, large_misfit = fitted_pad.predict(impossible_charge)
    assert np.mean(large_misfit > limit) > 0.97


@pytest.fixture
def released_pad(fitted_pad, tmp_path, command, monkeypatch):
    """The version folder that `isocharge train fit` writes from a file of presses."""
    monkeypatch.setattr(fit_command, "fit_presses", lambda *_, probes, **__: replace(fitted_pad, probes=probes))
    write_presses(tmp_path / "pad.csv", presses_on_l())
    assert command("train", "fit", tmp_path / "pad.csv", "-o", tmp_path / "pad")[0] == 0
    return tmp_path / "pad/1"


def test_fit_command_releases_a_model_of_measured_presses(fitted_pad, fresh, released_pad):
    predictor = Predictor(released_pad)
    expected_contact, _, _ = fitted_pad.predict(fresh.charge[:1])
    np.testing.assert_allclose(predictor.predict(fresh.charge[0])[:3], expected_contact[0], rtol=1e-3)
    assert check_presses(predictor, measured_presses(fresh.contact[:200], fresh.charge[:200], CHANNELS)).fits
    assert predictor.metadata.sensor == {"name": "pad", "electrodes": ["Q1", "Q2", "Q3", "Q4"]}
    np.testing.assert_equal(read_presses(released_pad / "presses.csv").columns, presses_on_l().columns)


def test_card_of_a_model_of_measured_presses_states_noise_and_coverage(fitted_pad, released_pad):
    metadata = Predictor(released_pad).metadata
    card = (released_pad / "card.md").read_text()
    assert f"```bash\n{metadata.made_with['command']}\n```" in card
    # A few of the 1,200 random positions are closer to another one than the errors of the positions.
    assert re.search(r"1200 measured presses at 1[01][0-9]{2} places, which are in `presses\.csv`", card)
    assert "\n| probes | unknown |\n" in card
    assert "It is large if the charges do not belong to one press." in card
    percentages = re.findall(r"pC and (\S+) %|intervals \| (\S+)%", card)
    expected = [*fitted_pad.noise.gain, metadata.errors["coverage_68"], metadata.errors["coverage_95"]]
    stated = np.array([float(gain or coverage) for gain, coverage in percentages])
    np.testing.assert_allclose(stated, 100.0 * np.array(expected), rtol=1e-2)


def test_pressed_area_contains_its_own_presses_and_no_others(released_pad):
    """The corner at (40, 15) mm does not belong to the L."""
    metadata = Predictor(released_pad).metadata
    area = PressedArea.of_contacts(presses_on_l().contact)
    assert (area.corners, area.force_range) == (metadata.working_area_mm, metadata.force_range_N)
    assert area.contains(presses_on_l().contact).all()
    outside = np.array([[-20.0, 0.0, 1.0], [36.0, 10.0, 1.0], [10.0, 0.0, 9.0], [np.nan, 0.0, 1.0]])
    assert not area.contains(outside).any()
    # A contact is beyond the area at three times its radius from its centre, which is not the origin.
    flags = Predictor(released_pad).flags
    contact = Contact(10.0, 0.0, 1.0, 0.1, 0.1, 0.1, 0.1)
    assert flags(contact) == ()
    assert flags(contact._replace(x_mm=20.0 + 2.8 * area.radius)) == ("outside",)
    assert flags(contact._replace(x_mm=20.0 - 3.5 * area.radius)) == ("outside", "beyond")


def test_outline_of_a_square_grid_is_larger_by_half_the_grid_step():
    places = np.argwhere(np.ones((11, 11)))
    assert sorted(map(tuple, outline(places))) == [(-0.5, -0.5), (-0.5, 10.5), (10.5, -0.5), (10.5, 10.5)]
    contact = np.column_stack([places, np.ones(len(places))])
    assert PressedArea.of_contacts(contact).radius == pytest.approx(5.5 * np.sqrt(2.0))


def test_charges_between_places_that_were_pressed_many_times_fit_the_presses():
    """With more repetitions than neighbours, a plane must still know how the charges change from place to place."""
    contact = np.repeat(contacts_on_l(200, 5), 20, axis=0)
    to_unit = PressedArea.of_contacts(contact).to_unit
    planes = LocalPlanes.fit(to_unit(contact), charges_on_l(contact, 8) / NOISE_pC)
    other_contact = contacts_on_l(300, 6)
    residual = planes.residuals(charges_on_l(other_contact, 9) / NOISE_pC)
    # Four charges of three unknowns leave one noise with standard deviation 1, spread over four residuals.
    assert 0.1 < np.median(np.abs(residual)) < 0.4


def with_column(name, column, new_values):
    """Return the presses on the L with other values in one column of their contacts or of their charges.

    Args:
        name: "contact" for the contacts (x, y, F), or "charge_pC".
        column: Number of the column.
        new_values: Function from all columns, shape (n, n_column), to the values of this column, shape (n,).
    """
    presses = presses_on_l()
    rows = getattr(presses, name).copy()
    rows[:, column] = new_values(rows)
    return replace(presses, **{name: rows})


JITTER = np.random.default_rng(5).standard_normal(1_200)

FAULTY_PRESSES = {
    "too few presses": (
        presses_on_l()[:499],
        "expected at least 500 presses at 50 places with .* got 499 at 4[0-9]+; .*train calibrate",
    ),
    "too few places, to which a robot returns with errors of 50 um": (
        replace(presses_on_l(), contact=np.tile(contacts_on_l(12, 0), (100, 1)) + JITTER[:, None] * [0.05, 0.05, 0.0]),
        "expected at least 500 presses at 50 places with .* got 1200 at 12",
    ),
    "too few channels": (
        presses_on_l().of_electrodes(("Q1", "Q2"), "pad"),
        r"expected 3 to 32 channels, got 2 \(Q1, Q2\)",
    ),
    "a sum of channels": (
        with_column("charge_pC", 3, lambda charge: charge[:, 0] + charge[:, 2]),
        "channels 'Q1', 'Q3', 'Q4': expected charges that are linearly independent",
    ),
    "a charge of 1e37": (
        with_column("charge_pC", 2, lambda charge: np.where(np.arange(1_200) == 7, 1e37, charge[:, 2])),
        r"^line 9, column 'Q3': expected a value of the size of the others, whose median is .* got 1e\+37; correct it",
    ),
    "a channel that is constant but for rounding": (
        with_column("charge_pC", 2, lambda charge: 5.0 + 1e-12 * charge[:, 2]),
        "channel 'Q3': expected charges that vary, got 5 in 1200 of 1200",
    ),
    "a channel with a single charge": (
        with_column("charge_pC", 2, lambda _: np.where(np.arange(1_200) == 7, 5.0, 0.0)),
        "channel 'Q3': expected charges that vary, got 0 in 1199 of 1200 presses",
    ),
    "a channel with the numbers of the presses": (
        with_column("charge_pC", 2, lambda _: np.arange(1_200.0)),
        "channel 'Q3': expected charges, got values in ascending order; leave out",
    ),
    "positions with one y but for rounding": (
        with_column("contact", 1, lambda _: 3.0 + 1e-9 * JITTER),
        "got [0-9]+ places on one line; press beside it, too",
    ),
}
"""Presses of which each has one fault, and the message that names the fault."""


@pytest.mark.parametrize("fault", FAULTY_PRESSES)
def test_faulty_presses_are_refused_before_the_training(fault):
    presses, message = FAULTY_PRESSES[fault]
    with pytest.raises(PressError, match=message):
        fit_presses(presses, "pad", QUICK)


def presses_of_one_force(force_N):
    """Return presses on the L with one dead weight of 2 N, whose stated force is `force_N`; NaN if it is unknown."""
    contact = contacts_on_l(1_200, 0)
    contact[:, 2] = 2.0
    charge = charges_on_l(contact, 1)
    contact[:, 2] = force_N
    return measured_presses(contact, charge, CHANNELS)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("force_N", "stated_N", "stated_std", "warning"),
    [
        (2.0, 2.0, 0.005, "all presses have a force of about 2 N: the model can estimate no other force"),
        (np.nan, 1.0, 1.0, "no press has a known force"),
    ],
)
def test_presses_of_one_force_or_without_forces_train_x_and_y(force_N, stated_N, stated_std, warning, tmp_path, caplog):
    presses = presses_of_one_force(force_N)
    fitted = fit_presses(presses, "pad", QUICKER)
    assert warning in caplog.text
    contact, std, _ = fitted.predict(presses.charge_pC)
    np.testing.assert_allclose(contact[:, 2], stated_N, rtol=1e-6)
    np.testing.assert_allclose(std[:, 2], stated_std * stated_N, rtol=1e-4)
    errors = evaluate(fitted)
    assert errors["position_rms_mm"] < 1.5
    assert 0.65 <= errors["coverage_68"] <= 0.71
    assert not [name for name in errors if name.startswith("force_")]
    folder = release(fitted, tmp_path / "pad").folder
    stated = f"every answer is {stated_N:g} N with a standard deviation of {100.0 * stated_std:g} %"
    assert f"| forces | not estimated: {stated}" in (folder / "card.md").read_text()
    np.testing.assert_array_equal(read_presses(folder / "presses.csv").contact, presses.contact)
    predictor = Predictor(folder)
    answer = predictor.predict(presses.charge_pC[0])
    assert np.isfinite(answer[:7]).all()
    assert predictor.flags(answer) == ()


def test_presses_with_three_forces_give_a_model_with_a_caution(caplog):
    presses = with_column("contact", 2, lambda _: np.resize([0.5, 1.0, 2.0], 1_200))
    assert "no press has a force between 0.5 and 1 N" in str(fit_presses(presses, "pad", QUICKER).made_with["cautions"])
    assert "measure forces all over the range" in caplog.text


def test_unknown_forces_that_vary_are_not_taken_for_noise():
    rng = np.random.default_rng(0)
    position = np.repeat(rng.uniform(-8.0, 8.0, (60, 2)), 10, axis=0)
    distance = np.linalg.norm(position[:, None] - 12.0 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]), axis=2)
    charge = 500.0 * draw_forces(rng, 600)[:, None] ** 0.67 * np.exp(-((distance / 20.0) ** 2))
    charge = NoiseModel("bench", 1.0, 0.005).add(charge, rng)
    contact = np.column_stack([position, np.full(600, np.nan)])
    fitted = fit_presses(measured_presses(contact, charge, CHANNELS), "pad", QUICKER)
    np.testing.assert_allclose(fitted.noise.gain, 0.005, rtol=0.4)
    faulty_charge = charge * [1.5, 1.0, 1.0, 1.0]  # a wrong gain
    assert np.median(fitted.predict(faulty_charge).misfit) > 5.0 * np.median(fitted.predict(charge).misfit)


def test_intact_presses_are_accepted_without_a_warning(caplog):
    """Charges in other units, channels that are mostly zero, similar channels, and presses on a real pad."""
    usable_presses(read_presses(REAL_PAD))
    presses = presses_on_l()
    for unit in (1e-12, 1e12):
        usable_presses(replace(presses, charge_pC=unit * presses.charge_pC))
    is_zero = np.random.default_rng(7).random((1_200, 4)) < 0.9
    usable_presses(replace(presses, charge_pC=np.where(is_zero, 0.0, presses.charge_pC)))
    usable_presses(with_column("charge_pC", 1, lambda charge: charge[:, 0] * (1.0 + 0.01 * JITTER)))
    assert not caplog.text


def test_model_of_three_channels_fits_presses_like_those_of_its_training(fresh, tmp_path):
    """Three charges always fit a plane exactly, but the misfit that the network states is not exactly zero."""
    fitted = fit_presses(presses_on_l().of_electrodes(CHANNELS[:3], "pad"), "pad", QUICKER)
    _, _, misfit = fitted.predict(fresh.charge[:, :3])
    assert np.mean(misfit > evaluate(fitted)["misfit_p99"]) < 0.03
    predictor = Predictor(release(fitted, tmp_path / "pad").folder)
    new_presses = measured_presses(fresh.contact[:200], fresh.charge[:200, :3], CHANNELS[:3])
    assert "misfit" not in check_presses(predictor, new_presses).verdict


@pytest.mark.slow
def test_a_real_pad_is_learned_better_than_by_boosted_trees(monkeypatch):
    """The data are TactileFSI (SDU Soft Robotics, CC BY 4.0), of which a fifth of the places is held out.

    Boosted trees have errors of 6.93 mm and 27.0 % on the held-out presses.
    """
    monkeypatch.setattr("isocharge.train.training.cross_fit.N_FOLDS", 5)  # as usual
    presses = read_presses(REAL_PAD)
    is_held_out = position_ranks(presses.contact) < 0.2
    fitted = fit_presses(presses[~is_held_out], "pad")
    held_out_presses = presses[is_held_out]
    errors = errors_on(fitted, LabelledPresses(held_out_presses.contact, held_out_presses.charge_pC))
    assert errors["position_rms_mm"] < 6.93
    assert errors["force_rms_percent"] < 27.0
    assert 0.63 < errors["coverage_68"] < 0.75
    assert 0.92 < errors["coverage_95"] < 0.98
