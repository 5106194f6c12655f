"""Training of a network on presses.

The contact perceptron learns the mean and the standard deviation of the contact by maximum likelihood, with fresh noise
on the charges in every step. In the first steps it learns the mean by least squares. If a teacher is given, it learns
the teacher's answers to these charges instead. The misfit perceptron learns from charges of many kinds, whose distance
from the nearest contact of the domain is computed beforehand.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import metadata

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from isocharge.common.errors import ConfigError
from isocharge.common.progress import second_thread
from isocharge.common.resumable_run import ResumableRun
from isocharge.serve.model.charge_series import FILE as CHARGES_FILE
from isocharge.simulate import Dataset
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.config import FitConfig, TrainingConfig
from isocharge.train.training.correlation import with_correlation
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.fitted import Fitted
from isocharge.train.training.losses import (
    CORRELATION_WEIGHT,
    correlation_loss,
    distillation_loss,
    validation_score,
    warm_up_loss,
    weighted_likelihood_loss,
    with_fresh_noise,
)
from isocharge.train.training.misfit_training import MisfitExamples, misfit_stage
from isocharge.train.training.network import (
    InverseNetwork,
    TrainablePerceptron,
    as_tensor,
    fold_network,
)
from isocharge.train.training.output_regression import fit_std
from isocharge.train.training.source import Teacher, TrainingData
from isocharge.train.training.split import Split

_log = logging.getLogger(__name__)

WARM_UP_FRACTION = 0.15
"""Fraction of the steps that use the warm-up loss, dimensionless."""

ROUNDED_FRACTION = 0.25
"""Number of steps after the hidden weights are rounded, relative to the number of steps before, dimensionless."""

N_STD_PRESSES = 60_000
"""Number of presses with noise to which the standard deviations of a trained network are fitted."""


def fit(source: Dataset | TrainingData, config: FitConfig | None = None, *, run: ResumableRun | None = None) -> Fitted:
    """Train a network on presses.

    A warning is logged if two contacts of the requested domain have the same charges.

    Args:
        source: A dataset, simulated or measured, or other training data, for example of a student.
        config: Sizes, steps, noise and seed; None for the defaults.
        run: Saves the state, so that an interrupted training can be continued.

    Returns:
        The trained network with everything that a release needs.

    Raises:
        ConfigError: If a setting is out of its range, or is for another number of electrodes.
        DatasetError: If a network cannot be trained on the presses.
        TrainingError: If the loss is not finite.
    """
    data = source if isinstance(source, TrainingData) else TrainingData.of(source)
    settings = (config or FitConfig()).checked()
    trained = train_network(data, settings, run=run)
    split = trained.split
    noise = settings.training.noise_model
    with threads_and_seed(settings.training.threads, settings.training.seed):
        network = fold_network(trained.network)
        if not split.train.measured:
            repeated = split.train[np.arange(max(N_STD_PRESSES, len(split.train))) % len(split.train)]
            network = fit_std(network, repeated.noisy(noise, settings.training.seed + 1), repeated.contact)
        network = with_correlation(network, split.train, noise, settings.training.seed)

    made_with: dict[str, object] = {"config": settings.to_dict(), "torch": torch.__version__}
    if split.cautions:
        made_with["cautions"] = list(split.cautions)
    if data.teacher is not None:
        made_with["teacher"] = data.teacher.label
    files = dict(data.provenance.files)
    if split.folded_charges is not None:
        files[CHARGES_FILE] = split.folded_charges.to_bytes()

    measured = data.presses.within(split.domain.radius)
    return Fitted(
        network=network,
        sensor=data.sensor,
        probes=data.probes,
        domain=split.domain,
        noise=noise,
        test=split.test if data.test is None else data.test,
        good=measured if data.presses.measured else split.test,
        sha256=data.sha256,
        provenance=replace(data.provenance, made_with=made_with | dict(data.provenance.made_with), files=files),
        requested_domain=data.domain,
        cautions=split.cautions,
        outside=trained.outside,
    )


def fit_identity(data: TrainingData, config: FitConfig) -> dict[str, object]:
    """Return everything that determines the weights, as the identity of a resumable run."""
    identity: dict[str, object] = {
        "dataset_sha256": data.sha256,
        "noise": config.training.noise_model.to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
    }
    if data.teacher is not None:
        identity["teacher_sha256"] = data.teacher.sha256
    return identity


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network in PyTorch, the presses that it was trained on, and the film outside the working area."""

    network: InverseNetwork
    split: Split
    outside: OutsidePresses | None


