"""Amplifier, compared with closed forms of a leaky integrator and with statistics of noise, hum and drift."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import InputError
from isocharge.simulate import Amplifier, load_amplifier, noise_model

CLEAN = noise_model("clean")
RATE = 200.0


def measure(amplifier, charge, seed=0, rate=RATE, blocks=1):
    """Readings of charges, shape (n, electrodes), pC, that are simulated in a number of blocks."""
    process = amplifier.start(charge.shape[1], rate, np.random.default_rng(seed))
    return np.concatenate([process(block) for block in np.array_split(charge, blocks)]), process


def step(n=2000, at=200, height=400.0, electrodes=3):
    charge = np.zeros((n, electrodes))
    charge[at:] = height
    return charge


@pytest.mark.parametrize(
    ("part", "tau"),
    [
        (Amplifier(noise=CLEAN, tau=1.0), 1.0),
        (Amplifier(noise=CLEAN, tau=10.0), 10.0),
        (load_amplifier("clean"), np.inf),
    ],
)
def test_held_charge_decays_exponentially(part, tau):
    """The charge arrives between two readings, half an interval before the second one on average."""
    readings, _ = measure(part, step())
    t = (0.5 + np.arange(1800)) / RATE
    np.testing.assert_allclose(readings[200:], 400.0 * np.exp(-t / tau)[:, None] * np.ones(3), rtol=1e-5)
    np.testing.assert_array_equal(readings[:200], 0.0)


def test_bias_current_settles_at_current_times_tau():
    readings, process = measure(Amplifier(noise=CLEAN, tau=2.0, bias=0.5), np.zeros((1000, 3)))
    np.testing.assert_allclose(readings, np.broadcast_to(process.bias * 2.0, readings.shape), rtol=2e-3)


def test_deterministic_readings_do_not_depend_on_the_block_size():
    part = replace(load_amplifier("bench"), noise=CLEAN, temperature_rms=0.0)
    whole, many = (measure(part, step(), blocks=blocks)[0] for blocks in (1, 37))
    np.testing.assert_allclose(whole, many, atol=0.046)  # one step of the converter


def test_hum_has_its_amplitude_and_frequency():
    readings, _ = measure(Amplifier(noise=CLEAN, hum=1.0), np.zeros((2000, 1)), rate=1000.0)
    spectrum = np.abs(np.fft.rfft(readings[:, 0])) * 2 / 2000
    assert np.argmax(spectrum) / 2.0 == 50.0
    assert spectrum.max() == pytest.approx(1.0, rel=1e-6)


def test_temperature_drift_is_smooth_and_equal_on_all_electrodes():
    part = Amplifier(noise=CLEAN, temperature_rms=0.05, temperature_time=20.0, film_time=5.0)
    readings, _ = measure(part, np.zeros((400_000, 3)), rate=20.0)
    np.testing.assert_allclose(readings, readings[:, :1] * np.ones(3), atol=1e-8)
    change = readings[:, 0] + 0.0
    assert change.std() == pytest.approx(0.05 * 270.0, rel=0.15)
    rate_of_change = np.diff(change)[::10] * 20.0
    assert rate_of_change.std() == pytest.approx(0.05 * 270.0 / 10.0, rel=0.1)  # rms / sqrt(20 s * 5 s): lag behind lag


def test_temperature_step_gives_the_pyroelectric_charge_of_each_electrode():
    """The temperature rises by 0.5 K within 5 ms, and falls again after 10 s.

    A film of 25 um follows with the time constant rho c h / (2 U) = 2.67 s. The charge of the temperature is negative,
    while that of a press is positive.
    """
    part = Amplifier(noise=CLEAN, step=0.5, step_at=2.0, step_time=0.005, step_for=10.0, pyro_mismatch=0.2)
    readings, process = measure(part, np.zeros((5000, 4)))
    assert part.pyro == -270.0
    assert np.ptp(process.pyro_charge_per_K) > 20.0
    time = np.arange(5000) / RATE
    rise, fall = (1.0 - np.exp(-np.maximum(time - start, 0.0) / 2.67) for start in (2.0, 12.0))
    np.testing.assert_allclose(readings, 0.5 * np.outer(rise - fall, process.pyro_charge_per_K), atol=0.4)


def test_converter_clips_and_rounds_to_16_bits():
    part = Amplifier(noise=CLEAN, limit=1500.0, bits=16)
    readings, _ = measure(part, np.linspace(-2000.0, 2000.0, 5000)[:, None])
    assert readings.min() == pytest.approx(-1500.0)
    assert 1499.9 < readings.max() < 1500.0
    steps = np.diff(np.unique(readings))
    assert steps.min() == pytest.approx(3000.0 / 65536)  # 0.046 pC


def test_mismatch_is_drawn_once_for_each_channel():
    process = load_amplifier("bench").start(20_000, RATE, np.random.default_rng(0))
    stds = [values.std() for values in (process.gain, process.leak_time, process.offset)]
    assert stds == pytest.approx([0.01, 0.5, 2.0], rel=0.03)
    assert set(np.abs(process.bias)) == {0.5}


def test_amplifier_file_changes_the_given_values(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('like = "bench"\nwhite_pC = 0.5\ntau_s = 1\ngain_mismatch = 0.002\nbits = 12\npyro_pC_per_K = 90\n')
    part = load_amplifier(path)
    assert (part.noise.name, part.noise.white, part.tau) == ("mine", 0.5, 1.0)
    assert (part.gain_mismatch, part.bits, part.hum, part.limit, part.pyro) == (0.002, 12, 1.0, 1500.0, 90.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tau = 1", "unknown key 'tau'; did you mean 'tau_s'"),
        ("tau_s = 0", "tau_s: expected a positive number or inf, got 0"),
        ("tau_mismatch = 0.5", "tau_mismatch: expected a number from 0 to 0.2, got 0.5"),
        ("bits = 33", "bits: expected a whole number from 0 to 32, got 33"),
        ("bits = 16", r"mine\.toml: bits: a converter of 16 bits needs the largest charge that it reads"),
        ("white_pC = inf", "white_pC: expected a number from 0, got inf"),
        ('like = "kitchen"', "like: expected one of bench, clean, measured, reference, surgery, got 'kitchen'"),
    ],
)
def test_wrong_amplifier_file_raises_input_error(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_amplifier(path)


def test_unknown_noise_level_raises_input_error():
    with pytest.raises(
        InputError, match=r"expected one of clean, reference, measured, bench, surgery, or a TOML file, got 'lab'"
    ):
        load_amplifier("lab")
