"""Models of measured presses alone, of a sensor whose least error is known in closed form."""

import re
from dataclasses import replace

import numpy as np
import pytest

from isocharge.cli.train import fit as fit_command
from isocharge.common.errors import PressError, SceneError
from isocharge.common.measured_presses import write_presses
from isocharge.serve import Contact, MeasuredPresses, Predictor, find_model, load_model, read_presses
from isocharge.serve.prediction.press_check import check_presses
from isocharge.simulate import Domain
from isocharge.train import FitConfig, LabelledPresses, NetworkConfig, TrainingConfig, evaluate, fit_presses
from isocharge.train.data.channel_noise import ChannelNoise
from isocharge.train.data.measured_sensor import PressedArea, outline
from isocharge.train.data.presses import folds_by_place, held_out
from isocharge.train.model_release.release import model_domain, release
from isocharge.train.training.cross_fit import std_factors, usable_presses
from isocharge.train.training.features import WhitenedFeatures
from kept import ROOT, kept

QUICK = FitConfig(
    network=NetworkConfig(hidden=(24, 24), misfit_hidden=(24, 24)),
    training=TrainingConfig(steps=400, misfit_steps=400, misfit_charges=6_000, batch=256),
)
SLOPES = np.array([[0.6, 0.1, 2.0], [-0.5, 0.4, 1.0], [0.1, -0.6, 2.0], [0.2, 0.2, -4.0]])
"""d(Q)/d(x, y, ln F), pC/mm and pC: half of the charges are negative."""

NOISE = np.array([0.3, 0.2, 0.3, 0.4])


def contacts(count, seed):
    """On an L of 1,200 mm^2, whose middle is not the origin; 0.2 to 5 N."""
    rng = np.random.default_rng(seed)
    place = rng.uniform((0.0, -25.0), (40.0, 15.0), (3 * count, 2))
    place = place[(place[:, 0] < 20.0) | (place[:, 1] < -5.0)][:count]
    return np.column_stack([place, np.exp(rng.uniform(*np.log([0.2, 5.0]), count))])


def charges(contact, seed):
    """Linear in x, y and ln F, with white noise."""
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(contact), 4))
    return np.column_stack([contact[:, :2] - [20.0, -5.0], np.log(contact[:, 2])]) @ SLOPES.T + noise


def measured(contact, charge, names=("Q1", "Q2", "Q3", "Q4")):
    stds = np.full(len(contact), 0.05), np.full(len(contact), 0.005)
    return MeasuredPresses(contact, charge, *stds, names, tuple(range(2, len(contact) + 2)))


def l_shaped():
    contact = contacts(1_200, 0)
    return measured(contact, charges(contact, 1))


def made():
    return fit_presses(l_shaped(), "pad", QUICK)


@pytest.fixture(scope="module")
def alone():
    return kept(made)


@pytest.fixture(scope="module")
def fresh():
    contact = contacts(4_000, 2)
    return LabelledPresses(contact, charges(contact, 3), measured=True)


def test_the_noise_is_learned(alone):
    np.testing.assert_allclose(alone.noise.sigma(np.zeros((1, 4)))[0], NOISE, rtol=0.1)
    assert (alone.noise.gain < 0.03).all()


def test_errors_are_those_of_the_least_variance(alone, fresh):
    """Weighted least squares; edges tell a network where presses cannot be, so it may be a little better."""
    least = np.linalg.inv(SLOPES.T @ np.diag(NOISE**-2.0) @ SLOPES)
    errors = evaluate(alone, fresh)
    assert errors["position_rms_mm"] == pytest.approx(np.sqrt(least[0, 0] + least[1, 1]), rel=0.12)
    assert errors["force_rms_percent"] == pytest.approx(100.0 * np.sqrt(least[2, 2]), rel=0.12)


def test_errors_and_intervals_hold_for_presses_at_other_places(alone, fresh):
    stated = evaluate(alone)
    true = evaluate(alone, fresh)
    assert stated["position_rms_mm"] == pytest.approx(true["position_rms_mm"], rel=0.08)
    assert true["coverage_68"] == pytest.approx(0.683, abs=0.04)
    assert true["coverage_95"] == pytest.approx(0.95, abs=0.02)


def test_charges_of_no_press_have_a_large_misfit(alone, fresh):
    limit = evaluate(alone)["misfit_p99"]
    assert np.mean(alone.predict(fresh.charge)[2] > limit) < 0.03
    off = fresh.charge + 15.0 * NOISE * np.linalg.svd(SLOPES / NOISE[:, None])[0][:, 3]  # across the map's image
    assert np.mean(alone.predict(off)[2] > limit) > 0.97


