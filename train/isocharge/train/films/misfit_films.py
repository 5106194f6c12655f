"""Charges of all kinds on many films, with their nearest contacts, and what the misfit network learns from them."""

from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import Domain, FunctionMap
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.data.misfit_charges import draw_misfit_examples
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses, draw_contacts
from isocharge.train.films.contact_stage import FilmInputs
from isocharge.train.training.network import Trainable, compress_length

CANDIDATES = 512
"""Contacts among which a search starts; fewer than for one film alone, where a candidate costs less."""

WIDEST = 8.0
"""Largest deviation of a good press, over that of the noise."""

NEAR_WEIGHT = 10.0
"""Weight of good presses in the loss: their misfits are small, and decide when an alarm is false."""

WATCHED = 0.06
"""Share of the films that are watched while the network trains."""


@dataclass(frozen=True)
class DrawnFilms:
    """Where examples come from.

    Attributes:
        prior: The films.
        family: Their forward maps.
        domain: The contacts.
        noise: Noise of good presses.
    """

    prior: FilmPrior
    family: FilmFamily
    domain: Domain
    noise: NoiseModel

    def charge_map(self, parameters: Array) -> FunctionMap:
        """The charges of one film as the model sees them, clipped."""
        forward_map = self.family.forward_map(*self.prior.film(parameters))

        def charges(contact: Array) -> Array:
            return np.clip(forward_map.charges(contact), LOWEST_CHARGE, HIGHEST_CHARGE)

        return FunctionMap(charges, forward_map.electrodes, self.domain)


@dataclass(frozen=True)
class MisfitFilms:
    """Charges of every kind on films.

    Attributes:
        parameters: Of the films, shape (n_film, n_parameter).
        charge: Shape (n_film, n, n_electrode), pC.
        residual: (Q - Q(c)) / sigma at the nearest contact c, shape (n_film, n, n_electrode).
    """

    parameters: Array
    charge: Array
    residual: Array


def draw_misfit_films(
    source: DrawnFilms, films: int, charges: int, seed: int, executor: Executor | None = None
) -> MisfitFilms:
    """Draw films, and charges of every kind on each."""
    parameters = source.prior.draw(np.random.default_rng([seed, 2]), films)
    jobs = in_order(executor, partial(_one_film, source, charges, seed), enumerate(parameters))
    return MisfitFilms(parameters, *np.stack(list(track(jobs, "searching nearest contacts", films)), axis=1))


def _one_film(source: DrawnFilms, charges: int, seed: int, job: tuple[int, Array]) -> Array:
    """Charges and residuals, shape (2, charges, n_electrode)."""
    number, parameters = job
    charge_map = source.charge_map(parameters)
    contact = draw_contacts(np.random.default_rng([seed, 3, number]), source.domain, charges)
    presses = LabelledPresses(contact, charge_map.charges(contact))
    examples = draw_misfit_examples(presses, charge_map, source.noise, charges, seed + number, candidates=CANDIDATES)
    return np.stack([examples.charge, examples.residual])


@dataclass(frozen=True)
class NearFilms:
    """Good presses on films, about which the nearest contact follows without a search.

    Attributes:
        parameters: Of the films, shape (n_film, n_parameter).
        charge: Clean, shape (n_film, n, n_electrode), pC.
        across: Of a deviation in units of the noise, the part that no contact explains, to first order; shape (n_film,
            n, n_electrode, n_electrode). Noise of many seeds is free then.
    """

    parameters: Array
    charge: Array
    across: Array


def draw_near_films(
    source: DrawnFilms, films: int, presses: int, seed: int, executor: Executor | None = None
) -> NearFilms:
    """Draw films, and good presses on each."""
    parameters = source.prior.draw(np.random.default_rng([seed, 4]), films)
    jobs = in_order(executor, partial(_near_one_film, source, presses, seed), enumerate(parameters))
    drawn = np.stack(list(track(jobs, "drawing good presses", films)))
    return NearFilms(parameters, drawn[..., 0], drawn[..., 1:])


