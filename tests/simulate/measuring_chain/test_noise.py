"""The noise model against the statistics of what it draws."""

import numpy as np
import pytest
from scipy import stats

from isocharge.common.errors import InputError
from isocharge.simulate import NoiseModel, load_amplifier, noise_model
from isocharge.simulate.measuring_chain.levels import AMPLIFIER_LEVELS


@pytest.mark.parametrize(("charge", "sigma"), [(0.0, 1e-12), (500e-12, np.sqrt(2.0) * 1e-12), (3e-9, 6.0827625e-12)])
def test_sigma_of_the_reference_level(charge, sigma):
    """(1 pC)^2 + (0.002 Q)^2; the sign of the charge does not matter."""
    model = noise_model("reference")
    np.testing.assert_allclose(model.sigma(np.array([charge, -charge])), sigma, rtol=1e-7)


@pytest.mark.parametrize("charge", [0.0, 848e-12, -2e-9])
def test_samples_are_gaussian_of_that_sigma(charge):
    model, rng = noise_model("reference"), np.random.default_rng(0)
    drawn = (model.add(np.full(20_000, charge), rng) - charge) / model.sigma(np.array(charge))
    assert stats.kstest(drawn, "norm").pvalue > 0.01


def test_channels_and_readings_are_independent():
    """No correlation between electrodes, nor from one reading to the next."""
    noise = noise_model("reference").add(np.zeros((20_000, 3)), np.random.default_rng(1))
    joined = np.concatenate([noise[1:], noise[:-1]], axis=1)
    assert np.abs(np.corrcoef(joined.T) - np.eye(6)).max() < 4.0 / np.sqrt(20_000)


def test_clean_is_exact():
    charge = np.random.default_rng(2).normal(0.0, 1e-9, (5, 3))
    np.testing.assert_array_equal(noise_model("clean").add(charge, np.random.default_rng(3)), charge)


def test_same_seed_same_noise():
    charge = np.full((4, 3), 1e-9)
    first, second, other = (noise_model("reference").add(charge, np.random.default_rng(s)) for s in (5, 5, 6))
    np.testing.assert_array_equal(first, second)
    assert np.all(first != other)


def test_charges_are_left_alone():
    charge = np.full((4, 3), 1e-9)
    noise_model("reference").add(charge, np.random.default_rng(0))
    assert np.all(charge == 1e-9)


def test_metadata_has_units():
    assert noise_model("reference").to_dict() == {"name": "reference", "white_pC": 1.0, "gain": 0.002}
    assert noise_model("clean").to_dict() == {"name": "clean", "white_pC": 0.0, "gain": 0.0}


def test_unknown_level_names_the_known_ones():
    with pytest.raises(
        InputError, match="expected one of clean, reference, bench, surgery, or a TOML file, got 'loud'"
    ):
        noise_model("loud")


@pytest.mark.parametrize("level", AMPLIFIER_LEVELS)
def test_level_is_the_same_noise_for_all(level):
    """Training and limits take charges one by one, the virtual sensor in time: from one level the same noise."""
    assert noise_model(level) == load_amplifier(level).noise


def test_noise_from_a_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('like = "reference"\nwhite_pC = 0.5\ntau_s = 3.0\n')
    made = noise_model(str(path))
    assert made.name == "mine"
    assert made.white == pytest.approx(0.5e-12)
    assert made.gain == 0.002
    assert made.to_dict() == {"name": "mine", "white_pC": 0.5, "gain": 0.002}


@pytest.mark.parametrize(
    ("text", "words"),
    [("white = 1.0", "unknown key 'white'"), ("white_pC = -1.0", "white_pC"), ('like = "loud"', "like"), ("x", "TOML")],
)
def test_wrong_noise_file_is_refused(tmp_path, text, words):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        noise_model(str(path))


@pytest.mark.parametrize(("white", "gain"), [(np.inf, 0.0), (np.nan, 0.0), (-1e-12, 0.0), (0.0, np.inf), (0.0, -1.0)])
def test_noise_is_finite_and_not_negative(white, gain):
    with pytest.raises(InputError, match="expected a finite number from 0"):
        NoiseModel("mine", white, gain)


def test_variance_is_the_square():
    charge = np.linspace(-1e-9, 1e-9, 7)
    model = noise_model("reference")
    np.testing.assert_allclose(model.variance(charge), model.sigma(charge) ** 2)
