"""Training: it is reproducible, stops early, reports failures and continues after a kill; ranges of its settings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, norm

from isocharge.common.errors import ConfigError, InputError, TrainingError
from isocharge.common.progress import listening
from isocharge.simulate import Dataset, Domain, NoiseModel, Samples
from isocharge.train import FitConfig, NetworkConfig, Teacher, TrainingConfig, TrainingData, fit, load_config
from isocharge.train.training import descent
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.fit import train_network
from isocharge.train.training.losses import (
    STD_EXPONENT,
    distillation_loss,
    focused_squared_distance,
    likelihood_loss,
    robust_correlation_loss,
    warm_up_loss,
    weighted_likelihood_loss,
)
from isocharge.train.training.network import FIRST_LAYER_SLOPES, LARGEST_INT8, TrainablePerceptron
from isocharge.train.training.split import Split

REPORT_EVERY = 20


@pytest.fixture
def _short_reports(monkeypatch):
    monkeypatch.setattr(descent, "REPORT_EVERY", REPORT_EVERY)


def test_a_teacher_answers_in_the_coordinates_of_the_network():
    teacher = Teacher("linear/1", "", lambda _: (np.array([[4.0, -8.0, 0.5]]), np.array([[0.8, 0.4, 0.05]])))
    mean, log_std = teacher.posterior(torch.ones(1, 3), Domain(8.0, (0.1, 2.5)))
    np.testing.assert_allclose(mean, [[0.5, -1.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(log_std, np.log([[0.1, 0.05, 0.1 / np.log(5.0)]]), rtol=1e-6)


def stage_with_scores(scores, steps=20 * REPORT_EVERY, warm_up_steps=0):
    """Return the training of a small network with given validation scores, and the list of weights at each score."""
    torch.manual_seed(0)
    network = TrainablePerceptron(2, (4, 4), 1)
    remaining_scores = iter(scores)
    weights_at_scores = []

    def loss(_, random):
        inputs = torch.rand(8, 2, generator=random)
        return ((network(inputs) - inputs.sum(dim=1, keepdim=True)) ** 2).mean()

    def score():
        weights_at_scores.append({name: values.clone() for name, values in network.state_dict().items()})
        return next(remaining_scores), "text"

    return TrainingStage("stage", network, loss, score, steps, warm_up_steps), weights_at_scores


def run_stage(stage, patience=10**6):
    """Run a training and return its progress reports."""
    reports = []
    with listening(lambda _, done, *rest: reports.append((done, *rest))):
        Descent(stage, 1e-2, patience, seed=0).run()
    return reports


def have_same_weights(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.usefixtures("_short_reports")
def test_training_stops_early_with_the_best_weights():
    stage, weights_at_scores = stage_with_scores([5.0, 2.0, *[3.0] * 18])
    reports = run_stage(stage, patience=3 * REPORT_EVERY)
    assert [step for step, *_ in reports] == [REPORT_EVERY * k for k in (1, 2, 3, 4, 5)]
    assert have_same_weights(stage.network.state_dict(), weights_at_scores[1])
    _, total, text = reports[0]
    assert total == 20 * REPORT_EVERY
    assert text.startswith("loss ")
    assert text.endswith("text")


@pytest.mark.usefixtures("_short_reports")
def test_weights_of_the_warm_up_are_never_the_best():
    steps = 4 * REPORT_EVERY
    stage, weights_at_scores = stage_with_scores([0.0, 0.0, 2.0, 3.0], steps, warm_up_steps=2 * REPORT_EVERY)
    run_stage(stage, patience=REPORT_EVERY + 1)
    assert have_same_weights(stage.network.state_dict(), weights_at_scores[2])


@pytest.mark.usefixtures("_short_reports")
def test_scores_that_are_always_nan_are_an_error():
    stage, _ = stage_with_scores([float("nan")] * 20)
    with pytest.raises(TrainingError, match=r"the stage loss is .* at step 180 of 400.*lower training.learning_rate"):
        run_stage(stage)
    short_stage, _ = stage_with_scores([float("nan")] * 20, steps=2 * REPORT_EVERY)
    with pytest.raises(TrainingError, match="the stage network has no finite validation score after 40 steps"):
        run_stage(short_stage)


@pytest.mark.usefixtures("_short_reports")
@pytest.mark.parametrize("bad_value", ["nan", "inf"])
def test_a_step_whose_loss_is_nan_is_taken_back_with_a_smaller_learning_rate(bad_value):
    stage, weights_at_scores = stage_with_scores([5.0, 1.0, 3.0, 2.0], steps=4 * REPORT_EVERY)
    bad_step = 2 * REPORT_EVERY + 3

    def loss(step, random):
        return stage.loss(step, random) * (float(bad_value) if step == bad_step else 1.0)

    training = Descent(replace(stage, loss=loss), 1e-2, 10**6, seed=0)
    while training.step <= bad_step:
        training.take_step()
        if training.step % REPORT_EVERY == 0:
            training._evaluate(0.0)
    assert have_same_weights(stage.network.state_dict(), weights_at_scores[1])
    assert training.rate == 0.5e-2
    training.run()
    assert training.best_score == 1.0
    assert have_same_weights(stage.network.state_dict(), weights_at_scores[1])


@pytest.mark.usefixtures("_short_reports")
def test_a_score_of_nan_takes_the_weights_back_and_the_training_goes_on():
    stage, weights_at_scores = stage_with_scores([5.0, float("nan"), 3.0, 4.0], steps=4 * REPORT_EVERY)
    run_stage(stage)
    assert have_same_weights(stage.network.state_dict(), weights_at_scores[2])


@pytest.mark.parametrize("patience", [1, 7, 50])
def test_a_training_with_little_patience_ends_after_a_validation_with_trained_weights(patience):
    stage, weights_at_scores = stage_with_scores([3.0] * 400, steps=400)
    initial = {name: weight.clone() for name, weight in stage.network.state_dict().items()}
    reports = run_stage(stage, patience)
    assert [step for step, *_ in reports] == [patience, 2 * patience]
    assert have_same_weights(stage.network.state_dict(), weights_at_scores[0])
    assert not have_same_weights(stage.network.state_dict(), initial)


def settings(hidden=(16, 16), misfit_hidden=(8, 8), weights="float32", electrodes=0, **training):
    small = {"steps": 40, "misfit_steps": 10, "misfit_charges": 1_000, "batch": 128}
    network = NetworkConfig(hidden=hidden, misfit_hidden=misfit_hidden, weights=weights, electrodes=electrodes)
    return FitConfig(network=network, training=TrainingConfig(**(small | training)))


@pytest.fixture
def split_once(trained, monkeypatch):
    """Use the split of the session's training, which takes longer than these trainings."""
    monkeypatch.setattr(Split, "by_position", lambda *_: trained.split)


