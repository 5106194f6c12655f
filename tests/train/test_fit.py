"""Training: repeatable, seeded, leaves the caller's settings alone, fails loudly."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from isocharge.errors import InputError, TrainingError
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network
from isocharge.train.network import project

TINY = FitConfig(
    NetworkConfig(hidden=(16, 16), nearest_hidden=(8, 8)), TrainingConfig(steps=40, nearest_steps=10, batch=128)
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
    assert "contact loss" in calls[0][2]
    assert "misfit loss" in calls[-1][2]


def test_training_lowers_the_error(dataset, fit):
    from isocharge.simulate import noise_model
    from isocharge.train.evaluate import measure_errors
    from isocharge.train.release import predict_with

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
    with pytest.raises(
        InputError, match="expected one of clean, reference, bench, surgery, or a TOML file, got 'loud'"
    ):
        fit_network(dataset, replace(TINY, training=replace(TINY.training, noise="loud")))


def test_projection_ends_in_the_domain_and_leaves_it_alone():
    unit = torch.tensor(np.random.default_rng(0).normal(size=(500, 3)), dtype=torch.float32)
    inside = project(unit)
    assert float(inside[:, :2].norm(dim=1).max()) <= 1.0 + 1e-6
    assert float(inside[:, 2].abs().max()) <= 1.0
    assert torch.allclose(project(inside), inside, atol=1e-6)
    already = unit[(unit[:, :2].norm(dim=1) < 1) & (unit[:, 2].abs() < 1)]
    assert torch.equal(project(already), already)
