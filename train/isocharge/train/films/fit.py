"""Training of one network for all films of a prior."""

from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from typing import Any, NamedTuple

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
from isocharge.train.training.folded_network import LOG_STD, MEAN, N_CONTACT_ANSWERS
from isocharge.train.training.losses import (
    likelihood_loss,
    mean_squared_distance,
    validation_score,
    warm_up_loss,
    with_fresh_noise,
)
from isocharge.train.training.network import as_tensor, compress_length

RADIUS_MARGIN = 1.5
"""Distance by which the forward maps reach beyond the domain, mm. A calibration moves presses whose position is
uncertain."""

FORCE_MARGINS = (0.8, 1.2)
"""Factors of the smallest and the largest force of the domain up to which the forward maps reach."""

LARGEST_GRADIENT = 5.0
"""Norm to which larger gradients are clipped. Films whose map nearly folds have large gradients."""

MAX_NOISE_FACTOR = 8.0
"""Largest factor on the noise of good presses in the training of the misfit network."""

GOOD_PRESS_WEIGHT = 10.0
"""Weight of good presses in the loss of the misfit network. They determine the rate of false alarms, and their misfits
are small."""

MISFIT_VALIDATION_FRACTION = 0.06
"""Fraction of the films that are used for validation in the training of the misfit network."""

N_VALIDATION_PRESSES = 8
"""Number of good presses of each film in the validation of the misfit network."""


