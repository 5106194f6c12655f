"""Training: it is reproducible and reports failures; losses; ranges of its settings."""

import itertools

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from isocharge.common.errors import ConfigError, InputError, TrainingError
from isocharge.common.progress import listening
from isocharge.simulate import Domain, NoiseModel
from isocharge.train import FitConfig, LabelledPresses, NetworkConfig, TrainingConfig, fit, load_config
from isocharge.train.training.contact_training import covariance_loss, mean_loss, refit_covariance
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.folded_network import ANGLES_TO_COSINE_ARGUMENTS, COSINES_TO_CORRELATIONS, LARGEST_INT8
from isocharge.train.training.misfit_training import focused_squared_distance
from isocharge.train.training.network import (
    FIRST_LAYER_SLOPES,
    InverseNetwork,
    Posterior,
    TrainablePerceptron,
    compress_length,
    logarithmic_features,
)
from isocharge.train.training.training_data import Split
from kept import ROOT


def stage_with_factor(factor):
    """Return the training of a small network whose loss is multiplied by a function of the number of earlier losses."""
    torch.manual_seed(0)
    network = TrainablePerceptron(2, (4, 4), 1)
    calls = itertools.count()

    def loss(random):
        inputs = torch.rand(8, 2, generator=random)
        return factor(next(calls)) * ((network(inputs) - inputs.sum(dim=1, keepdim=True)) ** 2).mean()

    return TrainingStage("small", network, loss, 400, rate=1e-2, seed=0)


def test_a_training_reduces_the_loss_and_reports_it():
    stage = stage_with_factor(lambda _: 1.0)
    reports = []
    with listening(lambda *report: reports.append(report)):
        stage.run()
    first, last = reports
    assert first[:3] == ("training the small network", 200, 400)
    assert last[1:3] == (400, 400)
    assert stage.loss(torch.Generator().manual_seed(1)).item() < 1e-3


@pytest.mark.parametrize("bad_value", ["nan", "inf"])
def test_a_loss_that_is_not_finite_is_an_error(bad_value):
    stage = stage_with_factor(lambda call: float(bad_value) if call == 200 else 1.0)
    with pytest.raises(TrainingError, match=rf"small network is {bad_value} at step 201 of 400; lower training\."):
        stage.run()


@pytest.mark.parametrize(
    ("white_noise_pC", "lowest_pC"), [(0.0, 0.05), (0.01, 0.05), (0.2, 0.2), (1.0, 1.0), (3.0, 1.0)]
)
def test_charges_below_1_pC_are_distinguished_down_to_the_noise_or_the_smallest_charge(white_noise_pC, lowest_pC):
    charge = np.array([[0.05, 0.4, 30.0], [0.1, 0.8, 60.0]])
    features = logarithmic_features(charge, white_noise_pC)
    assert features.low_pC == lowest_pC
    expected_typical_pC = np.sqrt(np.maximum(charge[0], lowest_pC) * np.maximum(charge[1], lowest_pC))
    np.testing.assert_array_less(np.abs(np.log2(features.typical_pC / expected_typical_pC)), 0.5001)


def test_lengths_of_residuals_are_compressed_beyond_the_limit_of_the_misfit():
    """The flag `misfit` is set above 5. The direction of a residual remains."""
    residual = torch.tensor([[3.0, 0.0, 4.0], [0.0, -50.0, 0.0]], dtype=torch.float64)
    expected = [[0.6 * np.arcsinh(1.0), 0.0, 0.8 * np.arcsinh(1.0)], [0.0, -np.arcsinh(10.0), 0.0]]
    np.testing.assert_allclose(compress_length(residual).numpy(), expected, atol=1e-12)


def settings(hidden=(16, 16), misfit_hidden=(8, 8), weights="float32", **training):
    small = {"steps": 12, "misfit_steps": 10, "misfit_charges": 1_000, "batch": 128}
    network = NetworkConfig(hidden=hidden, misfit_hidden=misfit_hidden, weights=weights)
    return FitConfig(network=network, training=TrainingConfig(**(small | training)))


@pytest.fixture
def split_once(split, monkeypatch):
    """Use the split of the other tests, which takes longer than these trainings."""
    monkeypatch.setattr(Split, "by_position", lambda *_: split)


def answers(dataset, config):
    return np.concatenate(fit(dataset, config).predict(dataset.samples.charge_pC[:100]), axis=1)