def test_the_released_model_is_served_and_checked(alone, fresh, tmp_path, command, monkeypatch):
    """By the command, from a file of presses."""
    monkeypatch.setattr(fit_command, "fit_presses", lambda *_, probes, **__: replace(alone, probes=probes))
    write_presses(tmp_path / "pad.csv", l_shaped())
    assert command("train", "fit", tmp_path / "pad.csv", "-o", tmp_path / "pad")[0] == 0
    folder = tmp_path / "pad" / "1"
    predictor = Predictor(folder)
    presses = measured(fresh.contact[:200], fresh.charge[:200])
    np.testing.assert_allclose(predictor.predict(fresh.charge[0])[:3], alone.predict(fresh.charge[:1])[0][0], rtol=1e-3)
    assert check_presses(predictor, presses).fits
    assert predictor.metadata.sensor == {"name": "pad", "electrodes": ["Q1", "Q2", "Q3", "Q4"]}
    assert read_presses(folder / "presses.csv") == l_shaped()
    card = (folder / "card.md").read_text()
    errors = predictor.metadata.errors
    assert f"```bash\n{predictor.metadata.made_with['command']}\n```" in card
    assert {"| fitted to | 1200 presses at 1200 places, in `presses.csv` |", "| probes | unknown |"} <= {
        *card.splitlines()
    }
    message = re.findall(r"(?:\| \S+ and|intervals \|) (\S+) %", card)
    expected = [*alone.noise.gain, errors["coverage_68"], errors["coverage_95"]]
    np.testing.assert_allclose(np.array(message, float), 100.0 * np.array(expected), rtol=1e-2)


def presses_off_the_origin(count, seed):
    """On a pad with x from 0 to 60 mm and y from -15 to 15 mm, charges linear in place and ln F."""
    rng = np.random.default_rng(seed)
    place = rng.uniform((0.0, -15.0), (60.0, 15.0), (count, 2))
    contact = np.column_stack([place, np.exp(rng.uniform(*np.log([0.2, 5.0]), count))])
    centred = np.column_stack([place - [30.0, 0.0], np.log(contact[:, 2])])
    return measured(contact, centred @ SLOPES.T + NOISE * rng.standard_normal((count, 4)))


def made_off_the_origin():
    return fit_presses(presses_off_the_origin(900, 7), "long-pad", QUICK)


@pytest.fixture(scope="module")
def long_pad(tmp_path_factory):
    """The folder of a model of a pad whose area begins at the origin."""
    folder = tmp_path_factory.mktemp("models") / "long-pad"
    release(kept(made_off_the_origin), folder)
    return folder


def test_an_area_that_begins_at_the_origin_holds_its_own_presses():
    contact = presses_off_the_origin(900, 7).contact
    area = PressedArea.of(contact)
    assert area.contains(contact).all()
    area.check(np.array([[50.0, 0.0, 1.0]]), "pad")
    beside = np.array([[-20.0, 0.0, 1.0], [50.0, 20.0, 1.0], [50.0, 0.0, 9.0], [np.nan, 0.0, 1.0]])
    assert not area.contains(beside).any()
    with pytest.raises(SceneError, match=r"press 0 at \(-20, 0\) mm .* in the pressed area, x from -\d.* to 6\d"):
        area.check(beside, "pad")


def test_the_domain_of_a_released_pad_is_its_area(long_pad):
    """Not the largest disk about the origin in it, which has 2 mm here."""
    about = Predictor(long_pad).metadata
    domain = model_domain(about)
    trained = kept(made_off_the_origin).domain
    assert domain == trained
    contact = presses_off_the_origin(900, 7).contact
    assert domain.contains(contact).all()
    disk = load_model(find_model("three-25um-biaxial")).metadata
    assert model_domain(disk) == Domain(pytest.approx(8.0, abs=0.1), disk.force_range_N)


def test_a_pad_that_begins_at_the_origin_is_answered_and_flagged_where_it_lies(long_pad):
    """(50, 0) is on the pad, (-20, 0) is nearer to the origin and beside it."""
    predictor = Predictor(long_pad)
    places = np.array([[50.0, 0.0, 1.0], [5.0, -10.0, 1.0], [-20.0, 0.0, 1.0]])
    charge = np.column_stack([places[:, :2] - [30.0, 0.0], np.log(places[:, 2])]) @ SLOPES.T
    answers = predictor.predict_batch(charge)
    assert np.hypot(answers.x_mm - places[:, 0], answers.y_mm - places[:, 1])[:2].max() < 3.0
    flags = predictor.validity.batch_flags(answers)
    assert flags == [predictor.flags(predictor.predict(row)) for row in charge]
    assert flags[:2] == [(), ()]
    on_pad = Contact(50.0, 0.0, 1.0, 0.1, 0.1, 0.1, 0.1)
    assert predictor.flags(on_pad._replace(x_mm=-20.0)) == ("outside",)
    radius = np.hypot(30.0, 15.0)
    assert predictor.flags(on_pad._replace(x_mm=30.0 + 2.8 * radius)) == ("outside",)
    assert predictor.flags(on_pad._replace(x_mm=30.0 + 3.5 * radius)) == ("outside", "beyond")
    assert predictor.flags(on_pad._replace(x_mm=30.0 - 3.5 * radius)) == ("outside", "beyond")
    assert "positions from (-" in repr(predictor)
    check = check_presses(predictor, presses_off_the_origin(200, 8))
    assert check.fits


