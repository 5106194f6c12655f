"""Charges of all kinds on many films, with their nearest contacts, and what the misfit network learns from them."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.solve_family import report_each
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.data.domain import HIGHEST_PC, LOWEST_PC, ContactDomain
from isocharge.train.data.misfit_charges import draw_misfit_examples
from isocharge.train.data.noise import PC, sigma_pC
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.films.film_presses import draw_contacts
from isocharge.train.films.inputs import FilmInputs
from isocharge.train.training.network import Trainable, compress_length

STEP = 3e-3
"""Step of the derivatives in unit coordinates: a family reaches beyond the domain by more."""

CANDIDATES = 512
"""Contacts among which a search starts; fewer than for one film alone, where a candidate costs less."""

WIDEST = 8.0
"""Largest deviation of a good press, over that of the noise."""

NEAR_WEIGHT = 10.0
"""Weight of good presses in the loss: their misfits are small, and decide when an alarm is false."""

WATCHED = 0.06
"""Share of the films that are watched while the network trains."""


@dataclass(frozen=True)
class MapField:
    """A film's forward map as the search for the nearest contact takes it (`NearestField`), charges clipped as the
    model clips them.

    Attributes:
        domain: Where contacts are searched for.
        forward_map: The charges; it reaches beyond the domain by `STEP`.
    """

    domain: ContactDomain
    forward_map: ForwardMap

    def log_charge(self, unit: Array) -> Array:
        """ln Q and its derivatives by the unit coordinates: contacts (n, 3) in them to (n, 4, n_electrode)."""
        moved = unit[:, None] + STEP * np.vstack([np.zeros(3), np.eye(3)])
        logs = self._logs(moved.reshape(-1, 3)).reshape(len(unit), 4, -1)
        logs[:, 1:] = (logs[:, 1:] - logs[:, :1]) / STEP
        return logs

    def _logs(self, unit: Array) -> Array:
        x, y, force = (self.domain.to_contact(unit) * [1e-3, 1e-3, 1.0]).T
        logs: Array = np.log(np.clip(PC * self.forward_map.forward(x, y, force), LOWEST_PC, HIGHEST_PC))
        return logs


def draw_misfit_films(
    prior: FilmPrior,
    family: FilmFamily,
    domain: ContactDomain,
    noise: NoiseModel,
    films: int,
    charges: int,
    seed: int,
    *,
    map_jobs: JobMap = map,
    progress: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Draw films, and charges of every kind on each.

    Returns:
        `parameters` (n_film, n_parameter); `charge_pC` and `miss`, both (n_film, n, n_electrode): charges, and
        (Q - Q(c)) / sigma at the nearest contact c.
    """
    parameters = prior.draw(np.random.default_rng([seed, 2]), films)
    work = partial(_one_film, prior, family, domain, noise, charges, seed)
    drawn = list(report_each(map_jobs(work, enumerate(parameters)), films, progress))
    charge, miss = np.stack(drawn, axis=1)
    return {"parameters": parameters, "charge_pC": charge, "miss": miss}


def _one_film(
    prior: FilmPrior,
    family: FilmFamily,
    domain: ContactDomain,
    noise: NoiseModel,
    charges: int,
    seed: int,
    job: tuple[int, Array],
) -> Array:
    """Charges and misses, shape (2, charges, n_electrode)."""
    number, parameters = job
    field = MapField(domain, family.forward_map(*prior.film(parameters)))
    contact = draw_contacts(np.random.default_rng([seed, 3, number]), domain, charges)
    presses = LabelledPresses(contact, np.exp(field.log_charge(domain.to_unit(contact))[:, 0]))
    examples = draw_misfit_examples(presses, field, noise, charges, seed + number, candidates=CANDIDATES)
    return np.stack([examples.charge_pC, examples.miss])


