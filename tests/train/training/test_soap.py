"""The optimiser SOAP: against PyTorch's Adam, on an ill-conditioned problem, and after a checkpoint."""

import copy

import numpy as np
import pytest
import torch
from torch import nn

from isocharge.train.training import soap
from isocharge.train.training.soap import Soap

BETAS = (0.9, 0.98)


def run(optimiser, parameters, loss, steps):
    for _ in range(steps):
        for parameter in parameters:
            parameter.grad = None
        loss(*parameters).backward()
        optimiser.step()


def test_vectors_are_trained_by_adam():
    target = torch.linspace(-1.0, 2.0, 7)
    ours, theirs = (nn.Parameter(torch.zeros(7)) for _ in range(2))

    def loss(parameter):
        return ((parameter - target) ** 4).sum()

    run(Soap([ours], lr=0.03, betas=BETAS), [ours], loss, 50)
    run(torch.optim.Adam([theirs], lr=0.03, betas=BETAS, eps=soap.EPSILON), [theirs], loss, 50)
    torch.testing.assert_close(ours, theirs)


def test_a_matrix_with_a_diagonal_gradient_is_trained_by_adam():
    """The eigenvectors of diagonal moments are the unit vectors, and their signs do not matter."""
    target = torch.diag(torch.tensor([3.0, 2.0, 1.0]))
    ours, theirs = (nn.Parameter(torch.zeros(3, 3)) for _ in range(2))

    def loss(parameter):
        return ((parameter - target) ** 2).sum()

    run(Soap([ours], lr=0.03, betas=BETAS), [ours], loss, 25)
    run(torch.optim.Adam([theirs], lr=0.03, betas=BETAS, eps=soap.EPSILON), [theirs], loss, 25)
    torch.testing.assert_close(ours, theirs)


def ill_conditioned_problem(shape):
    """Return a function |A W B - A W0 B|^2 of W, whose factors A and B have singular values from 0.03 to 1."""
    rng = np.random.default_rng(3)
    *batch, n_row, n_column = shape
    factors = []
    for size in (n_row, n_column):
        left, _, right = np.linalg.svd(rng.standard_normal((*batch, size, size)))
        factors.append(torch.tensor(left * np.geomspace(0.03, 1.0, size) @ right, dtype=torch.float32))
    solution = torch.tensor(rng.standard_normal(shape), dtype=torch.float32)

    def loss(weight):
        return ((factors[0] @ (weight - solution) @ factors[1]) ** 2).sum()

    return loss


@pytest.mark.parametrize("shape", [(8, 12), (2, 8, 12)])
def test_an_ill_conditioned_problem_is_solved_far_better_than_by_adam(shape):
    loss = ill_conditioned_problem(shape)
    losses = []
    for optimiser_class in (Soap, torch.optim.Adam):
        weight = nn.Parameter(torch.zeros(shape))
        optimiser = optimiser_class([weight], lr=0.03, betas=(0.95, 0.95))
        run(optimiser, [weight], loss, 300)
        losses.append(loss(weight).item())
    assert losses[0] < 0.1 * losses[1]


def test_a_gradient_of_zero_changes_nothing():
    weight = nn.Parameter(torch.ones(4, 3))
    run(Soap([weight], lr=0.1), [weight], lambda parameter: 0.0 * parameter.sum(), 12)
    torch.testing.assert_close(weight, torch.ones(4, 3))


@pytest.mark.parametrize("shape", [(4, 6), (9, 32)])
def test_rows_that_get_a_gradient_only_later_do_not_cause_long_steps(shape):
    """Until then, their mean square in the eigenbasis is zero."""
    random = torch.Generator().manual_seed(0)
    mean_gradient = torch.randn(shape, generator=random)
    weight = nn.Parameter(torch.zeros(shape))
    optimiser = Soap([weight], lr=0.02)
    longest_step = 0.0
    for step in range(60):
        weight.grad = mean_gradient + torch.randn(shape, generator=random)
        if step < 30:
            weight.grad[2:] = 0.0
        before = weight.detach().clone()
        optimiser.step()
        longest_step = max(longest_step, (weight.detach() - before).norm().item())
    assert longest_step <= 0.02 * soap.MAX_RATIO * np.sqrt(weight.numel())


def test_a_restored_state_continues_with_the_same_steps():
    loss = ill_conditioned_problem((5, 4))
    weight = nn.Parameter(torch.zeros(5, 4))
    optimiser = Soap([weight], lr=0.05)
    run(optimiser, [weight], loss, 13)
    again = nn.Parameter(weight.detach().clone())
    restored = Soap([again], lr=0.05)
    restored.load_state_dict(copy.deepcopy(optimiser.state_dict()))
    run(optimiser, [weight], loss, 13)
    run(restored, [again], loss, 13)
    assert torch.equal(weight, again)
