"""The inverse in torch: charges in; contact, standard deviations and misfit out.

Features are whitened logarithms of the charges: a force multiplies all charges nearly alike, so ratios carry the
position and the common factor the force. Charges of any sign have asinh in the logarithm's place, which is linear where
noise is larger than the charge. One perceptron gives mean and log standard deviation of (x, y, ln F). A second
one gives the misfit

    min over known contacts c of |(Q - Q(c)) / sigma|

as the length of a vector, (Q - Q(c)) / sigma at the nearest contact: that vector is smooth where its length is not, on
the image of the forward map. Lengths from a tenth to thousands are brought into reach of a network by asinh.
"""

from abc import ABC, abstractmethod
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.training.features import MISFIT_UNIT, Features
from isocharge.train.training.folding import FoldedLayers, FoldedNetwork, PlainPerceptron, answer_units

LARGEST_INT8 = 127
"""A rounded weight is a whole number from minus this to this, times the scale of its output."""


class Trainable(nn.Module, ABC):
    """A part of a model that `Descent` trains."""

    @abstractmethod
    def hidden_matrices(self) -> list[Tensor]:
        """Weights from one hidden layer to the next, which Muon trains."""


class Perceptron(Trainable):
    """Linear layers with tanh between them, and a linear layer that skips them from the inputs to the outputs.

    The logarithm of the force is nearly linear in those of the charges, and has to be right to a thousandth of its
    range: with the skip layer the others need only learn what is not linear.
    """

    def __init__(self, inputs: int, hidden: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        widths = (inputs, *hidden)
        layers = [part for sizes in pairwise(widths) for part in (nn.Linear(*sizes), nn.Tanh())]
        self.mlp = nn.Sequential(*layers, nn.Linear(widths[-1], outputs))
        self.skip = nn.Linear(inputs, outputs, bias=False)
        nn.init.zeros_(self.skip.weight)

    def forward(self, inputs: Tensor) -> Tensor:
        """Shape (n, inputs) to (n, outputs)."""
        out: Tensor = self.mlp(inputs) + self.skip(inputs)
        return out

    def layers(self) -> list[nn.Linear]:
        """The linear layers between which tanh stands, first to last."""
        return [layer for layer in self.mlp if isinstance(layer, nn.Linear)]

    def plain(self) -> PlainPerceptron:
        """The same in NumPy, in double precision."""
        layers = tuple((_matrix(layer), layer.bias.detach().double().numpy()) for layer in self.layers())
        return PlainPerceptron(layers, _matrix(self.skip))

    def hidden_matrices(self) -> list[Tensor]:
        """Weights from one hidden layer to the next."""
        return [layer.weight for layer in self.layers()[1:-1]]

    def round_hidden(self) -> None:
        """Round the hidden matrices to 8 bits, a scale for each output, and train them no further."""
        for matrix in self.hidden_matrices():
            scale = matrix.detach().abs().amax(dim=1, keepdim=True) / LARGEST_INT8
            matrix.detach().copy_(torch.round(matrix.detach() / scale.clamp(min=1e-30)) * scale)
            matrix.requires_grad_(False)


class InverseNetwork(nn.Module):
    """The whole model.

    Args:
        domain: The contacts it knows.
        features: Normalisation.
        hidden: Widths of the contact network.
        misfit_hidden: Widths of the misfit network.
    """

    def __init__(
        self, domain: Domain, features: Features, hidden: tuple[int, ...], misfit_hidden: tuple[int, ...]
    ) -> None:
        super().__init__()
        n_electrode = features.typical.size
        self.domain, self.features = domain, features
        self.contact = Perceptron(n_electrode, hidden, 6)
        self.misfit_vector = Perceptron(n_electrode, misfit_hidden, n_electrode)
        self.centre, self.scale, self.typical, self.logs_mean, self.whitening = (
            nn.Buffer(as_tensor(values))
            for values in (domain.centre, domain.scale, features.typical, features.mean, features.matrix)
        )

    def inputs(self, charge: Tensor) -> Tensor:
        """What both perceptrons see, finite for any charges (n, n_electrode), pC."""
        if signed := self.features.signed:
            low, high, mean = (as_tensor(values) for values in (signed.low, signed.high, signed.mean))
            logs = torch.asinh(charge.clamp(low, high) / self.typical) - mean
        else:
            logs = torch.log(charge.clamp(LOWEST_CHARGE, HIGHEST_CHARGE) / self.typical)
        return (logs - self.logs_mean) @ self.whitening

    def posterior(self, charge: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the unit coordinates, each (n, 3)."""
        out = self.contact(self.inputs(charge))
        return out[:, :3], out[:, 3:]

    def forward(self, charge: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Charges (n, n_electrode), pC, to contact (n, 3) in mm and N, contact_std (n, 3), misfit (n, 1)."""
        mean, log_std = self.posterior(charge)
        value, std = mean * self.scale + self.centre, torch.exp(log_std) * self.scale
        force = torch.exp(value[:, 2:])
        contact = torch.cat([value[:, :2], force], dim=1)
        contact_std = torch.cat([std[:, :2], std[:, 2:] * force], dim=1)
        length = torch.linalg.vector_norm(self.misfit_vector(self.inputs(charge)), dim=1, keepdim=True)
        return contact, contact_std, MISFIT_UNIT * torch.sinh(length)


def compress_length(residual: Tensor) -> Tensor:
    """What the misfit network learns: residuals (..., n_electrode), their lengths brought to asinh(length / unit)."""
    length: Tensor = torch.linalg.vector_norm(residual, dim=-1, keepdim=True)
    return residual * (torch.asinh(length / MISFIT_UNIT) / length.clamp(min=1e-9))


def as_tensor(values: Array) -> Tensor:
    """In single precision."""
    return torch.tensor(values).float()


def fold_network(network: InverseNetwork) -> FoldedNetwork:
    """Both perceptrons, from ln(Q / typical) or what stands for it."""
    features, n_electrode = network.features, network.features.typical.size
    perceptrons = [part.plain() for part in (network.contact, network.misfit_vector)]
    whitening, mean = network.whitening.double().numpy(), network.logs_mean.double().numpy()
    units = answer_units(network.domain, np.eye(3), np.zeros(3), n_electrode)
    return FoldedNetwork(FoldedLayers.of(perceptrons, whitening, mean, units), features.typical, features.signed)


def contact_alone(network: InverseNetwork) -> FoldedNetwork:
    """The contact network without standard deviations: its layers give (x_mm, y_mm, ln F) alone."""
    matrix = np.vstack([np.diag(network.domain.scale), np.zeros((3, 3))])
    features, contact = network.features, network.contact.plain()
    layers = FoldedLayers.of((contact,), features.matrix, features.mean, (matrix, network.domain.centre))
    return FoldedNetwork(layers, features.typical, features.signed)


def _matrix(layer: nn.Linear) -> Array:
    """Weights of a layer, shape (inputs, outputs)."""
    return np.asarray(layer.weight.detach().double().numpy().T)
