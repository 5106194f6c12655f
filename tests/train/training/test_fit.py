"""Training: repeatable, seeded, leaves the caller's settings alone, fails loudly."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from isocharge.common.errors import ConfigError, InputError, TrainingError
from isocharge.simulate import Dataset, Samples, noise_model
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import position_error
from isocharge.train.release.evaluate import measure_errors
from isocharge.train.release.release import predict_with

TINY = FitConfig(
    NetworkConfig(hidden=(16, 16), misfit_hidden=(8, 8)),
    TrainingConfig(steps=40, misfit_steps=10, misfit_charges=1_000, batch=128),
)


def weights(fit):
    return torch.cat([parameter.flatten() for parameter in fit.network.parameters()])


def test_a_seed_gives_the_same_network(dataset):
    first, again = (fit_network(dataset, TINY) for _ in range(2))
    other = fit_network(dataset, replace(TINY, training=replace(TINY.training, seed=1)))
    assert torch.equal(weights(first), weights(again))
    assert not torch.equal(weights(first), weights(other))


def test_the_callers_random_state_and_threads_stay(dataset):
    torch.manual_seed(5)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    fit_network(dataset, TINY)
    assert torch.equal(before, torch.get_rng_state())
    assert torch.get_num_threads() == threads


def test_progress_is_told_to_the_end(dataset):
    calls = []
    fit_network(dataset, TINY, lambda done, total, words: calls.append((done, total, words)))
    assert calls[-1][:2] == (50, 50)
    assert re.search(r"contact: loss .* [\d.]+ mm and [\d.]+ % of force rms", calls[0][2])
    assert calls[-1][2].startswith("misfit: loss ")


def test_training_lowers_the_error(dataset, fit):
    untrained = fit_network(dataset, replace(TINY, training=replace(TINY.training, steps=1)))
    noise = noise_model("reference")
    before, after = (measure_errors(predict_with(each), each.held, noise) for each in (untrained, fit))
    assert after["position_median_mm"] < 0.2 * before["position_median_mm"]


def test_a_loss_that_is_not_finite_is_an_error(dataset):
    wild = replace(TINY, training=replace(TINY.training, learning_rate=0.999, steps=400))
    broken = replace(dataset, samples=replace(dataset.samples, charge_pC=dataset.samples.charge_pC * 1e40))
    with pytest.raises(TrainingError, match="loss is"):
        fit_network(broken, wild)


def test_an_unknown_noise_level(dataset):
    with pytest.raises(InputError, match=r"expected one of clean, reference, .* got 'loud'"):
        fit_network(dataset, replace(TINY, training=replace(TINY.training, noise="loud")))


def test_coverage_where_the_truth_is_known(sensor, tmp_path):
    """Charges whose logarithms are linear in the contact, noise in proportion: the posterior is Gaussian, its width
    known, but at the edge."""
    rng = np.random.default_rng(0)
    count, radius = 6_000, 8.0
    reach, angle = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(-np.pi, np.pi, count)
    force = np.exp(rng.uniform(np.log(0.05), np.log(2.0), count))
    contact = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.log(force)], axis=1)
    slope = np.array([[0.0, -0.1, 0.7], [0.1, 0.05, 0.7], [-0.1, 0.05, 0.7]])
    charge = 1e4 * np.exp(contact @ slope.T)
    samples = Samples(*contact[:, :2].T, force, np.full(count, "circle:1.0"), np.zeros(count), charge)
    dataset = Dataset(sensor, samples, {"ranges": {"radius_mm": radius, "force_N": [0.05, 2.0]}}, "made up")
    config = FitConfig(
        NetworkConfig((24, 24), (8, 8)),
        TrainingConfig(steps=1_500, misfit_steps=1, misfit_charges=1_000, batch=512, noise=str(tmp_path / "loud.toml")),
    )
    (tmp_path / "loud.toml").write_text('like = "reference"\nproportional = 0.02\n')
    fit = fit_network(dataset, config)
    good = fit.held[np.hypot(*fit.held.contact[:, :2].T) < 6.5]
    good = good[(good.contact[:, 2] > 0.06) & (good.contact[:, 2] < 1.7)]
    found, std, _ = predict_with(fit)(noisy_charges(good, noise_model(config.training.noise), seed=4))
    exact = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope))) * 0.02  # of x, y (mm) and ln F; 1 pC is nothing here
    ratio = std / exact / np.stack([np.ones(len(good)), np.ones(len(good)), found[:, 2]], axis=1)
    assert np.median(ratio, axis=0) == pytest.approx([1.0, 1.0, 1.0], abs=0.15)
    deviation = np.abs(found - good.contact) / std
    assert np.mean(deviation < 1.0, axis=0) == pytest.approx([0.68] * 3, abs=0.08)
    assert np.mean(deviation < 1.96, axis=0) == pytest.approx([0.95] * 3, abs=0.04)


def test_a_configuration_for_more_electrodes_is_refused(dataset):
    four = replace(TINY, network=replace(TINY.network, electrodes=4))
    with pytest.raises(ConfigError, match=r"for 4 electrodes, the dataset of 'three-25um-biaxial' has 3 \(A, B, C\)"):
        fit_network(dataset, four)


def test_without_noise_the_finish_reaches_what_first_order_does_not(dataset):
    """Clean charges, the same small network: Levenberg-Marquardt halves the error, and says how large it is."""
    small = NetworkConfig((12, 12), (8, 8))
    clean = TrainingConfig(steps=300, misfit_steps=1, misfit_charges=1_000, batch=256, noise="clean")
    errors = []
    for steps in (0, 15):
        fit = fit_network(dataset, FitConfig(small, replace(clean, finish_steps=steps)))
        found, std, _ = predict_with(fit)(fit.held.charge_pC)
        errors.append(np.median(position_error(found, fit.held.contact)))
    assert errors[1] < 0.5 * errors[0]
    coverage = np.mean(np.abs(found - fit.held.contact) < std, axis=0)
    assert np.all((coverage > 0.55) & (coverage < 0.95))  # errors of a fit are no Gaussians
