"""What the networks for all films see: whitened logarithms of the charges, the films' exact scales divided out."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.train.data.domain import HIGHEST_PC, LOWEST_PC
from isocharge.train.films.film_presses import FilmPresses
from isocharge.train.films.film_scaling import FilmScaling

FITTED = 512
"""Films that the whitening is taken from."""


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
        some = FilmPresses(*(values[:FITTED] for values in vars(presses).values()))
        logs = np.log(np.clip(some.charge_pC(), LOWEST_PC, HIGHEST_PC))
        logs = (logs - scaling.log_charge_scale(some.parameters)[:, None]).reshape(-1, logs.shape[-1])
        mean = logs.mean(axis=0)
        _, singular, axes = np.linalg.svd(logs - mean, full_matrices=False)
        return cls(scaling, mean, axes.T * (np.sqrt(len(logs)) / np.maximum(singular, 1e-12)))

    def values(self, charge_pC: Tensor, parameters: Array) -> Tensor:
        """Charges (n_film, n, n_electrode) of films (n_film, n_parameter) to inputs of the same shape."""
        shift = torch.tensor(self.scaling.log_charge_scale(parameters) + self.mean).float()
        logs = torch.log(charge_pC.clamp(LOWEST_PC, HIGHEST_PC)) - shift[:, None]
        return logs @ torch.tensor(self.whitening).float()

    def context(self, parameters: Array) -> Tensor:
        """Contexts of films, (n_film, n_parameter) to (n_film, n_context)."""
        return torch.tensor(self.scaling.context(parameters)).float()