def draw_near_films(
    prior: FilmPrior,
    family: FilmFamily,
    domain: ContactDomain,
    noise: NoiseModel,
    films: int,
    presses: int,
    seed: int,
    *,
    map_jobs: JobMap = map,
    progress: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Draw films, and good presses on each, about which the nearest contact follows without a search.

    Returns:
        `parameters` (n_film, n_parameter); `charge_pC` (n_film, n, n_electrode), clean; `across` (n_film, n,
        n_electrode, n_electrode): of a deviation in units of the noise, the part that no contact explains, to first
        order. Noise of many seeds is free then.
    """
    parameters = prior.draw(np.random.default_rng([seed, 4]), films)
    work = partial(_near_one_film, prior, family, domain, noise, presses, seed)
    drawn = list(report_each(map_jobs(work, enumerate(parameters)), films, progress))
    charge, across = np.stack([part[0] for part in drawn]), np.stack([part[1:] for part in drawn])
    return {"parameters": parameters, "charge_pC": charge, "across": np.moveaxis(across, 1, -1)}


def _near_one_film(
    prior: FilmPrior,
    family: FilmFamily,
    domain: ContactDomain,
    noise: NoiseModel,
    presses: int,
    seed: int,
    job: tuple[int, Array],
) -> Array:
    """Charges, and the rows of `across`, shape (1 + n_electrode, presses, n_electrode)."""
    number, parameters = job
    contact = draw_contacts(np.random.default_rng([seed, 5, number]), domain, presses)
    logs = MapField(domain, family.forward_map(*prior.film(parameters))).log_charge(domain.to_unit(contact))
    charge = np.exp(logs[:, 0])
    slopes = logs[:, 1:] * (charge / sigma_pC(noise, charge))[:, None]
    basis = np.linalg.qr(slopes.transpose(0, 2, 1))[0]
    across = np.eye(charge.shape[1]) - basis @ basis.transpose(0, 2, 1)
    return np.concatenate([charge[None], across.transpose(1, 0, 2)])


@dataclass(frozen=True)
class NearPresses:
    """Good presses with fresh deviations in every step: what `draw_near_films` gives, as tensors."""

    inputs: FilmInputs
    parameters: Array
    charge_pC: Tensor
    across: Tensor
    noise: NoiseModel

    @classmethod
    def of(cls, inputs: FilmInputs, near: dict[str, np.ndarray], noise: NoiseModel) -> "NearPresses":
        """From what `draw_near_films` gives."""
        charge, across = (torch.tensor(near[name]).float() for name in ("charge_pC", "across"))
        return cls(inputs, near["parameters"], charge, across, noise)

    def batch(self, films: int, presses: int, random: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Inputs, contexts and targets: deviations of the size of the noise, and up to `WIDEST` times that."""
        of = torch.randint(len(self.charge_pC), (films,), generator=random)
        rows = torch.randint(self.charge_pC.shape[1], (films, presses), generator=random)
        clean, across = self.charge_pC[of[:, None], rows], self.across[of[:, None], rows]
        widest = 1.0 + (WIDEST - 1.0) * torch.rand((films, presses, 1), generator=random) ** 3
        deviation = widest * torch.randn(clean.shape, generator=random)
        sigma = torch.hypot(torch.tensor(PC * self.noise.white), self.noise.gain * clean)
        miss = (across @ deviation[..., None])[..., 0]
        parameters = self.parameters[of.numpy()]
        values = self.inputs.values(clean + sigma * deviation, parameters)
        return values, self.inputs.context(parameters), _compressed(miss)


def _compressed(miss: Tensor) -> Tensor:
    """`compress_length` of vectors (..., n_electrode), float32."""
    return compress_length(miss.reshape(-1, miss.shape[-1])).reshape(miss.shape).float()


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
    def of(
        cls, part: Trainable, near: NearPresses, examples: dict[str, np.ndarray], batch: tuple[int, int]
    ) -> "MisfitStage":
        """From examples as `draw_misfit_films` gives them."""
        parameters, inputs = examples["parameters"], near.inputs
        values = inputs.values(torch.tensor(examples["charge_pC"]).float(), parameters)
        targets = _compressed(torch.tensor(examples["miss"]))
        return cls(part, values, inputs.context(parameters), targets, near, batch)

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
            near = self._squares(*self.near.batch(len(self.near.charge_pC), 8, random)).item()
        return NEAR_WEIGHT * near + all_kinds, f"{all_kinds:.4f} on watched films, {near:.5f} on good presses"

    def _squares(self, inputs: Tensor, context: Tensor, targets: Tensor) -> Tensor:
        squares: Tensor = ((self.part(inputs, context) - targets) ** 2).sum(dim=-1).mean()
        return squares
