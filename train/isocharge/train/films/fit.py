"""Training of one network for all films that a prior describes."""

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
from isocharge.common.progress import second_thread
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
from isocharge.train.training.network import as_tensor, compress_length, limit_log_std

RADIUS_MARGIN = 1.5
"""Distance by which the forward maps reach beyond the radius of the domain, mm.

A calibration needs this margin, because it moves presses whose position is uncertain.
"""

FORCE_MARGINS = (0.8, 1.2)
"""Ratios of the smallest and the largest force of the forward maps to those of the domain."""

LARGEST_GRADIENT = 5.0
"""Norm to which larger gradients are scaled. Such gradients occur on films whose map nearly folds."""

MAX_NOISE_FACTOR = 8.0
"""Largest factor by which the noise of good presses is multiplied in the training of the misfit network."""

GOOD_PRESS_WEIGHT = 10.0
"""Weight of good presses in the loss of the misfit network.

Good presses determine the rate of false alarms. Their misfits and therefore their losses are small, so that they need a
large weight.
"""

MISFIT_VALIDATION_FRACTION = 0.06
"""Fraction of the films with charges of every kind that are used for the validation of the misfit network."""

N_VALIDATION_PRESSES = 8
"""Number of good presses of each film in the validation of the misfit network."""


@dataclass(frozen=True)
class FilmsConfig:
    """Settings for training a network for all films.

    Attributes:
        radius: Largest distance of a press from the film's centre, mm.
        force_range: Smallest and largest force, N.
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the hidden layers of the misfit network. Both networks have the same number of layers.
        activation: Name of the activation of the hidden layers (`isocharge.common.activations`).
        films: Number of films for the contact network, including those for validation.
        presses: Number of presses on each film, for the contact network and for the good presses of the misfit network.
        watched: Number of films of `films` that are used for the validation of the contact network.
        steps: Number of optimiser steps of the contact network.
        misfit_films: Number of films with charges of every kind for the misfit network.
        misfit_charges: Number of sets of charges on each of the `misfit_films`.
        near_films: Number of films with good presses for the misfit network.
        misfit_steps: Number of optimiser steps of the misfit network.
        batch_films: Number of films in a batch.
        batch_presses: Number of presses on each film of a batch.
        learning_rate: Largest learning rate of the optimiser SOAP.
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
    steps: int = 8_000
    misfit_films: int = 320
    misfit_charges: int = 160
    near_films: int = 768
    misfit_steps: int = 4_000
    batch_films: int = 32
    batch_presses: int = 64
    learning_rate: float = 3e-3
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
    """Train a network for all films that a prior describes.

    First, the forward maps of the films are simulated, and films are drawn from the prior. A second thread then trains
    the contact perceptron with presses on these films. At the same time, the calling thread draws charges of every
    kind, draws good presses, and trains the misfit perceptron with both.

    Args:
        prior: Distribution of the films: the described sensor, the probe and the standard deviations of the parameters.
        config: Settings of the training.
        executor: Executor for the solves, the presses and the searches; None for this process.
        run: Run that saves the state, so that an interrupted training can be continued; None to save nothing.

    Returns:
        The network for all films, from which the network of each film is computed.

    Raises:
        InputError: If the noise model is unknown.
        SceneError: If the force, the radius or the probe is impossible for one of the films.
        SolveError: If a press has no equilibrium, or the forward maps are not accurate enough.
        DatasetError: If too many presses have a charge that is zero or negative.
        TrainingError: If the loss is not finite.
    """
    noise = noise_model(config.noise)  # an unknown name raises before the long computation

    def saving_executor(name: str) -> Executor | None:
        """Return an executor that saves the results of its tasks in the run. Without a run, return `executor`."""
        return executor if run is None else run.storing_executor(name, executor)

    with threads_and_seed(1, config.seed), second_thread() as thread_executor:
        domain = Domain(config.radius, config.force_range)
        family = _build_family(prior, config, saving_executor("family"))
        presses = draw_film_presses(
            prior, family, domain, config.films, config.presses, config.seed, saving_executor("presses")
        )
        inputs = FilmInputs.fit(FilmScaling(prior, domain), presses)
        activation = ACTIVATIONS[config.activation]
        n_electrode = inputs.mean.size
        contact_perceptron = _new_perceptron(inputs, config.hidden, N_CONTACT_ANSWERS, activation)
        misfit_perceptron = _new_perceptron(inputs, config.misfit_hidden, n_electrode, activation)

        # Second thread: train the contact perceptron
        contact_training = thread_executor.submit(
            _train_stage, contact_stage(contact_perceptron, inputs, presses, noise, config), config, run
        )

        # This thread: draw the examples for the misfit perceptron, and train it
        source = FilmsSource(prior, family, domain, misfit_noise(noise))
        examples = draw_misfit_films(
            source, config.misfit_films, config.misfit_charges, config.seed, saving_executor("nearest-contacts")
        )
        good_presses = draw_near_films(
            source, config.near_films, config.presses, config.seed, saving_executor("good-presses")
        )
        _train_stage(misfit_stage(misfit_perceptron, inputs, examples, good_presses, source.noise, config), config, run)
        contact_training.result()  # waits for the second thread, and raises its exception
    return FilmsModel(
        family=family,
        scaling=inputs.scaling,
        mean=inputs.mean,
        whitening=inputs.whitening,
        contact=ConditionalWeights(contact_perceptron.to_arrays(), activation),
        misfit=ConditionalWeights(misfit_perceptron.to_arrays(), activation),
        noise=noise,
        made_with={"config": config.to_dict(), "torch": torch.__version__},
    )


def films_identity(prior: FilmPrior, config: FilmsConfig) -> dict[str, Any]:
    """Return all settings that determine the weights of a network. The settings identify a run that can be resumed."""
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
    """Simulate the forward maps of all films of a prior, including the effects of imperfections.

    Args:
        prior: Distribution of the films.
        config: Radius and range of forces, to which margins are added.
        executor: Executor of the simulations; None for this process.

    Returns:
        The family of forward maps, whose numbers are rounded as in a films file.
    """
    min_force, max_force = config.force_range
    min_factor, max_factor = FORCE_MARGINS
    force_range = (min_force * min_factor, max_force * max_factor)
    family = FilmFamily.build(prior, config.radius + RADIUS_MARGIN, force_range, executor=executor)
    modes = FilmModes.build(family, prior.sensor.film, executor)
    family_with_modes = replace(family, imperfections=modes)
    # The arrays for the file have fewer digits, and the network is trained on the rounded maps.
    return FilmFamily.from_arrays(family_with_modes.to_arrays())


def _new_perceptron(
    inputs: FilmInputs, hidden: tuple[int, ...], n_output: int, activation: Activation
) -> ConditionalPerceptron:
    """Return an untrained perceptron for all films."""
    n_context = inputs.scaling.statistics.mean.size
    return ConditionalPerceptron(inputs.mean.size, hidden, n_output, n_context, activation)


def _train_stage(stage: TrainingStage, config: FilmsConfig, run: ResumableRun | None) -> None:
    """Train one of the two networks, the contact network or the misfit network, for all steps of its stage.

    The training does not stop early, because the loss is smallest after the last steps of the schedule.
    """
    Descent(stage, config.learning_rate, stage.steps, config.seed).run(run)


class _Batch(NamedTuple):
    """Estimated contacts, logarithms of their standard deviations, and true contacts, each of shape (n, 3).

    All values are in unit coordinates.
    """

    mean: Tensor
    log_std: Tensor
    target: Tensor


def contact_stage(
    network: ConditionalPerceptron, inputs: FilmInputs, presses: FilmPresses, noise: NoiseModel, config: FilmsConfig
) -> TrainingStage:
    """Return the stage that trains the contact network.

    Args:
        network: The contact network, whose weights the training changes.
        inputs: Computation of the inputs from charges.
        presses: Presses on films; the last `config.watched` films are used for validation.
        noise: Noise that is added to the charges in every step.
        config: Settings of the training.
    """
    training = _ContactTraining(network, inputs, presses, noise, config)
    return TrainingStage(
        "contact",
        network,
        training.loss,
        training.score,
        config.steps,
        training.warm_up_steps,
        largest_gradient=LARGEST_GRADIENT,
    )


@dataclass(frozen=True, eq=False)
class _ContactTraining:
    """Loss and validation of the contact network. The attributes are the arguments of `contact_stage`."""

    network: ConditionalPerceptron
    inputs: FilmInputs
    presses: FilmPresses
    noise: NoiseModel
    config: FilmsConfig

    @property
    def warm_up_steps(self) -> int:
        """Number of steps with the warm-up loss."""
        return round(WARM_UP_FRACTION * self.config.steps)

    @property
    def n_train(self) -> int:
        """Number of films for the training. The remaining films are used for validation."""
        return len(self.presses) - self.config.watched

    def loss(self, step: int, random: torch.Generator) -> Tensor:
        """Compute the loss of a random batch. The values of d31, d32 and the gains of the films are drawn again.

        The first `warm_up_steps` steps use the warm-up loss, and the other steps use the likelihood loss.

        Args:
            step: Number of the step.
            random: Random number generator.
        """
        config = self.config
        n_press = self.presses.contact.shape[1]
        film_rows = torch.randint(self.n_train, (config.batch_films,), generator=random).numpy()
        press_rows = torch.randint(n_press, (config.batch_films, config.batch_presses), generator=random).numpy()
        prior = self.inputs.scaling.prior
        parameters = _redraw_piezo_and_gains(prior, self.presses.parameters[film_rows], random)
        batch = self.evaluate_batch(film_rows, press_rows, parameters, random)
        loss_function = warm_up_loss if step < self.warm_up_steps else likelihood_loss
        return loss_function(*batch)

    def score(self) -> tuple[float, str]:
        """Return the loss on the validation films, and a text that states the errors.

        The noise of the charges is the same in every call.
        """
        film_rows = np.arange(self.n_train, len(self.presses))
        n_press = self.presses.contact.shape[1]
        all_press_rows = np.tile(np.arange(n_press), (len(film_rows), 1))  # all presses on each of these films
        random = torch.Generator().manual_seed(self.config.seed)
        batch = self.evaluate_batch(film_rows, all_press_rows, self.presses.parameters[film_rows], random)
        return validation_score(*batch, self.inputs.scaling.domain, "films")

    def evaluate_batch(
        self, film_rows: np.ndarray, press_rows: np.ndarray, parameters: Array, random: torch.Generator
    ) -> _Batch:
        """Add noise to the charges of presses, and evaluate the network on the noisy charges.

        Args:
            film_rows: Rows of the films in `presses`, shape (n_film,).
            press_rows: Rows of the presses on each film, shape (n_film, n_row).
            parameters: Parameters of the films, shape (n_film, n_parameter). They can differ from those in `presses` in
                d31, d32 and the gains.
            random: Generator of the noise.

        Returns:
            Estimated and true contacts of all presses of the batch.
        """
        # The index arrays have the shapes (n_film, 1) and (n_film, n_row), and select n_row presses of each film.
        film_column = film_rows[:, None]
        contact = self.presses.contact[film_column, press_rows]
        charge_parts = self.presses.charge_parts[film_column, press_rows]
        charge = as_tensor(FilmPresses(parameters, contact, charge_parts).charge())
        noisy_charge = with_fresh_noise(charge, self.noise, random)
        outputs = self.network(self.inputs.values(noisy_charge, parameters), self.inputs.context(parameters))

        # The network answers in the axes of the electrodes. Rotate and shift its answers into the axes of the film.
        scaling = self.inputs.scaling
        rotation = as_tensor(scaling.rotation(parameters))
        offset = as_tensor(scaling.offset(parameters))
        # baddbmm(o, u, T') computes o + u T' for each film, with one press in each row of u
        mean = torch.baddbmm(offset[:, None], outputs[..., MEAN], rotation.transpose(1, 2))
        target = as_tensor(scaling.domain.to_unit(contact.reshape(-1, 3).astype(float)))
        flat_mean = mean.reshape(-1, 3)
        log_std = limit_log_std(outputs[..., LOG_STD].reshape(-1, 3), flat_mean, scaling.domain)
        return _Batch(flat_mean, log_std, target)


def _redraw_piezo_and_gains(prior: FilmPrior, parameters: Array, random: torch.Generator) -> Array:
    """Draw new values of d31, d32 and the gains from the prior, and return the changed parameters of the films.

    The charges for the new values follow from the stored parts of the charges, so that no simulation is needed.

    Args:
        prior: Distribution of the films.
        parameters: Parameters of the films, shape (n_film, n_parameter).
        random: Random number generator.

    Returns:
        Parameters with the new values, same shape.
    """
    gain_columns = range(len(SHARED), parameters.shape[1])  # the gains follow the shared parameters of a film
    columns = [D31, D32, *gain_columns]
    # Deviations from the mean in standard deviations, which are limited to the bounds of the parameters
    deviation = torch.randn((len(parameters), len(columns)), generator=random).clamp(-MAX_DEVIATION, MAX_DEVIATION)
    new_parameters = parameters.copy()
    new_parameters[:, columns] = prior.mean[columns] + prior.std[columns] * deviation.double().numpy()
    return new_parameters


def misfit_stage(
    network: ConditionalPerceptron,
    inputs: FilmInputs,
    examples: DrawnFilms,
    good_presses: DrawnFilms,
    noise: NoiseModel,
    config: FilmsConfig,
) -> TrainingStage:
    """Return the stage that trains the misfit network.

    Half of the films of each batch have good presses, and the other half have charges of every kind.

    Args:
        network: The misfit network, whose weights the training changes.
        inputs: Computation of the inputs from charges.
        examples: Charges of every kind (`draw_misfit_films`); the last films are used for validation.
        good_presses: Good presses (`draw_near_films`). In every step, they get new noise with up to `MAX_NOISE_FACTOR`
            times the standard deviation of `noise`.
        noise: Noise of good presses.
        config: Settings of the training.
    """
    training = _MisfitTraining(network, inputs, examples, good_presses, noise, config)
    return TrainingStage(
        "misfit", network, training.loss, training.score, config.misfit_steps, largest_gradient=LARGEST_GRADIENT
    )


class _MisfitTraining:
    """Loss and validation of the misfit network.

    The loss of the misfit network is a weighted sum of two losses. The first loss is that of the examples, whose
    residuals were found by a search. The second loss is that of good presses, whose residuals are computed from their
    noise.
    """

    def __init__(
        self,
        network: ConditionalPerceptron,
        inputs: FilmInputs,
        examples: DrawnFilms,
        good_presses: DrawnFilms,
        noise: NoiseModel,
        config: FilmsConfig,
    ) -> None:
        """Compute the inputs and the targets of the examples from their charges and residuals.

        Args:
            network: The misfit network.
            inputs: Computation of the inputs from charges.
            examples: Charges of every kind and their residuals. The last films are used for validation.
            good_presses: Good presses and the projections that compute their residuals.
            noise: Noise of good presses.
            config: Settings of the training.
        """
        self.network = network
        self.inputs = inputs
        self.good_presses = good_presses
        self.noise = noise
        self.config = config
        self.example_inputs = inputs.values(as_tensor(examples.charge), examples.parameters)
        self.example_context = inputs.context(examples.parameters)
        # The network learns residual vectors with compressed lengths: large lengths count on a logarithmic scale.
        self.example_targets = compress_length(torch.tensor(examples.target)).float()
        self.good_charge = as_tensor(good_presses.charge)
        self.good_projection = as_tensor(good_presses.target)
        n_example_film = len(self.example_inputs)
        n_validation = max(1, round(MISFIT_VALIDATION_FRACTION * n_example_film))  # at least one film
        self.n_train = n_example_film - n_validation

    def loss(self, step: int, random: torch.Generator) -> Tensor:
        """Compute the loss of random examples plus the weighted loss of random good presses.

        Args:
            step: Number of the step, which has no influence.
            random: Random number generator.
        """
        del step
        n_film = self.config.batch_films // 2  # the other half of the films have good presses
        n_press = self.config.batch_presses
        n_charge = self.example_inputs.shape[1]
        film_rows = torch.randint(self.n_train, (n_film,), generator=random)
        charge_rows = torch.randint(n_charge, (n_film, n_press), generator=random)
        film_column = film_rows[:, None]  # with `charge_rows`, it selects n_press sets of charges of each film
        misfit_vector = self.network(self.example_inputs[film_column, charge_rows], self.example_context[film_rows])
        example_loss = mean_squared_distance(misfit_vector, self.example_targets[film_column, charge_rows])
        return GOOD_PRESS_WEIGHT * self.good_press_loss(n_film, n_press, random) + example_loss

    def score(self) -> tuple[float, str]:
        """Return the loss on validation examples and good presses, and a text that states both parts of the loss.

        The good presses are those of the training, but their noise is not that of the training. The noise is the same
        in every call. The loss on good presses is therefore smaller than on new films. It is only used to compare the
        steps of one training, and is not stored. The misfits that a released model states are measured on new presses.
        """
        validation = slice(self.n_train, None)
        misfit_vector = self.network(self.example_inputs[validation], self.example_context[validation])
        example_loss = mean_squared_distance(misfit_vector, self.example_targets[validation]).item()
        random = torch.Generator().manual_seed(0)
        good_loss = self.good_press_loss(len(self.good_charge), N_VALIDATION_PRESSES, random).item()
        description = f"{example_loss:.4f} on watched films, {good_loss:.5f} on good presses"
        return GOOD_PRESS_WEIGHT * good_loss + example_loss, description

    def good_press_loss(self, n_film: int, n_press: int, random: torch.Generator) -> Tensor:
        """Draw good presses at random, add new noise to their charges, and compute their loss.

        The loss compares the outputs of the network with the residuals of the charges, after large residuals are
        compressed to a logarithmic scale. A residual is the difference between a noisy charge and the charge of the
        nearest contact, in standard deviations of the noise.

        The noise of each press is multiplied by a random factor from 1 to `MAX_NOISE_FACTOR`, because the network also
        has to learn larger misfits.

        Args:
            n_film: Number of films.
            n_press: Number of presses on each film.
            random: Random number generator.
        """
        n_good_film, n_good_press = self.good_charge.shape[:2]
        film_rows = torch.randint(n_good_film, (n_film,), generator=random)
        press_rows = torch.randint(n_good_press, (n_film, n_press), generator=random)
        film_column = film_rows[:, None]  # with `press_rows`, it selects n_press presses of each film
        charge = self.good_charge[film_column, press_rows]

        # The third power of the random number makes small factors more frequent than large ones.
        noise_factor = 1.0 + (MAX_NOISE_FACTOR - 1.0) * torch.rand((n_film, n_press, 1), generator=random) ** 3
        deviation = noise_factor * torch.randn(charge.shape, generator=random)  # in standard deviations of the noise
        noise_std = torch.hypot(torch.tensor(self.noise.white), self.noise.gain * charge)
        noisy_charge = charge + noise_std * deviation

        # The target is the residual, which is the part of the noise that no change of the contact explains.
        deviation_column = deviation[..., None]  # column vectors, shape (n_film, n_press, n_electrode, 1)
        residual = (self.good_projection[film_column, press_rows] @ deviation_column)[..., 0]

        # The network learns the residuals with compressed lengths: large lengths count on a logarithmic scale.
        parameters = self.good_presses.parameters[film_rows.numpy()]
        misfit_vector = self.network(self.inputs.values(noisy_charge, parameters), self.inputs.context(parameters))
        return mean_squared_distance(misfit_vector, compress_length(residual))
