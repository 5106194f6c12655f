"""Levenberg-Marquardt against scipy's, on the same small problem."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import nn

from isocharge.train.training.levenberg_marquardt import levenberg_marquardt


class Decay(nn.Module):
    """a exp(-b t) + c, and t as a second output that nobody asked for."""

    def __init__(self, a, b, c):
        super().__init__()
        self.values = nn.Parameter(torch.tensor([a, b, c], dtype=torch.float64))

    def forward(self, t):
        a, b, c = self.values
        return torch.cat([a * torch.exp(-b * t) + c, t], dim=-1)


def problem():
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 4.0, 1500)[:, None]  # more than one chunk
    return time, 2.5 * np.exp(-1.3 * time) + 0.5 + 0.1 * rng.standard_normal(time.shape)


def test_it_ends_where_scipy_ends():
    time, wanted = problem()
    reference = least_squares(
        lambda p: (p[0] * np.exp(-p[1] * time) + p[2] - wanted).ravel(), [1.0, 1.0, 0.0], method="lm", xtol=1e-14
    )
    part = Decay(1.0, 1.0, 0.0)
    squares = [square for square, _ in levenberg_marquardt(part, torch.tensor(time), torch.tensor(wanted), 50)]
    assert part.values.detach().numpy() == pytest.approx(reference.x, rel=1e-6)
    assert squares[-1] == pytest.approx(2.0 * reference.cost, rel=1e-12)
    assert squares == sorted(squares, reverse=True)


def test_a_linear_problem_is_solved_as_numpy_solves_it():
    rng = np.random.default_rng(1)
    inputs, wanted = rng.standard_normal((300, 4)), rng.standard_normal((300, 2))
    part = nn.Linear(4, 2).double()
    for _ in levenberg_marquardt(part, torch.tensor(inputs), torch.tensor(wanted), 20):
        pass
    solution = np.linalg.lstsq(np.hstack([inputs, np.ones((300, 1))]), wanted, rcond=None)[0]
    assert part.weight.detach().numpy() == pytest.approx(solution[:4].T, abs=1e-6)
    assert part.bias.detach().numpy() == pytest.approx(solution[4], abs=1e-6)


def test_going_on_with_the_damping_takes_the_same_path():
    time, wanted = (torch.tensor(values) for values in problem())
    whole, parts = Decay(1.0, 1.0, 0.0), Decay(1.0, 1.0, 0.0)
    for _ in levenberg_marquardt(whole, time, wanted, 6):
        pass
    for _, damping in levenberg_marquardt(parts, time, wanted, 2):
        kept = damping
    for _ in levenberg_marquardt(parts, time, wanted, 4, kept):
        pass
    assert torch.equal(whole.values, parts.values)


def test_at_the_minimum_it_stops():
    inputs = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)[:, None]
    part = nn.Linear(1, 1).double()
    assert len(list(levenberg_marquardt(part, inputs, 3.0 * inputs - 1.0, 1000))) < 100


def test_a_parameter_without_any_say_does_no_harm():
    class Idle(nn.Module):
        def __init__(self):
            super().__init__()
            self.used = nn.Parameter(torch.zeros(1, dtype=torch.float64))
            self.idle = nn.Parameter(torch.ones(1, dtype=torch.float64))

        def forward(self, x):
            return self.used * x + 0.0 * self.idle

    inputs = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)[:, None]
    part = Idle()
    for _ in levenberg_marquardt(part, inputs, 3.0 * inputs, 30):
        pass
    assert part.used.item() == pytest.approx(3.0, abs=1e-8)
    assert part.idle.item() == pytest.approx(1.0, abs=1e-8)
