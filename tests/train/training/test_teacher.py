"""What a teacher teaches: against torch's own divergence and the definition of the unit coordinates."""

from dataclasses import replace

import numpy as np
import torch
from torch.distributions import Normal, kl_divergence

from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network
from isocharge.train.data.domain import ContactDomain
from isocharge.train.training.network import LARGEST_INT8, Perceptron
from isocharge.train.training.teacher import Teacher, teaching_loss

DOMAIN = ContactDomain(8.0, (0.05, 2.0))
SMALL = FitConfig(
    NetworkConfig((24, 24), (12, 12)), TrainingConfig(steps=400, misfit_steps=40, misfit_charges=1_000, batch=256)
)


def test_the_loss_is_the_divergence_of_gaussians():
    random = torch.Generator().manual_seed(3)
    mean, log_std, taught_mean, taught_log_std = (torch.randn(50, 3, generator=random) for _ in range(4))
    teacher, student = Normal(taught_mean, taught_log_std.exp()), Normal(mean, log_std.exp())
    expected = kl_divergence(teacher, student).sum(dim=1).mean()
    torch.testing.assert_close(teaching_loss(mean, log_std, taught_mean, taught_log_std), expected)


def test_a_posterior_is_that_of_the_answers():
    """Contacts drawn from the answer scatter in unit coordinates as the posterior says."""
    contact, std = np.array([[3.0, -2.0, 0.7]]), np.array([[0.06, 0.04, 0.002]])
    teacher = Teacher("it/1", "", lambda _: (contact, std))
    mean, log_std = teacher.posterior(torch.ones(1, 4), DOMAIN)
    draws = contact + std * np.random.default_rng(1).standard_normal((200_000, 3))
    unit = DOMAIN.to_unit(draws)
    np.testing.assert_allclose(mean[0].numpy(), unit.mean(axis=0), atol=2e-5)
    np.testing.assert_allclose(np.exp(log_std[0].numpy()), unit.std(axis=0), rtol=0.01)


def test_a_student_learns_the_answers_and_not_the_presses(dataset):
    """A teacher that is wrong by 2 mm has a student that is wrong by 2 mm."""

    def shifted(charge_pC):
        contact, std, _ = honest(charge_pC)
        return contact + np.array([2.0, 0.0, 0.0]), std

    fit = fit_network(dataset, SMALL)

    def honest(charge_pC):
        with torch.no_grad():
            return (part.double().numpy() for part in fit.network(torch.tensor(charge_pC).float()))

    student = fit_network(dataset, SMALL, teacher=Teacher("wrong/1", "", shifted))
    with torch.no_grad():
        answers = student.network(torch.tensor(student.held.charge_pC).float())[0].numpy()
    off = answers - student.held.contact
    assert np.median(off[:, 0]) > 1.5
    assert abs(np.median(off[:, 1])) < 0.3


def test_rounded_weights_are_whole_numbers_times_the_scale_of_their_output(dataset):
    rounded = fit_network(dataset, replace(SMALL, network=replace(SMALL.network, weights="int8"))).network
    exact = fit_network(dataset, SMALL).network
    for part, other in ((rounded.contact, exact.contact), (rounded.misfit_vector, exact.misfit_vector)):
        for matrix, before in zip(part.hidden_matrices(), other.hidden_matrices(), strict=True):
            scale = matrix.abs().amax(dim=1, keepdim=True) / LARGEST_INT8
            whole = matrix / scale
            torch.testing.assert_close(whole, whole.round(), atol=1e-4, rtol=0.0)
            assert (matrix - before).abs().max() <= 0.51 * scale.max()  # rounded, and trained no further
            assert not torch.equal(matrix, before)
        assert not torch.equal(part.layers()[-1].weight, other.layers()[-1].weight)  # trained on


def test_rounding_a_matrix_of_zeros_is_harmless():
    part = Perceptron(3, (4, 4), 2)
    with torch.no_grad():
        part.hidden_matrices()[0].zero_()
    part.round_hidden()
    assert torch.equal(part.hidden_matrices()[0], torch.zeros(4, 4))
