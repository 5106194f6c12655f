"""How a network for all films is trained."""

from dataclasses import asdict, dataclass
from typing import Any

from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS


@dataclass(frozen=True)
class FilmsConfig:
    """Everything that fixes a training, given the films.

    Attributes:
        radius: Largest distance of a press from the film's centre, m.
        force_range: Smallest and largest force, N.
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the one that gives the misfit; as many layers.
        films: Films that the contact network learns from; `watched` of them are only watched.
        presses: Presses on each.
        watched: Films that are watched while it trains.
        steps: Optimiser steps of the contact network.
        misfit_films: Films that the misfit network learns from.
        misfit_charges: Charges of each.
        near_films: Films whose good presses it learns from, as many presses on each as above.
        misfit_steps: Optimiser steps of the misfit network.
        batch_films: Films in a step.
        batch_presses: Presses of each.
        learning_rate: Largest rate of the schedule (Adam's; Muon's is a multiple).
        noise: Level of the noise model that is added afresh in every step.
        seed: Of films, presses, weights, batches and noise.
    """

    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    hidden: tuple[int, ...] = (96, 96, 96)
    misfit_hidden: tuple[int, ...] = (64, 64, 64)
    films: int = 4096
    presses: int = 128
    watched: int = 64
    steps: int = 22_000
    misfit_films: int = 320
    misfit_charges: int = 160
    near_films: int = 768
    misfit_steps: int = 9_000
    batch_films: int = 32
    batch_presses: int = 64
    learning_rate: float = 4e-3
    noise: str = "reference"
    seed: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        return asdict(self)
