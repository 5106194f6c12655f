"""The network for all films: a perceptron whose weights depend on a film's context (`film_scaling`).

Its inputs are the charges with the exact scales of the film divided out. A small network turns the context
into psi. Layer l then has the weights W_l0 + sum_k phi_lk W_lk, with phi linear in psi, and a bias that is linear in
psi; so has the layer that skips the others. Computed once per film, it is a plain perceptron (`ConditionalWeights`).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.arrays import Array
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.films_data import FilmPresses
from isocharge.train.training.features import whitening
from isocharge.train.training.network import Trainable, as_tensor

BASES = 6
"""Matrices that a layer's weights are made of, besides the constant one."""

PSI = 64
"""Width of the context's network."""

FITTED = 512
"""Films that the whitening is taken from."""

FIRST_BASIS, FIRST_SHARE = 0.3, 0.3
"""Sizes at the start: of the bases, over the constant matrix; of phi."""


@dataclass(frozen=True)
class FilmInputs:
    """x = (ln clip(Q) - ln scale(film) - mean) @ whitening.

    Attributes:
        scaling: Exact scales and context of films.
        mean: Of the logarithms (Q in pC), shape (n_electrode,).
        whitening: Shape (n_electrode, n_electrode).
    """

    scaling: FilmScaling
    mean: Array
    whitening: Array

    @classmethod
    def fit(cls, scaling: FilmScaling, presses: FilmPresses) -> "FilmInputs":
        """Zero mean and unit covariance along the principal axes, over clean charges of many films."""
        logs = np.log(np.clip(presses.charge()[:FITTED], LOWEST_CHARGE, HIGHEST_CHARGE))
        logs = (logs - scaling.log_charge_scale(presses.parameters[:FITTED])[:, None]).reshape(-1, logs.shape[-1])
        return cls(scaling, *whitening(logs))

    def values(self, charge: Tensor, parameters: Array) -> Tensor:
        """Charges (n_film, n, n_electrode) of films (n_film, n_parameter) to inputs of the same shape."""
        shift = as_tensor(self.scaling.log_charge_scale(parameters) + self.mean)
        logs = torch.log(charge.clamp(LOWEST_CHARGE, HIGHEST_CHARGE)) - shift[:, None]
        return logs @ as_tensor(self.whitening)

    def context(self, parameters: Array) -> Tensor:
        """Contexts of films, (n_film, n_parameter) to (n_film, n_context)."""
        return as_tensor(self.scaling.context(parameters))


class ConditionalPerceptron(Trainable):
    """Perceptrons of many films at once.

    Args:
        inputs: Number of electrodes.
        hidden: Widths of the hidden layers.
        outputs: Number of outputs.
        context: Number of context values.
    """

    def __init__(self, inputs: int, hidden: tuple[int, ...], outputs: int, context: int) -> None:
        super().__init__()
        sizes = list(pairwise((inputs, *hidden, outputs)))
        self.context = nn.Sequential(nn.Linear(context, PSI), nn.Tanh(), nn.Linear(PSI, PSI), nn.Tanh())
        self.constant = nn.ParameterList([_uniform(1.0, *size) for size in sizes])
        self.bases = nn.ParameterList([_uniform(FIRST_BASIS, *size, count=BASES) for size in sizes])
        self.bias = nn.ModuleList([nn.Linear(PSI, size[1]) for size in sizes])
        self.skip = nn.Parameter(torch.zeros(inputs, outputs))
        self.skip_bases = nn.Parameter(torch.zeros(BASES, inputs, outputs))
        self.phi = nn.Linear(PSI, BASES * (len(sizes) + 1))
        for linear in self.bias:
            nn.init.zeros_(linear.weight)  # type: ignore[arg-type]
        nn.init.normal_(self.phi.weight, std=FIRST_SHARE / np.sqrt(PSI))
        nn.init.zeros_(self.phi.bias)

    def forward(self, inputs: Tensor, context: Tensor) -> Tensor:
        """Inputs (n_film, n, inputs) and contexts (n_film, n_context) to (n_film, n, outputs)."""
        psi = self.context(context)
        phi = self.phi(psi).view(len(context), len(self.constant) + 1, -1)
        value, last = inputs, len(self.constant) - 1
        for number, (constant, bases, bias) in enumerate(zip(self.constant, self.bases, self.bias, strict=True)):
            weight = constant + torch.einsum("fk,kio->fio", phi[:, number], bases)
            value = torch.baddbmm(bias(psi)[:, None], value, weight)
            value = value if number == last else torch.tanh(value)
        skip = self.skip + torch.einsum("fk,kio->fio", phi[:, -1], self.skip_bases)
        return value + torch.bmm(inputs, skip)

    def hidden_matrices(self) -> list[Tensor]:
        """Constant weights from one hidden layer to the next."""
        return list(self.constant)[1:-1]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Weights by name, as `ConditionalWeights` takes them."""
        return {name: values.detach().double().numpy() for name, values in self.state_dict().items()}


def _uniform(share: float, inputs: int, outputs: int, count: int = 0) -> nn.Parameter:
    """Weights of shape (inputs, outputs), or `count` of them, uniform in +-share / sqrt(inputs)."""
    shape = (count, inputs, outputs) if count else (inputs, outputs)
    return nn.Parameter(share * (2.0 * torch.rand(shape) - 1.0) / np.sqrt(inputs))
