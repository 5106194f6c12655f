"""A fit: repeatable, seeded, leaves the caller's settings alone, fails loudly, goes on after a kill."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from isocharge.common.errors import ConfigError, InputError, OutputExists
from isocharge.common.progress import listening
from isocharge.common.resumable_run import resume_parts
from isocharge.simulate import Dataset, NoiseModel, Samples
from isocharge.train import FitConfig, NetworkConfig, Teacher, TrainingConfig, TrainingData, evaluate, fit
from isocharge.train.training import descent
from isocharge.train.training.fit import Split, fit_identity, teaching_loss, train_network
from isocharge.train.training.network import LARGEST_INT8, Perceptron


def settings(hidden=(16, 16), misfit_hidden=(8, 8), weights="float32", electrodes=0, **training):
    small = {"steps": 40, "misfit_steps": 10, "misfit_charges": 1_000, "batch": 128}
    network = NetworkConfig(hidden=hidden, misfit_hidden=misfit_hidden, weights=weights, electrodes=electrodes)
    return FitConfig(network=network, training=TrainingConfig(**(small | training)))


@pytest.fixture
def split_once(trained, monkeypatch):
    """The split of the short fit, whatever is fitted: its search for folds takes longer than these fits."""
    monkeypatch.setattr(Split, "of", lambda *_: trained.split)


def weights(dataset, config, **options):
    network = train_network(TrainingData.of(dataset), config, **options).network
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()])


@pytest.mark.usefixtures("split_once")
def test_a_seed_gives_the_same_network_and_leaves_the_callers_state_alone(dataset):
    torch.manual_seed(5)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    first, again = (weights(dataset, settings()) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    assert torch.get_num_threads() == threads
    assert torch.equal(first, again)
    assert not torch.equal(first, weights(dataset, settings(seed=1)))


@pytest.mark.usefixtures("split_once")
def test_progress_is_reported_by_stage(dataset):
    calls = []
    with listening(lambda *call: calls.append(call)):
        fit(dataset, settings())
    (contact, misfit) = calls
    assert contact[:3] == ("training the contact network", 40, 40)
    assert "% of force rms" in contact[3]
    assert misfit[:3] == ("training the misfit network", 10, 10)


@pytest.mark.usefixtures("split_once")
def test_training_lowers_the_error(dataset, fitted):
    untrained = fit(dataset, settings(steps=1))
    assert evaluate(fitted)["position_median_mm"] < 0.2 * evaluate(untrained)["position_median_mm"]


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


def test_coverage_where_the_truth_is_known(sensor):
    """Charges whose logarithms are linear in the contact, noise in proportion: the posterior is Gaussian, its width
    known, but at the edge."""
    rng = np.random.default_rng(0)
    count, radius, noise = 6_000, 8.0, NoiseModel("loud", 1.0, 0.02)
    reach, angle = radius * np.sqrt(rng.uniform(size=count)), rng.uniform(-np.pi, np.pi, count)
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


def test_the_loss_of_a_student_is_the_divergence_of_gaussians():
    random = torch.Generator().manual_seed(3)
    mean, log_std, taught_mean, taught_log_std = (torch.randn(50, 3, generator=random) for _ in range(4))
    teacher = torch.distributions.Normal(taught_mean, taught_log_std.exp())
    student = torch.distributions.Normal(mean, log_std.exp())
    expected = torch.distributions.kl_divergence(teacher, student).sum(dim=1).mean()
    torch.testing.assert_close(teaching_loss(mean, log_std, taught_mean, taught_log_std), expected)


def test_a_teachers_posterior_is_that_of_its_answers(trained):
    """Contacts drawn from the answer scatter in unit coordinates as the posterior says."""
    contact, std, domain = np.array([[3.0, -2.0, 0.7]]), np.array([[0.06, 0.04, 0.002]]), trained.split.domain
    mean, log_std = Teacher("it/1", "", lambda _: (contact, std)).posterior(torch.ones(1, 4), domain)
    unit = domain.to_unit(contact + std * np.random.default_rng(1).standard_normal((200_000, 3)))
    np.testing.assert_allclose(mean[0].numpy(), unit.mean(axis=0), atol=2e-5)
    np.testing.assert_allclose(np.exp(log_std[0].numpy()), unit.std(axis=0), rtol=0.01)


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
    for part, other in ((rounded.contact, exact.contact), (rounded.misfit_vector, exact.misfit_vector)):
        for matrix, before in zip(part.hidden_matrices(), other.hidden_matrices(), strict=True):
            scale = matrix.abs().amax(dim=1, keepdim=True) / LARGEST_INT8
            torch.testing.assert_close(matrix / scale, (matrix / scale).round(), atol=1e-4, rtol=0.0)
            assert (matrix - before).abs().max() <= 0.51 * scale.max()  # rounded, and trained no further
            assert not torch.equal(matrix, before)
        assert not torch.equal(part.layers()[-1].weight, other.layers()[-1].weight)  # trained on


def test_rounding_a_matrix_of_zeros_is_harmless():
    part = Perceptron(3, (4, 4), 2)
    with torch.no_grad():
        part.hidden_matrices()[0].zero_()
    part.round_hidden()
    assert torch.equal(part.hidden_matrices()[0], torch.zeros(4, 4))


class Killed(BaseException):
    """As sudden as a SIGKILL, but caught by the test."""


def killed_after(count):
    """A listener that ends the run at its count-th call."""
    left = [count]

    def listener(*_):
        left[0] -= 1
        if left[0] == 0:
            raise Killed

    return listening(listener)


LONGER = settings((12, 12), (10, 10), steps=20, misfit_steps=230, batch=64)


@pytest.mark.usefixtures("split_once")
def test_a_killed_fit_goes_on_with_its_own_presses_and_settings_alone(dataset, tmp_path, monkeypatch):
    """Killed in the second network: the first and its examples are not made again, and the weights are the same."""
    monkeypatch.setattr(descent, "SAVE_EVERY_S", 0.0)
    data = TrainingData.of(dataset)
    identity = fit_identity(data, LONGER)
    with pytest.raises(Killed), killed_after(2), resume_parts(tmp_path / "it", identity) as run:
        weights(dataset, LONGER, run=run)
    for changed, message in (
        (fit_identity(data, settings(seed=5)), r"config\.training\..*--fresh"),
        (fit_identity(replace(data, sha256="another"), LONGER), "dataset_sha256 is"),
        (fit_identity(replace(data, teacher=Teacher("it/1", "sum", tuple)), LONGER), "teacher_sha256 is"),
    ):
        with pytest.raises(OutputExists, match=message), resume_parts(tmp_path / "it", changed):
            pass
    whole, calls = weights(dataset, LONGER), []
    monkeypatch.setattr("isocharge.train.training.fit.draw_misfit_examples", pytest.fail)
    with listening(lambda *call: calls.append(call)), resume_parts(tmp_path / "it", identity) as run:
        assert torch.equal(weights(dataset, LONGER, run=run), whole)
    assert {title for title, *_ in calls} == {"training the misfit network"}
