"""Charges of all kinds on many films, with their nearest contacts, and what the misfit network learns from them."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from isocharge.arrays import Array
from isocharge.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.solve_family import report_each
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.misfit_charges import draw_misfit_examples
from isocharge.train.data.noise import PC
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.films.film_presses import draw_contacts
from isocharge.train.films.inputs import FilmInputs
from isocharge.train.training.network import Trainable, compress_length

STEP = 3e-3
"""Step of the derivatives in unit coordinates: a family reaches beyond the domain by more."""

CANDIDATES = 512
"""Contacts among which a search starts; fewer than for one film alone, where a candidate costs less."""

WATCHED = 0.06
"""Share of the films that are watched while the network trains."""


@dataclass(frozen=True)
class MapField:
    """A film's forward map as the search for the nearest contact takes it (`ChargeField`): values and derivatives.

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
        logs: Array = np.log(PC * self.forward_map.forward(x, y, force))
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
    return {"parameters": parameters, "charge_pC": np.stack([d[0] for d in drawn]), "miss": np.stack([d[1] for d in drawn])}


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


@dataclass(frozen=True)
class MisfitStage:
    """The misfit network's data: inputs, contexts and compressed vectors by film, the last films only watched.

    Attributes:
        part: The network.
        inputs: Shape (n_film, n, n_electrode).
        context: Shape (n_film, n_context).
        targets: Shape (n_film, n, n_electrode).
        batch: Films in a step, and charges of each.
    """

    part: Trainable
    inputs: Tensor
    context: Tensor
    targets: Tensor
    batch: tuple[int, int]

    @classmethod
    def of(
        cls, part: Trainable, inputs: FilmInputs, examples: dict[str, np.ndarray], batch: tuple[int, int]
    ) -> "MisfitStage":
        """From examples as `draw_misfit_films` gives them."""
        parameters, miss = examples["parameters"], torch.tensor(examples["miss"])
        targets = compress_length(miss.reshape(-1, miss.shape[-1])).reshape(miss.shape).float()
        values = inputs.values(torch.tensor(examples["charge_pC"]).float(), parameters)
        return cls(part, values, inputs.context(parameters), targets, batch)

    @property
    def watched(self) -> int:
        """Number of films that are only watched."""
        return max(1, round(WATCHED * len(self.inputs)))

    def loss(self, _: int, random: torch.Generator) -> Tensor:
        """Of a fresh batch."""
        films, charges = self.batch
        of = torch.randint(len(self.inputs) - self.watched, (films,), generator=random)
        rows = torch.randint(self.inputs.shape[1], (films, charges), generator=random)
        return self._squares(self.inputs[of[:, None], rows], self.context[of], self.targets[of[:, None], rows])

    def score(self) -> tuple[float, str]:
        """The loss on the watched films, and a text about it."""
        last = slice(-self.watched, None)
        with torch.no_grad():
            mean = self._squares(self.inputs[last], self.context[last], self.targets[last]).item()
        return mean, f"{mean:.4f} on watched films"

    def _squares(self, inputs: Tensor, context: Tensor, targets: Tensor) -> Tensor:
        squares: Tensor = ((self.part(inputs, context) - targets) ** 2).sum(dim=-1).mean()
        return squares
