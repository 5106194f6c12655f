"""Fit one network to all the films that a sensor may be."""

from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from typing import Any

import torch

from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.resumable_run import ResumableRun
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.films.conditional_network import ConditionalPerceptron, ConditionalWeights
from isocharge.train.films.contact_stage import ContactStage, FilmInputs
from isocharge.train.films.film_presses import draw_film_presses
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.films_model import FilmsModel
from isocharge.train.films.misfit_films import (
    DrawnFilms,
    MisfitStage,
    NearPresses,
    draw_misfit_films,
    draw_near_films,
)
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.fit import WARM_UP, threads_and_seed

BEYOND = 1.5
"""How far the family reaches beyond the domain, mm: a calibration moves presses whose place is not exactly known."""

FORCES_BEYOND = (0.8, 1.2)
"""The same for forces: factors of the smallest and the largest."""

LARGEST_GRADIENT = 5.0
"""Norm to which gradients are cut: films whose map nearly folds pull hard."""


@dataclass(frozen=True)
class FilmsConfig:
    """Everything that fixes a fit, given the films.

    Attributes:
        radius: Largest distance of a press from the film's centre, mm.
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
        table = asdict(self)
        return {"radius_mm": table.pop("radius"), "force_range_N": table.pop("force_range"), **table}


def fit_films(
    prior: FilmPrior,
    config: FilmsConfig = FilmsConfig(),
    *,
    executor: Executor | None = None,
    run: ResumableRun | None = None,
) -> FilmsModel:
    """Fit a network to films drawn from a prior.

    Args:
        prior: The films: the sensor as described, the probe, and how far films spread.
        config: Radius, sizes, steps, seed.
        executor: Runs solves, presses and searches; None for this process.
        run: Keeps the state, so that a killed fit goes on.

    Raises:
        InputError: If the noise level is unknown.
        SceneError, SolveError: If some presses cannot exist or be solved.
        DatasetError: If too many charges are not positive.
        TrainingError: If the loss is not finite.
    """
    noise = noise_model(config.noise)  # an unknown level is an error before the work

    def kept(name: str) -> Executor | None:
        return run.keeping(name, executor) if run else executor

    with threads_and_seed(1, config.seed):
        domain = Domain(config.radius, config.force_range)
        family = _family(prior, config, kept("family"))
        source = DrawnFilms(prior, family, domain, misfit_noise(noise))
        sizes = config.films, config.presses, config.seed
        presses = draw_film_presses(prior, family, domain, *sizes, kept("presses"))
        inputs = FilmInputs.fit(FilmScaling(prior, domain), presses)
        batch, warm_up = (config.batch_films, config.batch_presses), round(WARM_UP * config.steps)

        part = _network(inputs, config.hidden, 6)
        contact = ContactStage(part, inputs, presses, noise, config.watched, batch, warm_up, config.seed)
        _descend(TrainingStage("contact", part, contact.loss, contact.score, config.steps, warm_up), config, run)

        examples = draw_misfit_films(
            source, config.misfit_films, config.misfit_charges, config.seed, kept("nearest-contacts")
        )
        near = draw_near_films(source, config.near_films, config.presses, config.seed, kept("good-presses"))
        vector = _network(inputs, config.misfit_hidden, inputs.mean.size)
        misfit = MisfitStage.of(vector, NearPresses.of(inputs, near, source.noise), examples, batch)
        _descend(TrainingStage("misfit", vector, misfit.loss, misfit.score, config.misfit_steps), config, run)
    return FilmsModel(
        family=family,
        scaling=inputs.scaling,
        mean=inputs.mean,
        whitening=inputs.whitening,
        contact=ConditionalWeights(part.to_arrays()),
        misfit=ConditionalWeights(vector.to_arrays()),
        noise=noise,
        made_with={"config": config.to_dict(), "torch": torch.__version__},
    )


def films_identity(prior: FilmPrior, config: FilmsConfig) -> dict[str, Any]:
    """All that decides about the weights: the identity of a resumable run."""
    return {
        "sensor": sensor_to_dict(prior.sensor),
        "probe": prior.probe.notation,
        "spread": asdict(prior.spread),
        "noise": noise_model(config.noise).to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
    }


def _family(prior: FilmPrior, config: FilmsConfig, executor: Executor | None) -> FilmFamily:
    """Forward maps of the films, to the resolution of the file."""
    low, high = config.force_range
    forces = (low * FORCES_BEYOND[0], high * FORCES_BEYOND[1])
    family = FilmFamily.build(prior, config.radius + BEYOND, forces, executor=executor)
    return FilmFamily.from_arrays(family.to_arrays())


def _network(inputs: FilmInputs, hidden: tuple[int, ...], outputs: int) -> ConditionalPerceptron:
    return ConditionalPerceptron(inputs.mean.size, hidden, outputs, inputs.scaling.standard[0].size)


def _descend(stage: TrainingStage, config: FilmsConfig, run: ResumableRun | None) -> None:
    """Train to the end: the schedule's last steps are the best."""
    cut = replace(stage, largest_gradient=LARGEST_GRADIENT)
    Descent(cut, config.learning_rate, stage.steps, config.seed).run(run)