def train_network(data: TrainingData, config: FitConfig, *, run: ResumableRun | None = None) -> TrainedNetwork:
    """Train the contact perceptron and, at the same time in a second thread, the misfit perceptron.

    Args:
        data: Presses, and possibly a teacher.
        config: Sizes, steps, noise and seed.
        run: Saves the state, so that an interrupted training can be continued.

    Raises:
        ConfigError: If the configuration is for another number of electrodes.
        DatasetError: If a network cannot be trained on the presses.
        TrainingError: If the loss is not finite.
    """
    names = data.sensor.electrode_names
    expected = config.network.electrodes
    training = config.training
    if expected and expected != len(names):
        raise ConfigError(
            f"network.electrodes: the configuration is for {expected} electrodes, the dataset of "
            f"{data.sensor.name!r} has {len(names)} ({', '.join(names)}); use another dataset or leave the key out"
        )
    with threads_and_seed(training.threads, training.seed), second_thread() as executor:
        whole_film = None
        if not data.presses.measured:
            whole_film = executor.submit(OutsidePresses.of, data.sensor, data.probes, data.domain.force_range)
        split = Split.of(data, training)
        for caution in split.cautions:
            _log.warning("%s", caution)
        features = split.features(misfit_noise(training.noise_model))
        network = InverseNetwork(split.domain, features, config.network)
        examples = MisfitExamples(split, features, training, run)
        inner_examples = examples.inner()

        def train_misfit() -> OutsidePresses | None:
            """Train the misfit perceptron, and return the film outside the working area if it is simulated."""
            simulated = whole_film.result() if whole_film is not None else None
            outside = simulated.beyond(split.domain.radius) if simulated is not None else None
            all_examples = examples.with_outside(inner_examples, outside)
            train_perceptron(misfit_stage(network, all_examples, training), network.misfit_vector, config, run)
            return outside

        misfit_training = executor.submit(train_misfit)
        contact = contact_stage(network, split.train, split.validation, training.noise_model, training, data.teacher)
        train_perceptron(contact, network.contact, config, run)
        outside = misfit_training.result()
    return TrainedNetwork(network.eval(), split, outside)


@contextmanager
def threads_and_seed(count: int, seed: int) -> Iterator[None]:
    """Set the seed and the number of threads of PyTorch in a block, and restore the caller's values after it.

    BLAS and OpenMP get the same number of threads. Their threads wait actively at barriers, so a busy second core would
    make them many times slower.

    Args:
        count: Number of threads.
        seed: Seed of the random numbers.
    """
    previous_count = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(previous_count)


def train_perceptron(
    stage: TrainingStage, perceptron: TrainablePerceptron, config: FitConfig, run: ResumableRun | None
) -> None:
    """Train a perceptron; with 8-bit weights, round its hidden weights and then train the other weights further.

    Args:
        stage: Loss, validation score and number of steps.
        perceptron: The perceptron of the stage.
        config: Form of the weights, learning rate, patience and seed.
        run: Saves the state, so that an interrupted training can be continued.
    """
    settings = config.training
    Descent(stage, settings.learning_rate, settings.patience, settings.seed).run(run)
    if config.network.weights != "int8":
        return
    perceptron.round_hidden_matrices()
    rounded_stage = replace(
        stage,
        name=f"{stage.name}-rounded",
        loss=lambda step, random: stage.loss(stage.steps + step, random),
        steps=round(ROUNDED_FRACTION * stage.steps),
        warm_up_steps=0,
    )
    Descent(rounded_stage, settings.learning_rate, settings.patience, settings.seed).run(run)


def contact_stage(
    network: InverseNetwork,
    train: LabelledPresses,
    validation: LabelledPresses,
    noise: Noise,
    config: TrainingConfig,
    teacher: Teacher | None = None,
) -> TrainingStage:
    """Return the training of the contact perceptron on charges with fresh noise.

    The linear part of the perceptron is fitted at once.

    Args:
        network: The network, whose contact perceptron is trained.
        train: Presses for training.
        validation: Presses for early stopping.
        noise: Noise that is added to the charges in every step.
        config: Number of steps, batch size and seed.
        teacher: Model whose answers are learned; None to learn the contacts of the presses.
    """
    domain = network.domain
    warm_up_steps = round(WARM_UP_FRACTION * config.steps)
    charge = as_tensor(train.charge)
    target = as_tensor(domain.to_unit(train.contact))
    validation_charge = as_tensor(validation.charge if validation.measured else validation.noisy(noise, config.seed))
    validation_target = as_tensor(domain.to_unit(validation.contact))
    batch = min(config.batch, len(charge))
    noisy_charge = with_fresh_noise(charge, noise, torch.Generator().manual_seed(config.seed))
    network.contact.fit_linear_part(network.inputs(noisy_charge), target)

    def loss(step: int, random: torch.Generator) -> Tensor:
        """Return the loss of a random batch with new noise. It is the warm-up loss in the first steps."""
        rows = torch.randint(len(charge), (batch,), generator=random)
        noisy = with_fresh_noise(charge[rows], noise, random)
        mean, log_std, angles = network.posterior_with_angles(noisy)
        is_warm_up = step < warm_up_steps
        deviation = (target[rows] - mean) * torch.exp(-log_std)
        angle_loss = CORRELATION_WEIGHT * correlation_loss(angles, deviation)
        if teacher is None:
            if is_warm_up:
                return warm_up_loss(mean, log_std, target[rows])
            return weighted_likelihood_loss(mean, log_std, target[rows]) + angle_loss
        teacher_mean, teacher_log_std = teacher.posterior(noisy, domain)
        if is_warm_up:
            return warm_up_loss(mean, log_std, teacher_mean)
        return distillation_loss(mean, log_std, teacher_mean, teacher_log_std) + angle_loss

    def score() -> tuple[float, str]:
        """Return the loss on the validation presses, and a text with the errors."""
        mean, log_std = network.posterior(validation_charge)
        return validation_score(mean, log_std, validation_target, domain, "presses")

    return TrainingStage(
        "contact",
        network.contact,
        loss,
        score,
        config.steps,
        warm_up_steps,
        slow_parameters=(network.contact.skip.weight,),
    )
