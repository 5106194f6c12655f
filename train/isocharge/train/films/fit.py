"""Fit one network to all the films that a sensor may be."""

from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from typing import Any

import numpy as np
import torch
from torch import Tensor

from isocharge.common.activations import ACTIVATIONS, TANH, Activation
from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.resumable_run import ResumableRun
from isocharge.simulate import Domain, NoiseModel, noise_model
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.forward.film_modes import FilmModes
from isocharge.simulate.sensor.film_prior import MAX_DEVIATION, SHARED, FilmPrior
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.films.conditional_network import ConditionalPerceptron, FilmInputs
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.films_data import (
    D31,
    D32,
    DrawnFilms,
    FilmPresses,
    FilmsSource,
    draw_film_presses,
    draw_misfit_films,
    draw_near_films,
)
from isocharge.train.films.films_model import ConditionalWeights, FilmsModel
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.fit import WARM_UP_FRACTION, threads_and_seed
from isocharge.train.training.folded_network import N_CONTACT_ANSWERS
from isocharge.train.training.losses import (
    likelihood_loss,
    mean_squared_distance,
    validation_score,
    warm_up_loss,
    with_fresh_noise,
)
from isocharge.train.training.network import as_tensor, compress_length

BEYOND = 1.5
"""How far the family reaches beyond the domain, mm: a calibration moves presses whose place is not exactly known."""

FORCES_BEYOND = (0.8, 1.2)
"""The same for forces: factors of the smallest and the largest."""

LARGEST_GRADIENT = 5.0
"""Norm to which gradients are cut: films whose map nearly folds pull hard."""

WIDEST = 8.0
"""Largest deviation of a good press, over that of the noise."""

NEAR_WEIGHT = 10.0
"""Weight of good presses in the loss of the misfit: they decide when an alarm is false, and their misfits are small."""

WATCHED = 0.06
"""Share of the films that are watched while the misfit network trains."""


@dataclass(frozen=True)
class FilmsConfig:
    """Everything that fixes a fit, given the films.

    Attributes:
        radius: Largest distance of a press from the film's centre, mm.
        force_range: Smallest and largest force, N.
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the one that gives the misfit; as many layers.
        activation: Name of the activation of the hidden layers (`isocharge.common.activations`).
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
    activation: str = TANH.name
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
        source = FilmsSource(prior, family, domain, misfit_noise(noise))
        sizes = config.films, config.presses, config.seed
        presses = draw_film_presses(prior, family, domain, *sizes, kept("presses"))
        inputs = FilmInputs.fit(FilmScaling(prior, domain), presses)

        activation = ACTIVATIONS[config.activation]
        part = _network(inputs, config.hidden, N_CONTACT_ANSWERS, activation)
        _descend(contact_stage(part, inputs, presses, noise, config), config, run)

        sizes = config.misfit_films, config.misfit_charges, config.seed
        examples = draw_misfit_films(source, *sizes, kept("nearest-contacts"))
        near = draw_near_films(source, config.near_films, config.presses, config.seed, kept("good-presses"))
        vector = _network(inputs, config.misfit_hidden, inputs.mean.size, activation)
        _descend(misfit_stage(vector, inputs, examples, near, source.noise, config), config, run)
    return FilmsModel(
        family=family,
        scaling=inputs.scaling,
        mean=inputs.mean,
        whitening=inputs.whitening,
        contact=ConditionalWeights(part.to_arrays(), activation),
        misfit=ConditionalWeights(vector.to_arrays(), activation),
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
    modes = FilmModes.build(family, prior.sensor.film, executor)
    return FilmFamily.from_arrays(replace(family, imperfections=modes).to_arrays())


def _network(
    inputs: FilmInputs, hidden: tuple[int, ...], n_output: int, activation: Activation
) -> ConditionalPerceptron:
    """Return an untrained perceptron for all films."""
    context_mean, _ = inputs.scaling.standard
    return ConditionalPerceptron(inputs.mean.size, hidden, n_output, context_mean.size, activation)


def _descend(stage: TrainingStage, config: FilmsConfig, run: ResumableRun | None) -> None:
    """Train to the end: the schedule's last steps are the best."""
    Descent(stage, config.learning_rate, stage.steps, config.seed).run(run)


