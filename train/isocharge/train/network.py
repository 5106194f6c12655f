"""The inverse: charges in; contact, standard deviations and misfit out. The torch twin of the exported graph.

Features are whitened logarithms of the charges: a force multiplies all charges nearly alike, so ratios carry the
position and the common factor the force. One perceptron gives mean and log standard deviation of (x, y, ln F). The
misfit

    min over known contacts c of |(Q - Q(c)) / sigma|

starts from two proposals, the mean itself and a second perceptron trained to find the nearest contact of charges that
no contact gives; each is brought into the domain, improved by one Gauss-Newton step, and the best of the four wins. It
is an upper bound of the minimum that is tight where the charges come from a contact.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.simulate.arrays import Array
from isocharge.simulate.noise import NoiseModel
from isocharge.train.charge_field import ChargeField

LOWEST_PC, HIGHEST_PC = 1.0, 1e6
"""Charges are brought between these before the logarithm: what is negative or absurd still gives a finite answer."""


@dataclass(frozen=True)
class Features:
    """Whitened logarithms of the charges: x = ln(clip(Q) / typical) @ matrix.

    Attributes:
        typical: Geometric mean of each charge, shape (n_electrode,), pC.
        matrix: Shape (n_electrode, n_electrode).
    """

    typical: Array
    matrix: Array

    @classmethod
    def fit(cls, charge_pC: Array) -> "Features":
        """From clean charges, shape (n, n_electrode): zero mean, unit covariance along the principal axes."""
        logs = np.log(np.clip(charge_pC, LOWEST_PC, HIGHEST_PC))
        mean = logs.mean(axis=0)
        _, singular, axes = np.linalg.svd(logs - mean, full_matrices=False)
        return cls(np.exp(mean), axes.T * (np.sqrt(len(logs)) / np.maximum(singular, 1e-12)))


def perceptron(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    """Linear layers with tanh between them."""
    widths = (inputs, *hidden)
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.Tanh()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], outputs))


class TorchField(nn.Module):
    """`ChargeField` in torch, on unit coordinates."""

    series: Tensor

    def __init__(self, field: ChargeField) -> None:
        super().__init__()
        self.register_buffer("series", torch.tensor(field.coefficients).float())

    def forward(self, unit: Tensor, rows: int = 1) -> Tensor:
        """ln Q and, with rows = 4, the rows of P: unit coordinates (n, 3) to (n, rows, n_electrode)."""
        in_x = _chebyshev(unit[:, 0], self.series.shape[1])
        in_y = _chebyshev(unit[:, 1], self.series.shape[2])
        in_force = _chebyshev(unit[:, 2], self.series.shape[3])
        plane = (in_x[:, :, None] * in_y[:, None, :]).flatten(1)
        part = self.series[:rows].permute(1, 2, 0, 4, 3).flatten(0, 1)
        by_force = (plane @ part.flatten(1)).reshape(-1, *part.shape[1:])
        values: Tensor = (by_force @ in_force[:, None, :, None])[..., 0]
        return values


def _chebyshev(x: Tensor, count: int) -> Tensor:
    """T_0 ... T_(count-1) at points (n,), by their recurrence: unlike cos(k acos x) it differentiates at +-1."""
    x = x.clamp(-1.0, 1.0)
    values = [torch.ones_like(x), x]
    for _ in range(count - 2):
        values.append(2.0 * x * values[-1] - values[-2])
    return torch.stack(values[:count], dim=-1)


class InverseNetwork(nn.Module):
    """The whole model.

    Args:
        field: The forward map; its domain is the model's.
        features: Normalisation.
        noise: For the sigma of the misfit.
        hidden: Widths of the contact network.
        nearest_hidden: Widths of the nearest-contact network.
    """

    centre: Tensor
    scale: Tensor
    typical: Tensor
    whitening: Tensor

    def __init__(
        self,
        field: ChargeField,
        features: Features,
        noise: NoiseModel,
        hidden: tuple[int, ...],
        nearest_hidden: tuple[int, ...],
    ) -> None:
        super().__init__()
        n_electrode = features.typical.size
        self.features, self.noise = features, noise
        self.field = TorchField(field)
        self.contact = perceptron(n_electrode, hidden, 6)
        self.nearest = perceptron(n_electrode, nearest_hidden, 3)
        for name, values in (
            ("centre", field.domain.centre),
            ("scale", field.domain.scale),
            ("typical", features.typical),
            ("whitening", features.matrix),
        ):
            self.register_buffer(name, torch.tensor(values).float())

    def logs(self, charge_pC: Tensor) -> Tensor:
        """ln(Q / typical), finite for any input."""
        return torch.log(charge_pC.clamp(LOWEST_PC, HIGHEST_PC) / self.typical)

    def sigma(self, charge_pC: Tensor) -> Tensor:
        """Standard deviation of charges in pC."""
        return torch.sqrt((1e12 * self.noise.white) ** 2 + (self.noise.gain * charge_pC) ** 2)

    def posterior(self, charge_pC: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the unit coordinates, each (n, 3)."""
        out = self.contact(self.logs(charge_pC) @ self.whitening)
        return out[:, :3], out[:, 3:]

    def propose(self, charge_pC: Tensor) -> Tensor:
        """The nearest-contact network's unit coordinates (n, 3), not yet inside the domain."""
        proposal: Tensor = self.nearest(self.logs(charge_pC) @ self.whitening)
        return proposal

    def distance(self, charge_pC: Tensor, unit: Tensor) -> Tensor:
        """|(Q - Q(c)) / sigma| for contacts c in unit coordinates, shape (n,)."""
        within = charge_pC.clamp(-HIGHEST_PC, HIGHEST_PC)
        known = torch.exp(self.field(unit)[:, 0])
        distance: Tensor = torch.linalg.vector_norm((within - known) / self.sigma(within), dim=1)
        return distance

    def improve(self, charge_pC: Tensor, unit: Tensor) -> Tensor:
        """One Gauss-Newton step towards the nearest contact, projected onto the domain."""
        rows = self.field(unit, rows=4)
        miss = self.logs(charge_pC) + torch.log(self.typical) - rows[:, 0]
        return project(unit + (rows[:, 1:] * miss[:, None]).sum(dim=2))

    def misfit(self, charge_pC: Tensor, mean: Tensor) -> Tensor:
        """Distance to the nearest known contact in units of sigma, shape (n,)."""
        starts = (project(mean), project(self.propose(charge_pC)))
        tried = [unit for start in starts for unit in (start, self.improve(charge_pC, start))]
        return torch.stack([self.distance(charge_pC, unit) for unit in tried]).amin(dim=0)

    def forward(self, charge_pC: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Charges (n, n_electrode), pC, to contact (n, 3) in mm and N, contact_std (n, 3), misfit (n, 1)."""
        mean, log_std = self.posterior(charge_pC)
        value, std = mean * self.scale + self.centre, torch.exp(log_std) * self.scale
        force = torch.exp(value[:, 2:])
        contact = torch.cat([value[:, :2], force], dim=1)
        contact_std = torch.cat([std[:, :2], std[:, 2:] * force], dim=1)
        return contact, contact_std, self.misfit(charge_pC, mean)[:, None]


def project(unit: Tensor) -> Tensor:
    """The nearest point of the domain, unit disk times [-1, 1]; shape (n, 3)."""
    radius = unit[:, :2].norm(dim=1, keepdim=True).clamp(min=1.0)
    return torch.cat([unit[:, :2] / radius, unit[:, 2:].clamp(-1.0, 1.0)], dim=1)