def test_the_outline_is_that_of_the_area():
    place = np.stack(np.meshgrid(np.arange(11.0), np.arange(11.0)), axis=-1).reshape(-1, 2)
    assert sorted(map(tuple, outline(place))) == [(-0.5, -0.5), (-0.5, 10.5), (10.5, -0.5), (10.5, 10.5)]
    x, y = outline(contacts(2_000, 4)[:, :2]).T
    assert 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) == pytest.approx(1200.0, rel=0.05)
    assert PressedArea.of(np.pad(place, ((0, 0), (0, 1)), constant_values=1.0)).radius == pytest.approx(5.5 * 2**0.5)
    with pytest.raises(PressError, match="expected presses over an area"):
        outline(np.column_stack([np.arange(9.0), np.arange(9.0)]))


def test_one_force_and_channels_that_are_mostly_zero():
    contact = contacts(600, 6) * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0]
    low, high = PressedArea.of(contact).force_range
    assert low < 2.0 < high
    charge = np.where(np.random.default_rng(7).random((600, 4)) < 0.6, 0.0, charges(contact, 8))
    noise = ChannelNoise.of(charge, PressedArea.of(contact).to_unit(contact))
    np.testing.assert_allclose(noise.charge(noise.level(charge)), charge, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(noise.bend(np.abs(charge)), noise.bend(-np.abs(charge)))
    assert np.isfinite(WhitenedFeatures.fit_signed(charge, noise.bend(charge)).matrix).all()


def test_a_place_is_in_one_fold():
    place = np.repeat(contacts(100, 5), 7, axis=0)
    fold = folds_by_place(place, 5)
    assert (fold.reshape(100, 7) == fold[::7, None]).all()
    assert np.bincount(fold).tolist() == [140] * 5
    assert ((fold == 0) == held_out(place)).all()


def test_deviations_that_are_too_small_are_multiplied():
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((20_000, 3))
    off = np.array([2.0, 2.0, 0.5]) * rng.standard_normal(truth.shape)
    assert std_factors(truth + off, np.ones_like(truth), truth) == pytest.approx((2.0, 0.5), rel=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda given: given[:499], "expected at least 500 presses at 50 places with .* got 499 at 499; .*--sensor"),
        (lambda given: given.of_electrodes(("Q1", "Q2"), "us"), r"expected 3 to 8 channels, got 2 \(Q1, Q2\)"),
    ],
)
def test_too_few_presses_or_channels_train_no_model(change, message):
    with pytest.raises(PressError, match=message):
        usable_presses(change(l_shaped()))


def with_channel(channel, values):
    """Return the presses of the L with other charges of one channel, which are a function of the charges."""
    presses = l_shaped()
    charge = presses.charge_pC.copy()
    charge[:, channel] = values(charge)
    return measured(presses.contact, charge)


def with_contact(column, values):
    """Return the presses of the L with another column of the contact, which is a function of the contact."""
    presses = l_shaped()
    contact = presses.contact.copy()
    contact[:, column] = values(contact)
    return measured(contact, presses.charge_pC)


def once(value, column):
    """Return a function that gives a column with another value in the eighth press."""
    return lambda rows: np.where(np.arange(len(rows)) == 7, value, rows[:, column])


JITTER = np.random.default_rng(5).standard_normal(1_200)