def _near_one_film(source: DrawnFilms, presses: int, seed: int, job: tuple[int, Array]) -> Array:
    """Charges, and `across`, side by side: shape (presses, n_electrode, 1 + n_electrode)."""
    number, parameters = job
    contact = draw_contacts(np.random.default_rng([seed, 5, number]), source.domain, presses)
    charge_map = source.charge_map(parameters)
    charge = charge_map.charges(contact)
    slopes = charge_map.derivatives(contact) * source.domain.scale / source.noise.sigma(charge)[:, :, None]
    basis = np.linalg.qr(slopes)[0]
    across = np.eye(charge.shape[1]) - basis @ basis.transpose(0, 2, 1)
    return np.concatenate([charge[:, :, None], across], axis=2)


@dataclass(frozen=True)
class NearPresses:
    """Good presses with fresh deviations in every step: `NearFilms` as tensors."""

    inputs: FilmInputs
    parameters: Array
    charge: Tensor
    across: Tensor
    noise: NoiseModel

    @classmethod
    def of(cls, inputs: FilmInputs, near: NearFilms, noise: NoiseModel) -> "NearPresses":
        charge, across = (torch.tensor(values).float() for values in (near.charge, near.across))
        return cls(inputs, near.parameters, charge, across, noise)

    def batch(self, films: int, presses: int, random: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Inputs, contexts and targets: deviations of the size of the noise, and up to `WIDEST` times that."""
        of = torch.randint(len(self.charge), (films,), generator=random)
        rows = torch.randint(self.charge.shape[1], (films, presses), generator=random)
        clean, across = self.charge[of[:, None], rows], self.across[of[:, None], rows]
        widest = 1.0 + (WIDEST - 1.0) * torch.rand((films, presses, 1), generator=random) ** 3
        deviation = widest * torch.randn(clean.shape, generator=random)
        sigma = torch.hypot(torch.tensor(self.noise.white), self.noise.gain * clean)
        residual = (across @ deviation[..., None])[..., 0]
        parameters = self.parameters[of.numpy()]
        values = self.inputs.values(clean + sigma * deviation, parameters)
        return values, self.inputs.context(parameters), compress_length(residual)


@dataclass(frozen=True)
class MisfitStage:
    """The misfit network's data: inputs, contexts and compressed vectors by film, the last films only watched.

    Attributes:
        part: The network.
        inputs: Shape (n_film, n, n_electrode).
        context: Shape (n_film, n_context).
        targets: Shape (n_film, n, n_electrode).
        near: Good presses, half of every batch.
        batch: Films in a step, and charges of each.
    """

    part: Trainable
    inputs: Tensor
    context: Tensor
    targets: Tensor
    near: NearPresses
    batch: tuple[int, int]

    @classmethod
    def of(cls, part: Trainable, near: NearPresses, examples: MisfitFilms, batch: tuple[int, int]) -> "MisfitStage":
        inputs = near.inputs
        values = inputs.values(torch.tensor(examples.charge).float(), examples.parameters)
        targets = compress_length(torch.tensor(examples.residual)).float()
        return cls(part, values, inputs.context(examples.parameters), targets, near, batch)

    @property
    def watched(self) -> int:
        """Number of films that are only watched."""
        return max(1, round(WATCHED * len(self.inputs)))

    def loss(self, _: int, random: torch.Generator) -> Tensor:
        """Of a fresh batch: half of it good presses, half of all kinds."""
        films, charges = self.batch[0] // 2, self.batch[1]
        of = torch.randint(len(self.inputs) - self.watched, (films,), generator=random)
        rows = torch.randint(self.inputs.shape[1], (films, charges), generator=random)
        all_kinds = self._squares(self.inputs[of[:, None], rows], self.context[of], self.targets[of[:, None], rows])
        return NEAR_WEIGHT * self._squares(*self.near.batch(films, charges, random)) + all_kinds

    def score(self) -> tuple[float, str]:
        """The loss on the watched films and on fresh deviations, and a text about it."""
        last = slice(-self.watched, None)
        random = torch.Generator().manual_seed(0)
        with torch.no_grad():
            all_kinds = self._squares(self.inputs[last], self.context[last], self.targets[last]).item()
            near = self._squares(*self.near.batch(len(self.near.charge), 8, random)).item()
        return NEAR_WEIGHT * near + all_kinds, f"{all_kinds:.4f} on watched films, {near:.5f} on good presses"

    def _squares(self, inputs: Tensor, context: Tensor, targets: Tensor) -> Tensor:
        squares: Tensor = ((self.part(inputs, context) - targets) ** 2).sum(dim=-1).mean()
        return squares
