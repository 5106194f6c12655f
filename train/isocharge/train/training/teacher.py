"""A model that teaches a smaller one: the smaller one learns its answers to charges with noise.

A press says where it was, but not what its noisy charges tell; the answer of a good model is that, without the scatter
of single presses. So a small network learns faster from answers than from presses (Hinton et al. 2015).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.train.data.domain import ContactDomain


@dataclass(frozen=True)
class Teacher:
    """A trained model.

    Attributes:
        label: Its name and version.
        sha256: Of its file.
        answer: Charges (n, n_electrode), pC, to contact (n, 3) in mm and N, and contact_std (n, 3).
    """

    label: str
    sha256: str
    answer: Callable[[Array], tuple[Array, Array]]

    def posterior(self, charge_pC: Tensor, domain: ContactDomain) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the domain's unit coordinates, each (n, 3)."""
        contact, std = self.answer(charge_pC.double().numpy())
        relative = np.column_stack([std[:, :2], std[:, 2] / contact[:, 2]]) / domain.scale
        return torch.tensor(domain.to_unit(contact)).float(), torch.tensor(np.log(relative)).float()


def teaching_loss(mean: Tensor, log_std: Tensor, taught_mean: Tensor, taught_log_std: Tensor) -> Tensor:
    """Kullback-Leibler divergence of a network's Gaussians from the teacher's, summed over (x, y, ln F)."""
    squares = torch.exp(2.0 * taught_log_std) + (mean - taught_mean) ** 2
    return (log_std - taught_log_std + 0.5 * (squares * torch.exp(-2.0 * log_std) - 1.0)).sum(dim=1).mean()