@dataclass(frozen=True)
class FilmsConfig:
    """Settings of the training of a network for all films.

    Attributes:
        radius: Largest distance of a press from the film's centre, mm.
        force_range: Smallest and largest force, N.
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the hidden layers of the misfit network, which has as many.
        activation: Name of the activation of the hidden layers (`isocharge.common.activations`).
        films: Number of films for the contact network, including those for validation.
        presses: Number of presses on each of these films.
        watched: Number of films for the validation of the contact network.
        steps: Number of optimiser steps of the contact network.
        misfit_films: Number of films for the misfit network.
        misfit_charges: Number of charges on each of these films.
        near_films: Number of films with good presses for the misfit network; each has as many presses as above.
        misfit_steps: Number of optimiser steps of the misfit network.
        batch_films: Number of films in a batch.
        batch_presses: Number of presses on each film of a batch.
        learning_rate: Largest learning rate of Adam; that of Muon is a multiple of it.
        noise: Name of the noise model. The noise is drawn again in every step.
        seed: Seed of films, presses, weights, batches and noise.
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
        """Return the settings for JSON, with units in the names."""
        table = asdict(self)
        return {"radius_mm": table.pop("radius"), "force_range_N": table.pop("force_range"), **table}


def fit_films(
    prior: FilmPrior,
    config: FilmsConfig = FilmsConfig(),
    *,
    executor: Executor | None = None,
    run: ResumableRun | None = None,
) -> FilmsModel:
    """Train a network for films drawn from a prior.

    Args:
        prior: Distribution of the films: the described sensor, the probe and the standard deviations of the parameters.
        config: Radius, sizes, steps and seed.
        executor: Executor for solves, presses and searches; None for this process.
        run: Saves the state, so that an interrupted training can be continued.

    Raises:
        InputError: If the noise model is unknown.
        SceneError, SolveError: If some presses cannot exist or cannot be solved.
        DatasetError: If too many charges are not positive.
        TrainingError: If the loss is not finite.
    """
    noise = noise_model(config.noise)  # an unknown name raises before the long computation

    def saving_executor(name: str) -> Executor | None:
        return executor if run is None else run.keeping(name, executor)

    with threads_and_seed(1, config.seed):
        domain = Domain(config.radius, config.force_range)
        family = _build_family(prior, config, saving_executor("family"))
        presses = draw_film_presses(
            prior, family, domain, config.films, config.presses, config.seed, saving_executor("presses")
        )
        inputs = FilmInputs.fit(FilmScaling(prior, domain), presses)
        activation = ACTIVATIONS[config.activation]
        contact = _new_perceptron(inputs, config.hidden, N_CONTACT_ANSWERS, activation)
        _train(contact_stage(contact, inputs, presses, noise, config), config, run)

        source = FilmsSource(prior, family, domain, misfit_noise(noise))
        examples = draw_misfit_films(
            source, config.misfit_films, config.misfit_charges, config.seed, saving_executor("nearest-contacts")
        )
        good = draw_near_films(source, config.near_films, config.presses, config.seed, saving_executor("good-presses"))
        misfit = _new_perceptron(inputs, config.misfit_hidden, inputs.mean.size, activation)
        _train(misfit_stage(misfit, inputs, examples, good, source.noise, config), config, run)
    return FilmsModel(
        family=family,
        scaling=inputs.scaling,
        mean=inputs.mean,
        whitening=inputs.whitening,
        contact=ConditionalWeights(contact.to_arrays(), activation),
        misfit=ConditionalWeights(misfit.to_arrays(), activation),
        noise=noise,
        made_with={"config": config.to_dict(), "torch": torch.__version__},
    )


def films_identity(prior: FilmPrior, config: FilmsConfig) -> dict[str, Any]:
    """Return everything that determines the weights, as the identity of a resumable run."""
    return {
        "sensor": sensor_to_dict(prior.sensor),
        "probe": prior.probe.notation,
        "spread": asdict(prior.spread),
        "noise": noise_model(config.noise).to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
    }


def _build_family(prior: FilmPrior, config: FilmsConfig, executor: Executor | None) -> FilmFamily:
    """Simulate the forward maps of the films, with the resolution of the films file."""
    smallest, largest = config.force_range
    smallest_factor, largest_factor = FORCE_MARGINS
    forces = (smallest * smallest_factor, largest * largest_factor)
    family = FilmFamily.build(prior, config.radius + RADIUS_MARGIN, forces, executor=executor)
    modes = FilmModes.build(family, prior.sensor.film, executor)
    return FilmFamily.from_arrays(replace(family, imperfections=modes).to_arrays())


def _new_perceptron(
    inputs: FilmInputs, hidden: tuple[int, ...], n_output: int, activation: Activation
) -> ConditionalPerceptron:
    """Return an untrained perceptron for all films."""
    n_context = inputs.scaling.statistics.mean.size
    return ConditionalPerceptron(inputs.mean.size, hidden, n_output, n_context, activation)


def _train(stage: TrainingStage, config: FilmsConfig, run: ResumableRun | None) -> None:
    """Train without early stopping, because the last steps of the schedule have the smallest loss."""
    Descent(stage, config.learning_rate, stage.steps, config.seed).run(run)


class _Batch(NamedTuple):
    """Estimated and true contacts of a batch in unit coordinates, shape (n, 3) each."""

    mean: Tensor
    log_std: Tensor
    target: Tensor


def contact_stage(
    network: ConditionalPerceptron, inputs: FilmInputs, presses: FilmPresses, noise: NoiseModel, config: FilmsConfig
) -> TrainingStage:
    """Return the training of the contact network.

    Args:
        network: The network.
        inputs: Inputs of the network.
        presses: Presses on films; the last films are used for validation.
        noise: Noise that is added to the charges in every step.
        config: Numbers of steps and films, and sizes of the batches.
    """
    scaling = inputs.scaling
    warm_up_steps = round(WARM_UP_FRACTION * config.steps)
    n_train = len(presses) - config.watched
    n_press = presses.contact.shape[1]

    def evaluate_batch(films: np.ndarray, rows: np.ndarray, parameters: Array, random: torch.Generator) -> _Batch:
        """Evaluate the network on charges with noise.

        Args:
            films: Numbers of the films, shape (n_film,).
            rows: Numbers of the presses on each film, shape (n_film, n_row).
            parameters: Parameters of these films, shape (n_film, n_parameter).
            random: Generator of the noise.
        """
        films = films[:, None]
        batch = FilmPresses(parameters, presses.contact[films, rows], presses.response[films, rows])
        noisy = with_fresh_noise(as_tensor(batch.charge()), noise, random)
        outputs = network(inputs.values(noisy, parameters), inputs.context(parameters))
        rotation = as_tensor(scaling.rotation(parameters))
        offset = as_tensor(scaling.offset(parameters))
        mean = torch.baddbmm(offset[:, None], outputs[..., MEAN], rotation.transpose(1, 2))
        target = as_tensor(scaling.domain.to_unit(batch.contact.reshape(-1, 3).astype(float)))
        return _Batch(mean.reshape(-1, 3), outputs[..., LOG_STD].reshape(-1, 3), target)

    def loss(step: int, random: torch.Generator) -> Tensor:
        films = torch.randint(n_train, (config.batch_films,), generator=random).numpy()
        rows = torch.randint(n_press, (config.batch_films, config.batch_presses), generator=random).numpy()
        parameters = _with_fresh_factors(scaling.prior, presses.parameters[films], random)
        loss_function = warm_up_loss if step < warm_up_steps else likelihood_loss
        return loss_function(*evaluate_batch(films, rows, parameters, random))

    def score() -> tuple[float, str]:
        films = np.arange(n_train, len(presses))
        rows = np.tile(np.arange(n_press), (config.watched, 1))
        random = torch.Generator().manual_seed(config.seed)
        batch = evaluate_batch(films, rows, presses.parameters[films], random)
        return validation_score(*batch, scaling.domain, "films")

    return TrainingStage("contact", network, loss, score, config.steps, warm_up_steps, LARGEST_GRADIENT)


def _with_fresh_factors(prior: FilmPrior, parameters: Array, random: torch.Generator) -> Array:
    """Return films, shape (n_film, n_parameter), with d31, d32 and the gains drawn again."""
    columns = [D31, D32, *range(len(SHARED), parameters.shape[1])]
    deviation = torch.randn((len(parameters), len(columns)), generator=random).clamp(-MAX_DEVIATION, MAX_DEVIATION)
    fresh = parameters.copy()
    fresh[:, columns] = prior.mean[columns] + prior.std[columns] * deviation.double().numpy()
    return fresh


def misfit_stage(
    network: ConditionalPerceptron,
    inputs: FilmInputs,
    examples: DrawnFilms,
    good: DrawnFilms,
    noise: NoiseModel,
    config: FilmsConfig,
) -> TrainingStage:
    """Return the training of the misfit network. Half of the films of each batch have good presses.

    Args:
        network: The network.
        inputs: Inputs of the network.
        examples: Charges of every kind (`draw_misfit_films`); the last films are used for validation.
        good: Good presses (`draw_near_films`). In every step they get new noise, of up to `MAX_NOISE_FACTOR` times
            their standard deviation.
        noise: Noise of good presses.
        config: Number of steps and sizes of the batches.
    """
    values = inputs.values(as_tensor(examples.charge), examples.parameters)
    context = inputs.context(examples.parameters)
    targets = compress_length(torch.tensor(examples.target)).float()
    n_train = len(values) - max(1, round(MISFIT_VALIDATION_FRACTION * len(values)))
    n_charge = values.shape[1]
    good_charge = as_tensor(good.charge)
    projection = as_tensor(good.target)
    n_good_film, n_good_press = good_charge.shape[:2]

    def good_press_loss(n_film: int, n_press: int, random: torch.Generator) -> Tensor:
        films = torch.randint(n_good_film, (n_film,), generator=random)
        rows = torch.randint(n_good_press, (n_film, n_press), generator=random)
        clean = good_charge[films[:, None], rows]
        noise_factor = 1.0 + (MAX_NOISE_FACTOR - 1.0) * torch.rand((n_film, n_press, 1), generator=random) ** 3
        deviation = noise_factor * torch.randn(clean.shape, generator=random)
        noisy = clean + torch.hypot(torch.tensor(noise.white), noise.gain * clean) * deviation
        residual = (projection[films[:, None], rows] @ deviation[..., None])[..., 0]
        parameters = good.parameters[films.numpy()]
        vector = network(inputs.values(noisy, parameters), inputs.context(parameters))
        return mean_squared_distance(vector, compress_length(residual))

    def loss(_: int, random: torch.Generator) -> Tensor:
        n_film = config.batch_films // 2
        films = torch.randint(n_train, (n_film,), generator=random)
        rows = torch.randint(n_charge, (n_film, config.batch_presses), generator=random)
        vector = network(values[films[:, None], rows], context[films])
        example_loss = mean_squared_distance(vector, targets[films[:, None], rows])
        return GOOD_PRESS_WEIGHT * good_press_loss(n_film, config.batch_presses, random) + example_loss

    def score() -> tuple[float, str]:
        vector = network(values[n_train:], context[n_train:])
        example_loss = mean_squared_distance(vector, targets[n_train:]).item()
        random = torch.Generator().manual_seed(0)
        good_loss = good_press_loss(n_good_film, N_VALIDATION_PRESSES, random).item()
        text = f"{example_loss:.4f} on watched films, {good_loss:.5f} on good presses"
        return GOOD_PRESS_WEIGHT * good_loss + example_loss, text

    return TrainingStage("misfit", network, loss, score, config.misfit_steps, largest_gradient=LARGEST_GRADIENT)