@pytest.mark.usefixtures("split_once")
def test_a_seed_gives_the_same_network_and_leaves_the_callers_state_alone(dataset):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    threads = torch.get_num_threads()
    first, again = (answers(dataset, settings()) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.get_num_threads() == threads
    np.testing.assert_array_equal(first, again)
    assert not np.isclose(first, answers(dataset, settings(seed=1))).any(axis=0).all()


def test_settings_of_a_program_are_checked_like_those_of_a_file(dataset):
    with pytest.raises(ConfigError, match=r"training\.steps: expected a whole number from 1 .* got 0"):
        fit(dataset, settings(steps=0))
    with pytest.raises(InputError, match="expected white noise above 0 pC, got that of 'mine'"):
        fit(dataset, settings(noise=NoiseModel("mine", 0.0, 0.02)))


def random_posterior(count, seed):
    """Return random means, logarithms of standard deviations and turns, and random targets, in double precision."""
    random = torch.Generator().manual_seed(seed)
    mean, log_std, turn, target = torch.randn((4, count, 3), generator=random, dtype=torch.float64)
    return Posterior(mean.requires_grad_(), log_std.requires_grad_(), (0.3 * turn).requires_grad_()), target


def test_the_loss_of_the_mean_has_the_gradient_of_the_likelihood_times_weights_of_mean_one():
    posterior, target = random_posterior(40, seed=2)
    mean_loss(posterior, target).mean().backward()
    error = (posterior.mean - target).detach()
    likelihood_gradient = error * torch.exp(-2.0 * posterior.log_std.detach()) / 40
    weight = posterior.mean.grad / likelihood_gradient
    np.testing.assert_allclose(weight.mean(dim=0), 1.0, rtol=1e-6)
    slope = torch.log(weight[1:] / weight[:1]) / (posterior.log_std[1:] - posterior.log_std[:1]).detach()
    np.testing.assert_allclose(slope, 1.0, rtol=1e-6)
    assert posterior.log_std.grad is None


def cholesky_factors(turn):
    """Return matrices whose rows are the unit vectors of three angles minus a right angle, shape (n, 3, 3)."""
    a, b, c = (turn + 0.5 * np.pi).T
    zero = np.zeros(len(turn))
    rows = [
        [zero + 1.0, zero, zero],
        [np.cos(a), np.sin(a), zero],
        [np.cos(b), np.sin(b) * np.cos(c), np.sin(b) * np.sin(c)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def test_any_angles_give_the_gram_matrix_of_unit_vectors():
    turn = np.random.default_rng(0).uniform(-4.0, 4.0, (50, 3))
    factor = cholesky_factors(turn)
    gram_matrices = factor @ factor.transpose(0, 2, 1)
    correlations = np.cos((turn + 0.5 * np.pi) @ ANGLES_TO_COSINE_ARGUMENTS) @ COSINES_TO_CORRELATIONS
    np.testing.assert_allclose(correlations, gram_matrices[:, [0, 0, 1], [1, 2, 2]], atol=1e-14)


def test_the_loss_of_the_covariance_is_a_likelihood_if_large_errors_are_not_limited(monkeypatch):
    """Compare with densities of SciPy. The error receives no gradient."""
    degrees = 1e9  # nearly a normal distribution, whose factor is nearly half of the degrees
    monkeypatch.setattr("isocharge.train.training.contact_training.DEGREES_OF_FREEDOM", degrees)
    monkeypatch.setattr("isocharge.train.training.contact_training.TAIL_FACTOR", 0.5 * degrees)
    posterior, target = random_posterior(6, seed=4)
    error = target - posterior.mean
    loss = covariance_loss(posterior, error)
    factor = np.exp(posterior.log_std.detach().numpy())[:, :, None] * cholesky_factors(posterior.turn.detach().numpy())
    expected = [
        -multivariate_normal(cov=matrix @ matrix.T).logpdf(row) - 1.5 * np.log(2.0 * np.pi)
        for matrix, row in zip(factor, error.detach().numpy(), strict=True)
    ]
    np.testing.assert_allclose(loss.detach(), expected, rtol=1e-6)
    loss.sum().backward()
    assert posterior.mean.grad is None


def test_the_loss_of_the_covariance_has_small_gradients_where_errors_are_nearly_proportional():
    """Opposite errors of five standard deviations under a correlation of nearly one; a square would give 1e7."""
    turn = torch.tensor([[1.54, 0.0, 0.0]], requires_grad=True)
    posterior = Posterior(torch.zeros(1, 3), torch.zeros(1, 3), turn)
    covariance_loss(posterior, torch.tensor([[5.0, 5.0, 0.0]])).backward()
    assert turn.grad.abs().max() < 1e3


def test_the_refit_finds_a_covariance_that_depends_on_the_charges_and_keeps_the_mean():
    """Three charges, whose logarithms are linear functions of the contact, with white and proportional noise.

    The mean is the exact solution. Its errors are those of the logarithms times the inverse of the linear function.
    """
    domain = Domain(10.0, (0.1, 2.0))
    noise = NoiseModel("test", 1.0, 0.01)
    rng = np.random.default_rng(0)
    slopes = np.array([[0.5, 0.1, 1.0], [-0.3, 0.4, 1.0], [-0.2, -0.5, 1.0]])
    unit_contact = rng.uniform(-1.0, 1.0, (20_000, 3))
    charge = 100.0 * np.exp(unit_contact @ slopes.T)
    presses = LabelledPresses(domain.to_contact(unit_contact), charge)

    torch.manual_seed(0)
    network = InverseNetwork(domain, logarithmic_features(charge), charge, NetworkConfig((48, 48), (2, 2)))
    with torch.no_grad():
        inputs = network.inputs(torch.tensor(charge).float())
        inputs_and_one = np.column_stack([inputs.numpy(), np.ones(len(inputs))])
        solution = np.linalg.lstsq(inputs_and_one, unit_contact)[0].T
        last = network.contact.linear_layers[-1]
        last.weight.zero_()
        last.bias[:3] = torch.tensor(solution[:, 3])
        last.bias[3:6] = -4.0  # the same standard deviations everywhere
        last.bias[6:] = 0.0
        network.contact.skip.weight[:3] = torch.tensor(solution[:, :3])

    def answers(charge):
        """Return the means and the covariances, shapes (n, 3) and (n, 3, 3)."""
        with torch.no_grad():
            posterior = network.posterior(torch.tensor(charge).float())
        factor = np.exp(posterior.log_std.numpy())[:, :, None] * cholesky_factors(posterior.turn.numpy())
        return posterior.mean.numpy(), factor @ factor.transpose(0, 2, 1)

    mean_before, _ = answers(charge[:500])
    refit_covariance(network, presses, noise)
    mean, covariance = answers(charge[:500])
    np.testing.assert_array_equal(mean, mean_before)
    relative_noise = np.hypot(1.0 / charge[:500], 0.01)  # white noise and proportional noise
    factor = np.linalg.inv(slopes) * relative_noise[:, None, :]
    expected = factor @ factor.transpose(0, 2, 1)
    std = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    assert std.max() > 3.0 * std.min()
    difference = np.abs(covariance - expected) / (std[:, :, None] * std[:, None, :])
    assert difference.mean() < 0.06  # about 0.04 follow from the finite number of presses
    assert np.quantile(difference, 0.99) < 0.25


def test_the_units_of_a_sharpened_layer_bend_among_the_inputs():
    torch.manual_seed(0)
    perceptron = TrainablePerceptron(3, (400, 8), 4)
    perceptron.sharpen_first_layer()
    first, *_ = perceptron.linear_layers
    slope = first.weight.norm(dim=1)
    distance_of_bend = first.bias.detach() / slope.detach()
    smallest, largest = FIRST_LAYER_SLOPES
    assert smallest <= slope.min() < slope.max() <= largest
    assert distance_of_bend.std().item() == pytest.approx(1.0, abs=0.1)


@pytest.mark.usefixtures("split_once")
def test_rounded_weights_are_whole_numbers_times_the_scale_of_their_output(dataset):
    rounded, exact = (fit(dataset, settings(weights=form)).network.contact for form in ("int8", "float32"))
    for rounded_layer, layer in zip(rounded.hidden[1:], exact.hidden[1:], strict=True):
        scale = np.abs(rounded_layer.weight).max(axis=0) / LARGEST_INT8
        multiples = rounded_layer.weight / scale
        np.testing.assert_allclose(multiples, multiples.round(), atol=1e-4)
        assert (
            np.abs(rounded_layer.weight - layer.weight) <= 0.51 * scale.max()
        ).all()  # not trained after the rounding
    assert not np.array_equal(rounded.last.weight, exact.last.weight)  # trained after the rounding


CONFIGS = ROOT / "train/configs"


def write(folder, text):
    path = folder / "config.toml"
    path.write_text(text)
    return path


def test_the_default_file_states_the_defaults():
    assert load_config(CONFIGS / "default.toml") == FitConfig()


def test_focused_distance_is_a_mean_with_smaller_weights_for_long_targets(monkeypatch):
    monkeypatch.setattr("isocharge.train.training.misfit_training.FOCUS_LENGTH", 2.0)
    vector = torch.tensor([[1.0, 0.0], [0.0, 2.0]])
    target = torch.tensor([[0.0, 0.0], [3.0, 4.0]])
    # squared distances 1 and 13, weights 1 and 1 / (1 + 25 / 4)
    assert focused_squared_distance(vector, target).item() == pytest.approx((1.0 + 13.0 / 7.25) / 2.0, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[trainig]\nsteps = 1\n", "unknown key 'trainig'"),
        ("[training]\nsteps = 0\n", "training.steps: expected a whole number from 1 to 10000000, got 0"),
        ("[training]\nhold_out = 1e-9\n", "training.hold_out: expected a number from 0.01 to 0.6, got 1e-09"),
        ("[training]\nlearning_rate = 2\n", "training.learning_rate: expected a number between 0 and 1, got 2"),
        ("[network]\nhidden = []\n", "network.hidden: expected widths"),
        ("[network]\nhidden = [64]\nmisfit_hidden = [64, 64]\n", "as many layers as network.hidden"),
        ("[network]\nweights = 'int4'\n", "network.weights: expected one of float32, int8, got 'int4'"),
        ("[network]\nactivation = 'step'\n", "network.activation: expected one of tanh, got 'step'"),
    ],
)
def test_wrong_files_are_refused_with_file_and_key(tmp_path, text, message):
    path = str(write(tmp_path, text))
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert path in str(caught.value)
    assert message in str(caught.value)