def weights(dataset, config, **options):
    network = train_network(TrainingData.of(dataset), config, **options).network
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()])


@pytest.mark.usefixtures("split_once")
def test_a_seed_gives_the_same_network_and_leaves_the_callers_state_alone(dataset):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    threads = torch.get_num_threads()
    first, again = (weights(dataset, settings()) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.get_num_threads() == threads
    assert torch.equal(first, again)
    assert not torch.equal(first, weights(dataset, settings(seed=1)))


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        (settings(noise="loud"), InputError, r"expected one of clean, reference, .* got 'loud'"),
        (settings(electrodes=4), ConfigError, r"for 4 electrodes, the dataset of 'three-25um-biaxial' has 3 \(A, B"),
        (settings(steps=0), ConfigError, r"training\.steps: expected a whole number from 1 .* got 0"),
    ],
)
def test_settings_that_do_not_fit_are_refused(dataset, config, error, message):
    with pytest.raises(error, match=message):
        fit(dataset, config)


@pytest.mark.slow
def test_coverage_where_the_truth_is_known(sensor):
    """Charges whose logarithms are linear in the contact, noise in proportion: the posterior is Gaussian, its width
    known, but at the edge."""
    rng = np.random.default_rng(0)
    count = 6_000
    radius = 8.0
    noise = NoiseModel("loud", 1.0, 0.02)
    reach = radius * np.sqrt(rng.uniform(size=count))
    angle = rng.uniform(-np.pi, np.pi, count)
    force = np.exp(rng.uniform(np.log(0.05), np.log(2.0), count))
    contact = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.log(force)], axis=1)
    slope = np.array([[0.0, -0.1, 0.7], [0.1, 0.05, 0.7], [-0.1, 0.05, 0.7]])
    charge = 1e4 * np.exp(contact @ slope.T)
    samples = Samples(*contact[:, :2].T, force, np.full(count, "circle:1.0"), np.zeros(count), charge)
    manifest = {"ranges": {"radius_mm": radius, "force_N": [0.05, 2.0]}, "solver": "made up"}
    config = settings((24, 24), steps=600, misfit_steps=1, batch=512, noise=noise)
    fitted = fit(Dataset(sensor, samples, manifest, "made up"), config)
    good = fitted.test.within(6.5)
    good = good[(good.contact[:, 2] > 0.06) & (good.contact[:, 2] < 1.7)]
    found, std, _ = fitted.predict(good.noisy(noise, seed=4))
    exact = np.sqrt(np.diag(np.linalg.inv(slope.T @ slope))) * 0.02  # of x, y (mm) and ln F; 1 pC is nothing here
    ratio = std / exact / np.stack([np.ones(len(good)), np.ones(len(good)), found[:, 2]], axis=1)
    assert np.median(ratio, axis=0) == pytest.approx([1.0, 1.0, 1.0], abs=0.15)
    deviation = np.abs(found - good.contact) / std
    assert np.mean(deviation < 1.0, axis=0) == pytest.approx([0.68] * 3, abs=0.08)
    assert np.mean(deviation < 1.96, axis=0) == pytest.approx([0.95] * 3, abs=0.04)