FAULTY_PRESSES = {
    "a copied channel": (
        with_channel(1, lambda charge: charge[:, 0]),
        r"channels 'Q1', 'Q2': expected charges that are linearly independent",
    ),
    "a copy in single precision": (
        with_channel(1, lambda charge: charge[:, 0].astype(np.float32).astype(float)),
        "channels 'Q1', 'Q2': expected charges that are linearly independent",
    ),
    "a scaled and shifted copy": (with_channel(3, lambda charge: 3.0 - 2.0 * charge[:, 1]), "channels 'Q2', 'Q4': "),
    "a sum of channels": (with_channel(3, lambda charge: charge[:, 0] + charge[:, 2]), "channels 'Q1', 'Q3', 'Q4': "),
    "a charge of 1e37": (
        with_channel(2, once(1e37, 2)),
        r"^line 9, column 'Q3': expected a value of the size of the others, whose median is .* got 1e\+37; correct it",
    ),
    "a charge of -1e6": (
        with_channel(0, once(-1e6, 0)),
        r"^line 9, column 'Q1': .* got -1e\+06; correct it, or remove",
    ),
    "a position in another unit": (with_contact(0, once(1e6, 0)), r"^line 9, column 'x_mm': .* got 1e\+06"),
    "a force of 1e20": (with_contact(2, once(1e20, 2)), r"^line 9, column 'force_N': .* got 1e\+20"),
    "a force of 1e-20": (with_contact(2, once(1e-20, 2)), "^line 9, column 'force_N': .* got 1e-20"),
    "denormal charges": (
        with_channel(1, lambda charge: 1e-310 * charge[:, 1]),
        "channel 'Q2': expected charges in pC, of 1e-30 to 1e.30, got .*e-310 as the median .* check the unit",
    ),
    "huge charges": (with_channel(1, lambda charge: 1e35 * charge[:, 1]), "channel 'Q2': expected charges in pC"),
    "a constant channel": (
        with_channel(2, lambda charge: 0.0 * charge[:, 2]),
        "channel 'Q3': expected charges that vary, got 0 everywhere; leave the channel out",
    ),
    "a channel that is constant but for rounding": (
        with_channel(2, lambda charge: 5.0 + 1e-12 * charge[:, 2]),
        "channel 'Q3': expected charges that vary, got 5 everywhere",
    ),
    "a channel with a single charge": (
        with_channel(2, lambda _: np.where(np.arange(1_200) == 7, 5.0, 0.0)),
        "channel 'Q3': expected charges that vary, got 0 in all but 1 of 1200 presses",
    ),
    "positions with one y": (with_contact(1, lambda _: np.full(1_200, 3.0)), "got 1200 places on one line"),
    "positions with one y but for rounding": (
        with_contact(1, lambda _: 3.0 + 1e-9 * JITTER),
        "got 1200 places on one line; press beside it, too",
    ),
    "positions on a line": (with_contact(1, lambda contact: 2.0 * contact[:, 0]), "got 1200 places on one line"),
    "one position": (with_contact(slice(2), lambda _: np.ones((1_200, 2))), "got 1200 at 1; measure more"),
}
"""Presses of which each has one fault, and the message that names the fault."""


@pytest.mark.parametrize("fault", FAULTY_PRESSES)
def test_faulty_presses_are_refused_before_the_training(fault):
    presses, message = FAULTY_PRESSES[fault]
    with pytest.raises(PressError, match=message):
        fit_presses(presses, "pad", QUICK)


def test_presses_of_one_force_are_learned_with_a_warning(caplog):
    usable_presses(with_contact(2, lambda _: np.full(1_200, 2.0)))
    assert "all presses have a force of about 2 N: the model can estimate no other force" in caplog.text
    caplog.clear()
    usable_presses(l_shaped())
    assert not caplog.text


def test_the_faults_are_found_in_no_intact_presses():
    """Charges of any unit, channels that are mostly zero, a few percent of noise, and a measured pad."""
    usable_presses(read_presses(ROOT / "tests" / "data" / "tactile_fsi.csv"))
    given = l_shaped()
    for unit in (1e-12, 1e12):
        usable_presses(measured(given.contact, unit * given.charge_pC))
    mostly_zero = np.random.default_rng(7).random((1_200, 4)) < 0.9
    usable_presses(measured(given.contact, np.where(mostly_zero, 0.0, given.charge_pC)))
    usable_presses(with_channel(1, lambda charge: charge[:, 0] * (1.0 + 0.01 * JITTER)))


def test_a_faulty_file_leaves_no_folder(refused, tmp_path):
    presses, _ = FAULTY_PRESSES["a copied channel"]
    write_presses(tmp_path / "pad.csv", presses)
    refused(
        *("train", "fit", tmp_path / "pad.csv", "-o", tmp_path / "pad"),
        message="channels 'Q1', 'Q2': expected charges that are linearly independent",
    )
    assert not (tmp_path / "pad").exists()


@pytest.mark.slow
def test_a_real_pad_is_learned_better_than_by_boosted_trees():
    """TactileFSI (SDU Soft Robotics, CC BY 4.0): errors at a fifth of the places; trees: 6.93 mm and 27.0 %."""
    presses = read_presses(ROOT / "tests" / "data" / "tactile_fsi.csv")
    out = held_out(presses.contact)
    fitted = fit_presses(presses[~out], "pad")
    errors = evaluate(fitted, LabelledPresses(presses.contact[out], presses.charge_pC[out], measured=True))
    assert errors["position_rms_mm"] < 6.93
    assert errors["force_rms_percent"] < 27.0
    assert 0.63 < errors["coverage_68"] < 0.75
    assert 0.92 < errors["coverage_95"] < 0.98