def contact_stage(
    part: ConditionalPerceptron, inputs: FilmInputs, presses: FilmPresses, noise: NoiseModel, config: FilmsConfig
) -> TrainingStage:
    """The contact network's losses; the last films of the presses are only watched."""
    scaling, warm_up, trained = inputs.scaling, round(WARM_UP_FRACTION * config.steps), len(presses) - config.watched

    def posterior(
        of: np.ndarray, rows: np.ndarray, parameters: Array, random: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, log standard deviation and truth in unit coordinates, each (n, 3), of noisy charges."""
        drawn = FilmPresses(parameters, presses.contact[of[:, None], rows], presses.response[of[:, None], rows])
        noisy = with_fresh_noise(as_tensor(drawn.charge()), noise, random)
        out = part(inputs.values(noisy, parameters), inputs.context(parameters))
        rotation, offset = as_tensor(scaling.rotation(parameters)), as_tensor(scaling.offset(parameters))
        mean = torch.baddbmm(offset[:, None], out[..., :3], rotation.transpose(1, 2))
        unit = as_tensor(scaling.domain.to_unit(drawn.contact.reshape(-1, 3).astype(float)))
        return mean.reshape(-1, 3), out[..., 3:].reshape(-1, 3), unit

    def loss(step: int, random: torch.Generator) -> Tensor:
        of = torch.randint(trained, (config.batch_films,), generator=random)
        rows = torch.randint(presses.contact.shape[1], (config.batch_films, config.batch_presses), generator=random)
        parameters = _with_fresh_factors(scaling.prior, presses.parameters[of.numpy()], random)
        answers = posterior(of.numpy(), rows.numpy(), parameters, random)
        return (warm_up_loss if step < warm_up else likelihood_loss)(*answers)

    def score() -> tuple[float, str]:
        of = np.arange(trained, len(presses))
        rows = np.tile(np.arange(presses.contact.shape[1]), (config.watched, 1))
        random = torch.Generator().manual_seed(config.seed)
        return validation_score(*posterior(of, rows, presses.parameters[of], random), scaling.domain, "films")

    return TrainingStage("contact", part, loss, score, config.steps, warm_up, LARGEST_GRADIENT)


def _with_fresh_factors(prior: FilmPrior, parameters: Array, random: torch.Generator) -> Array:
    """The films with d31, d32 and gains drawn anew."""
    fresh, columns = parameters.copy(), [D31, D32, *range(len(SHARED), parameters.shape[1])]
    drawn = (
        torch.randn((len(parameters), len(columns)), generator=random)
        .clamp(-MAX_DEVIATION, MAX_DEVIATION)
        .double()
        .numpy()
    )
    fresh[:, columns] = prior.mean[columns] + prior.std[columns] * drawn
    return fresh


def misfit_stage(
    part: ConditionalPerceptron,
    inputs: FilmInputs,
    examples: DrawnFilms,
    near: DrawnFilms,
    noise: NoiseModel,
    config: FilmsConfig,
) -> TrainingStage:
    """The misfit network's losses, half of every batch from good presses; the last films of the examples are watched.

    Args:
        part: The network.
        inputs: What it sees.
        examples: What `draw_misfit_films` gives.
        near: What `draw_near_films` gives; their deviations, up to `WIDEST` times the noise, are new in every step.
        noise: Of good presses.
        config: Batches and steps.
    """
    values = inputs.values(as_tensor(examples.charge), examples.parameters)
    context, targets = inputs.context(examples.parameters), compress_length(torch.tensor(examples.aim)).float()
    trained = len(values) - max(1, round(WATCHED * len(values)))
    near_charge, across = as_tensor(near.charge), as_tensor(near.aim)

    def near_squares(films: int, presses: int, random: torch.Generator) -> Tensor:
        of = torch.randint(len(near_charge), (films,), generator=random)
        rows = torch.randint(near_charge.shape[1], (films, presses), generator=random)
        clean = near_charge[of[:, None], rows]
        widest = 1.0 + (WIDEST - 1.0) * torch.rand((films, presses, 1), generator=random) ** 3
        deviation = widest * torch.randn(clean.shape, generator=random)
        noisy = clean + torch.hypot(torch.tensor(noise.white), noise.gain * clean) * deviation
        residual = (across[of[:, None], rows] @ deviation[..., None])[..., 0]
        parameters = near.parameters[of.numpy()]
        vector = part(inputs.values(noisy, parameters), inputs.context(parameters))
        return mean_squared_distance(vector, compress_length(residual))

    def loss(_: int, random: torch.Generator) -> Tensor:
        films = config.batch_films // 2
        of = torch.randint(trained, (films,), generator=random)
        rows = torch.randint(values.shape[1], (films, config.batch_presses), generator=random)
        all_kinds = mean_squared_distance(part(values[of[:, None], rows], context[of]), targets[of[:, None], rows])
        return NEAR_WEIGHT * near_squares(films, config.batch_presses, random) + all_kinds

    def score() -> tuple[float, str]:
        all_kinds = mean_squared_distance(part(values[trained:], context[trained:]), targets[trained:]).item()
        good = near_squares(len(near_charge), 8, torch.Generator().manual_seed(0)).item()
        return NEAR_WEIGHT * good + all_kinds, f"{all_kinds:.4f} on watched films, {good:.5f} on good presses"

    return TrainingStage("misfit", part, loss, score, config.misfit_steps, largest_gradient=LARGEST_GRADIENT)