def test_the_warm_up_loss_is_least_squares_for_the_mean():
    """The gradient of the standard deviations is zero if they are as large as the errors."""
    mean, target = torch.randn((2, 20, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mean.requires_grad_()
    log_std = torch.log(torch.abs(mean - target)).detach().requires_grad_()
    warm_up_loss(mean, log_std, target).backward()
    np.testing.assert_allclose(mean.grad, 60.0 / 20 * (mean - target).detach(), rtol=1e-9)
    np.testing.assert_allclose(log_std.grad, 0.0, atol=1e-12)


def test_the_weighted_loss_has_the_gradient_of_the_likelihood_times_weights_of_mean_one():
    random = torch.Generator().manual_seed(2)
    mean, log_std, target = torch.randn((3, 40, 3), generator=random, dtype=torch.float64)
    gradients = []
    for loss in (likelihood_loss, weighted_likelihood_loss):
        parameters = [mean.clone().requires_grad_(), log_std.clone().requires_grad_()]
        loss(*parameters, target).backward()
        gradients.append([parameter.grad for parameter in parameters])
    (mean_gradient, std_gradient), (weighted_mean_gradient, weighted_std_gradient) = gradients
    torch.testing.assert_close(weighted_std_gradient, std_gradient)
    weight = weighted_mean_gradient / mean_gradient
    torch.testing.assert_close(weight.mean(dim=0), torch.ones(3, dtype=torch.float64))
    slope = torch.log(weight[1:] / weight[:1]) / (log_std[1:] - log_std[:1])
    torch.testing.assert_close(slope, torch.full_like(slope, 2.0 * STD_EXPONENT))


def test_the_loss_of_the_correlations_is_a_likelihood_and_leaves_the_deviations_alone():
    """Compare with the density of SciPy, whose correlation matrix is the Gram matrix of three unit vectors."""
    random = torch.Generator().manual_seed(4)
    angles = (torch.rand(6, 3, generator=random) - 0.5).double()
    deviation = (0.5 * torch.randn(6, 3, generator=random)).double().requires_grad_()
    a, b, c = (angles.numpy() + 0.5 * np.pi).T
    zero = np.zeros(6)
    rows = [
        np.stack([zero + 1.0, zero, zero], axis=1),
        np.stack([np.cos(a), np.sin(a), zero], axis=1),
        np.stack([np.cos(b), np.sin(b) * np.cos(c), np.sin(b) * np.sin(c)], axis=1),
    ]
    factor = np.stack(rows, axis=1)
    densities = [
        multivariate_normal(cov=one @ one.T).logpdf(error)
        for one, error in zip(factor, deviation.detach().numpy(), strict=True)
    ]
    standard = norm.logpdf(deviation.detach().numpy()[:, 0])
    expected = np.mean(standard - np.array(densities) - np.log(2.0 * np.pi))
    loss = robust_correlation_loss(angles, deviation)
    assert loss.item() == pytest.approx(expected, rel=1e-9)
    assert not loss.requires_grad


def test_the_loss_of_the_correlations_has_small_gradients_where_errors_are_nearly_proportional():
    """Opposite errors of five standard deviations under a correlation of nearly one; a square would give 1e7."""
    angles = torch.tensor([[1.54, 0.0, 0.0]], requires_grad=True)
    robust_correlation_loss(angles, torch.tensor([[5.0, 5.0, 0.0]])).backward()
    assert torch.all(torch.isfinite(angles.grad))
    assert angles.grad.abs().max() < 1e3


def test_the_linear_part_of_linear_targets_leaves_a_small_remainder():
    torch.manual_seed(0)
    inputs = torch.randn(500, 3)
    targets = inputs @ torch.tensor([[1.0, -2.0], [0.5, 0.3], [0.0, 4.0]]) + torch.tensor([0.7, -0.2])
    perceptron = TrainablePerceptron(3, (8, 8), 4)
    before = perceptron(inputs).detach()
    perceptron.fit_linear_part(inputs, targets)
    after = perceptron(inputs).detach()
    assert (after[:, :2] - targets).abs().max() < 0.2
    torch.testing.assert_close(after[:, 2:], before[:, 2:])


def test_the_units_of_a_sharpened_layer_bend_among_the_inputs():
    torch.manual_seed(0)
    perceptron = TrainablePerceptron(3, (400, 8), 4)
    perceptron.sharpen_first_layer()
    first, *_ = perceptron.linear_layers()
    slope = first.weight.norm(dim=1)
    distance_of_bend = first.bias.detach() / slope.detach()
    smallest, largest = FIRST_LAYER_SLOPES
    assert smallest <= slope.min() < slope.max() <= largest
    assert distance_of_bend.std().item() == pytest.approx(1.0, abs=0.1)


def test_the_loss_of_a_student_is_the_kullback_leibler_divergence_of_gaussians():
    random = torch.Generator().manual_seed(3)
    mean, log_std, teacher_mean, teacher_log_std = (torch.randn(50, 3, generator=random) for _ in range(4))
    teacher = torch.distributions.Normal(teacher_mean, teacher_log_std.exp())
    student = torch.distributions.Normal(mean, log_std.exp())
    expected = torch.distributions.kl_divergence(teacher, student).sum(dim=1).mean()
    torch.testing.assert_close(distillation_loss(mean, log_std, teacher_mean, teacher_log_std), expected)


@pytest.mark.usefixtures("split_once")
def test_a_student_learns_the_answers_and_not_the_presses(dataset, fitted):
    """A teacher that is wrong by 2 mm has a student that is wrong by 2 mm."""

    def shifted(charge):
        contact, std, _ = fitted.predict(charge)
        return contact + np.array([2.0, 0.0, 0.0]), std

    data = replace(TrainingData.of(dataset), teacher=Teacher("wrong/1", "", shifted))
    student = fit(data, settings((24, 24), steps=200))
    off = student.predict(student.test.charge)[0] - student.test.contact
    assert np.median(off[:, 0]) > 1.5
    assert abs(np.median(off[:, 1])) < 0.3


@pytest.mark.usefixtures("split_once")
def test_rounded_weights_are_whole_numbers_times_the_scale_of_their_output(dataset):
    data = TrainingData.of(dataset)
    rounded, exact = (train_network(data, settings(weights=form)).network for form in ("int8", "float32"))
    pairs = [(rounded.contact, exact.contact), (rounded.misfit_vector, exact.misfit_vector)]
    for rounded_perceptron, perceptron in pairs:
        matrices = zip(rounded_perceptron.hidden_matrices(), perceptron.hidden_matrices(), strict=True)
        for rounded_matrix, matrix in matrices:
            scale = rounded_matrix.abs().amax(dim=1, keepdim=True) / LARGEST_INT8
            multiples = rounded_matrix / scale
            torch.testing.assert_close(multiples, multiples.round(), atol=1e-4, rtol=0.0)
            assert (rounded_matrix - matrix).abs().max() <= 0.51 * scale.max()  # not trained after the rounding
            assert not torch.equal(rounded_matrix, matrix)
        *_, rounded_last = rounded_perceptron.linear_layers()
        *_, last = perceptron.linear_layers()
        assert not torch.equal(rounded_last.weight, last.weight)  # trained after the rounding


CONFIGS = Path(__file__).parents[3] / "train" / "configs"


def write(folder, text):
    path = folder / "config.toml"
    path.write_text(text)
    return path


def test_the_default_file_states_the_defaults():
    assert load_config(CONFIGS / "default.toml") == FitConfig()


def test_keys_left_out_keep_their_defaults(tmp_path):
    config = load_config(write(tmp_path, "[training]\nsteps = 7\n"))
    assert config == FitConfig(network=NetworkConfig(), training=TrainingConfig(steps=7))
    assert load_config(CONFIGS / "quick.toml").network == NetworkConfig()
    released = TrainingConfig(steps=2_000, misfit_steps=3_000, misfit_charges=80_000)
    assert load_config(CONFIGS / "release.toml").training == released


def test_misfit_network_is_wider_for_more_than_four_electrodes():
    default = NetworkConfig(hidden=(32, 32))
    assert [default.misfit_widths(count) for count in (3, 4, 5, 8)] == [(64, 64), (64, 64), (96, 96), (96, 96)]
    assert NetworkConfig(hidden=(32, 32), misfit_hidden=(24, 16)).misfit_widths(8) == (24, 16)
    sizes = [FitConfig().for_electrodes(count) for count in (3, 4, 5, 8)]
    assert [config.network.hidden for config in sizes] == [(96,) * 3, (96,) * 3, (128,) * 4, (128,) * 4]
    assert [config.training.steps for config in sizes] == [1_200, 1_200, 6_000, 6_000]
    assert [config.training.misfit_steps for config in sizes] == [1_500, 1_500, 3_000, 3_000]
    assert [config.training.misfit_charges for config in sizes] == [40_000, 40_000, 80_000, 80_000]


def test_focused_distance_is_a_mean_with_smaller_weights_for_long_targets():
    vector = torch.tensor([[1.0, 0.0], [0.0, 2.0]])
    target = torch.tensor([[0.0, 0.0], [3.0, 4.0]])
    # squared distances 1 and 13, weights 1 and 1 / (1 + 25 / 4)
    expected = (1.0 + 13.0 / 7.25) / (1.0 + 1.0 / 7.25)
    assert focused_squared_distance(vector, target, focus=2.0).item() == pytest.approx(expected, rel=1e-6)


def test_noise_of_ones_own():
    mine = NoiseModel("mine", 0.5, 1e-3)
    config = FitConfig(training=TrainingConfig(noise=mine))
    assert config.training.noise_model is mine
    assert config.checked() == config
    assert FitConfig().training.noise_model == NoiseModel("reference", 1.0, 2e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[trainig]\nsteps = 1\n", "unknown key 'trainig'"),
        ("[training]\nstep = 1\n", "unknown key 'training.step'"),
        ("[training]\nsteps = 0\n", "training.steps: expected a whole number from 1 to 10000000, got 0"),
        ("[training]\nsteps = 1.5\n", "training.steps: expected a whole number from 1 to 10000000, got 1.5"),
        ("[training]\nlearning_rate = 2\n", "training.learning_rate: expected a number between 0 and 1, got 2"),
        ("[training]\nlearning_rate = nan\n", "training.learning_rate: expected a number between 0 and 1, got nan"),
        ("[training]\nhold_out = 0.95\n", "training.hold_out: expected a number between 0 and 0.6, got 0.95"),
        ("[training]\nnoise = 3\n", "training.noise: expected a text, got 3"),
        ("[network]\nhidden = [true]\n", "network.hidden[0]: expected a whole number from 1 to 4096, got True"),
        ("[network]\nhidden = []\n", "network.hidden: expected widths"),
        ("[network]\nhidden = [64]\nmisfit_hidden = [64, 64]\n", "as many layers as network.hidden"),
        ("[network]\nelectrodes = 2\n", "network.electrodes: expected 0 (as the dataset) or 3 to 64, got 2"),
        ("[network]\nweights = 'int4'\n", "network.weights: expected one of float32, int8, got 'int4'"),
        ("network = 3\n", "network: expected a table, got 3"),
        ("steps = \n", "not a TOML file"),
    ],
)
def test_wrong_files_are_refused_with_file_and_key(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
