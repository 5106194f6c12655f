"""The optimiser SOAP: against PyTorch's Adam, and on an ill-conditioned problem."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import nn
from torch.optim.adam import adam

from isocharge.train.training.descent import DECAY, Soap, TrainingStage
from isocharge.train.training.network import TrainablePerceptron

SETTINGS = {"beta1": DECAY, "beta2": DECAY, "amsgrad": False, "weight_decay": 0, "eps": 1e-38, "maximize": False}


def soap_step(parameter):
    return partial(Soap(parameter).step, 0.03)


def adam_step(parameter):
    """PyTorch's Adam as a function, because the class imports PyTorch's compiler."""
    state = [[zero] for zero in torch.zeros((2, *parameter.shape))]
    count = [torch.tensor(0.0)]
    return lambda: adam([parameter.data], [parameter.grad], *state, [], count, lr=0.03, **SETTINGS)


def run(make_step, parameter, loss, steps):
    take_step = make_step(parameter)
    for _ in range(steps):
        parameter.grad = None
        loss(parameter).backward()
        take_step()


def test_a_matrix_with_a_diagonal_gradient_is_trained_by_adam():
    """The eigenvectors of diagonal moments are the unit vectors, and their signs do not matter."""
    target = torch.diag(torch.tensor([3.0, 2.0, 1.0]))
    ours, theirs = (nn.Parameter(torch.zeros(3, 3)) for _ in range(2))

    def loss(parameter):
        return ((parameter - target) ** 2).sum()

    run(soap_step, ours, loss, 25)
    run(adam_step, theirs, loss, 25)
    np.testing.assert_allclose(ours.detach(), theirs.detach(), rtol=1e-5)


def test_an_ill_conditioned_problem_is_solved_far_better_than_by_adam():
    """The problem is |A W B - A W0 B|^2, whose factors A and B have singular values from 0.03 to 1."""
    rng = np.random.default_rng(3)
    factors = []
    for size in (8, 12):
        left, _, right = np.linalg.svd(rng.standard_normal((size, size)))
        factors.append(torch.tensor(left * np.geomspace(0.03, 1.0, size) @ right, dtype=torch.float32))
    solution = torch.tensor(rng.standard_normal((8, 12)), dtype=torch.float32)

    def loss(weight):
        return ((factors[0] @ (weight - solution) @ factors[1]) ** 2).sum()

    losses = []
    for make_step in (soap_step, adam_step):
        weight = nn.Parameter(torch.zeros(8, 12))
        run(make_step, weight, loss, 300)
        losses.append(loss(weight).item())
    assert losses[0] < 0.1 * losses[1]


@pytest.mark.parametrize("shape", [(4, 6), (9, 32)])
def test_rows_that_get_a_gradient_only_later_do_not_cause_long_steps(shape):
    """Until then, their mean square in the eigenbasis is zero."""
    random = torch.Generator().manual_seed(0)
    mean_gradient = torch.randn(shape, generator=random)
    weight = nn.Parameter(torch.zeros(shape))
    optimiser = Soap(weight)
    longest_step = 0.0
    for step in range(60):
        weight.grad = mean_gradient + torch.randn(shape, generator=random)
        if step < 30:
            weight.grad[2:] = 0.0
        before = weight.detach().clone()
        optimiser.step(0.02)
        longest_step = max(longest_step, (weight.detach() - before).norm().item())
    assert longest_step <= 0.02 * np.sqrt(weight.numel()) * (1.0 + 1e-5)


def test_training_continues_from_earlier_weights_if_some_steps_destroy_them():
    torch.manual_seed(0)
    network = TrainablePerceptron(1, (16,), 1)
    losses = []

    def loss(random):
        if len(losses) == 750:
            for parameter in network.parameters():
                parameter.data.mul_(-3.0)
        angle = torch.randn((64, 1), generator=random)
        losses.append((network(angle) - angle.sin()).square().mean().log())
        return losses[-1]

    TrainingStage("sine", network, loss, steps=1000, rate=0.02, seed=0).run()
    assert losses[-1] < -5.0
