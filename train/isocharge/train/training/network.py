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
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE

MISFIT_UNIT = 5.0
"""Standard deviations up to which the misfit is learned about linearly; beyond, its logarithm is."""

LARGEST_INT8 = 127
"""A rounded weight is a whole number from minus this to this, times the scale of its output."""


WIDER = 1.0
"""How far signed charges may lie beyond those of presses, over the width of these, in asinh: farther ones count as just
so far. What is absurd still gives a finite answer."""


@dataclass(frozen=True)
class SignedCharges:
    """Charges of any sign: asinh(clip(Q) / typical) - mean stands for the logarithm.

    Attributes:
        low, high: Charges are brought between these, shape (n_electrode,), pC.
        mean: Shape (n_electrode,): numbers about 0 keep the digits of a float32.
    """

    low: Array
    high: Array
    mean: Array

    @classmethod
    def of(cls, charge: Array, typical: Array) -> "SignedCharges":
        """From charges of presses, shape (n, n_electrode), and the typical ones, pC."""
        levels = np.arcsinh(charge / typical)
        low, high = levels.min(axis=0), levels.max(axis=0)
        beyond = WIDER * (high - low)
        return cls(np.sinh(low - beyond) * typical, np.sinh(high + beyond) * typical, levels.mean(axis=0))


@dataclass(frozen=True)
class Features:
    """Whitened logarithms of the charges: x = (ln(clip(Q) / typical) - mean) @ matrix.

    Attributes:
        typical: The power of two nearest to each charge's geometric mean, shape (n_electrode,), pC: dividing by it
            costs a float32 no digit, and the logarithms are small enough to keep theirs. For signed charges the size
            from which noise grows with the charge.
        mean: Of the logarithms, shape (n_electrode,).
        matrix: Shape (n_electrode, n_electrode).
        signed: What stands for the logarithm if charges may have any sign.
    """

    typical: Array
    mean: Array
    matrix: Array
    signed: SignedCharges | None = None

    @classmethod
    def fit(cls, charge: Array) -> "Features":
        """From clean positive charges, shape (n, n_electrode): zero mean, unit covariance along the principal axes."""
        within = np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE)
        typical = 2.0 ** np.round(np.log2(within).mean(axis=0))
        return cls(typical, *whitening(np.log(within / typical)))

    @classmethod
    def of_signed(cls, charge: Array, typical: Array) -> "Features":
        """From charges of any sign, shape (n, n_electrode), and the size from which noise grows with them, pC."""
        signed = SignedCharges.of(charge, typical)
        return cls(typical, *whitening(bent(charge, typical, signed)), signed)


def bent(charge: Array, typical: Array, signed: SignedCharges | None) -> Array:
    """What features are linear in, shape (n, n_electrode): ln(Q / typical), or what stands for it."""
    if signed:
        return np.asarray(np.arcsinh(np.clip(charge, signed.low, signed.high) / typical) - signed.mean)
    return np.asarray(np.log(np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE) / typical))


def whitening(values: Array, least: float = 0.0) -> tuple[Array, Array]:
    """Mean and matrix M of values (n, k): (values - mean) @ M has unit covariance along its principal axes.

    Where the deviation along an axis is less than `least` of the largest, it stays below 1.
    """
    mean = values.mean(axis=0)
    _, singular, axes = np.linalg.svd(values - mean, full_matrices=False)
    return mean, axes.T * (np.sqrt(len(values)) / np.maximum(singular, max(1e-12, least * singular[0])))


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
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.Tanh()]
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
