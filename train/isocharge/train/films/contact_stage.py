"""What the contact network for all films learns from: presses with noise and factors drawn anew in every step."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.film_prior import REACH, SHARED
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.films.film_presses import D31, D32, FilmPresses, gains_of, part_factors
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.training.fit import likelihood_loss, start_loss, with_fresh_noise
from isocharge.train.training.network import Trainable

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
        some = presses[:FITTED]
        logs = np.log(np.clip(some.charge(), LOWEST_CHARGE, HIGHEST_CHARGE))
        logs = (logs - scaling.log_charge_scale(some.parameters)[:, None]).reshape(-1, logs.shape[-1])
        mean = logs.mean(axis=0)
        _, singular, axes = np.linalg.svd(logs - mean, full_matrices=False)
        return cls(scaling, mean, axes.T * (np.sqrt(len(logs)) / np.maximum(singular, 1e-12)))

    def values(self, charge: Tensor, parameters: Array) -> Tensor:
        """Charges (n_film, n, n_electrode) of films (n_film, n_parameter) to inputs of the same shape."""
        shift = torch.tensor(self.scaling.log_charge_scale(parameters) + self.mean).float()
        logs = torch.log(charge.clamp(LOWEST_CHARGE, HIGHEST_CHARGE)) - shift[:, None]
        return logs @ torch.tensor(self.whitening).float()

    def context(self, parameters: Array) -> Tensor:
        """Contexts of films, (n_film, n_parameter) to (n_film, n_context)."""
        return torch.tensor(self.scaling.context(parameters)).float()


@dataclass(frozen=True)
class ContactStage:
    """The contact network, its presses, and its losses; the last `watched` films are only watched."""

    part: Trainable
    inputs: FilmInputs
    presses: FilmPresses
    noise: NoiseModel
    watched: int
    batch: tuple[int, int]
    warm_up_steps: int
    seed: int

    def loss(self, step: int, random: torch.Generator) -> Tensor:
        """Of a fresh batch."""
        films, presses = self.batch
        of = torch.randint(len(self.presses) - self.watched, (films,), generator=random)
        rows = torch.randint(self.presses.contact.shape[1], (films, presses), generator=random)
        parameters = self._with_fresh_factors(self.presses.parameters[of.numpy()], random)
        mean, log_std, unit = self._posterior(of.numpy(), rows.numpy(), parameters, random)
        return (start_loss if step < self.warm_up_steps else likelihood_loss)(mean, log_std, unit)

    def score(self) -> tuple[float, str]:
        """The loss on the watched films, and a text about it."""
        of = np.arange(len(self.presses) - self.watched, len(self.presses))
        rows = np.broadcast_to(np.arange(self.presses.contact.shape[1]), (self.watched, self.presses.contact.shape[1]))
        random = torch.Generator().manual_seed(self.seed)
        with torch.no_grad():
            mean, log_std, unit = self._posterior(of, rows, self.presses.parameters[of], random)
            loss = likelihood_loss(mean, log_std, unit).item()
            off = ((mean - unit).numpy() * self.inputs.scaling.domain.scale) ** 2
        position, force = np.sqrt(off[:, :2].sum(axis=1).mean()), np.sqrt(off[:, 2].mean())
        return loss, f"{loss:.3f} on watched films: {position:.4f} mm and {100.0 * force:.3f} % of force rms"

    def _with_fresh_factors(self, parameters: Array, random: torch.Generator) -> Array:
        """The films with d31, d32 and gains drawn anew."""
        prior, fresh = self.inputs.scaling.prior, parameters.copy()
        columns = [D31, D32, *range(len(SHARED), parameters.shape[1])]
        drawn = torch.randn((len(parameters), len(columns)), generator=random).clamp(-REACH, REACH).double().numpy()
        fresh[:, columns] = prior.mean[columns] + prior.std[columns] * drawn
        return fresh

    def _posterior(
        self, of: np.ndarray, rows: np.ndarray, parameters: Array, random: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, log standard deviation and truth in unit coordinates, each (n, 3), of noisy charges."""
        scaling = self.inputs.scaling
        parts = torch.from_numpy(self.presses.response[of[:, None], rows])
        factors = torch.tensor(part_factors(parameters)).float()[:, None, :, None]
        clean = (parts @ factors)[..., 0] * torch.tensor(gains_of(parameters)).float()[:, None]
        values = self.inputs.values(with_fresh_noise(clean, self.noise, random), parameters)
        out = self.part(values, self.inputs.context(parameters))
        rotation, offset = (torch.tensor(part(parameters)).float() for part in (scaling.rotation, scaling.offset))
        mean = torch.baddbmm(offset[:, None], out[..., :3], rotation.transpose(1, 2))
        contact = self.presses.contact[of[:, None], rows].reshape(-1, 3)
        unit = torch.tensor(scaling.domain.to_unit(contact)).float()
        return mean.reshape(-1, 3), out[..., 3:].reshape(-1, 3), unit
