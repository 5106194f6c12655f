"""Training of a network on presses.

The contact perceptron learns the mean and the covariance of the contact, with fresh noise on the charges in every step.
The misfit perceptron learns residuals, which are computed before the training. The residual of a set of charges is its
difference from the charges of the nearest contact.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from isocharge.common.defaults import FEW_ELECTRODES
from isocharge.common.progress import second_thread
from isocharge.serve.model.charge_file import FILE as CHARGES_FILE
from isocharge.serve.model.charge_file import charge_map_bytes
from isocharge.simulate import Dataset
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.config import FitConfig, TrainingConfig
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.fitted import Fitted, Provenance
from isocharge.train.training.linear_targets import LinearTargets
from isocharge.train.training.losses import contact_loss, fresh_noise
from isocharge.train.training.misfit_training import misfit_examples, misfit_stage
from isocharge.train.training.network import InverseNetwork, TrainablePerceptron, as_tensor, fold_network
from isocharge.train.training.source import TrainingData
from isocharge.train.training.split import Split

_log = logging.getLogger(__name__)

LINEAR_TARGET_FRACTION = 0.7
"""Fraction of the steps in which the network of a sensor with more than `FEW_ELECTRODES` electrodes learns from linear
targets. With three and four electrodes, these targets do not reduce the errors."""

ROUNDED_FRACTION = 0.25
"""Number of steps after the hidden weights are rounded, relative to the number of steps before, dimensionless."""


def fit(source: Dataset | TrainingData, config: FitConfig | None = None) -> Fitted:
    """Train a network on presses, and fold it into the form of a release.

    A warning is logged if two contacts of the requested domain have the same charges.

    Args:
        source: A simulated dataset, or other training data.
        config: Sizes, steps, noise and seed; None for the defaults.

    Returns:
        The trained network with everything that a release needs.

    Raises:
        ConfigError: If a setting is out of its range.
        DatasetError: If a network cannot be trained on the presses.
        TrainingError: If the loss is not finite.
    """
    data = source if isinstance(source, TrainingData) else TrainingData.of(source)
    n_electrode = len(data.sensor.electrode_names)
    checked_config = (config or FitConfig()).checked()
    settings = checked_config.for_electrodes(n_electrode)
    trained = train_network(data, settings)

    split = trained.split
    return Fitted(
        network=fold_network(trained.network),
        sensor=data.sensor,
        probes=data.probes,
        domain=split.domain,
        noise=settings.training.noise_model,
        test=split.test,
        sha256=data.sha256,
        provenance=_provenance(split, settings),
        cautions=split.cautions,
        outside=trained.outside,
        yield_force_N=data.yield_force_N,
    )


def _provenance(split: Split, config: FitConfig) -> Provenance:
    """Return the settings and the cautions of a training, and the series of the charges if the map folds.

    Args:
        split: Series of the charges, and cautions about the network.
        config: Settings of the training.
    """
    made_with: dict[str, object] = {"config": config.to_dict(), "torch": torch.__version__}
    if split.cautions:
        made_with["cautions"] = list(split.cautions)
    files = {}
    if split.folded_charges is not None:
        files[CHARGES_FILE] = charge_map_bytes(split.folded_charges)
    return Provenance(made_with, files)


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network in PyTorch, the presses of its training, and the presses outside the working area."""

    network: InverseNetwork
    split: Split
    outside: OutsidePresses | None


def train_network(data: TrainingData, config: FitConfig) -> TrainedNetwork:
    """Train the contact perceptron and the misfit perceptron at the same time, in two threads.

    The misfit perceptron is trained on examples from the working area and from the rest of the film.

    Args:
        data: Presses.
        config: Sizes, steps, noise and seed.

    Raises:
        DatasetError: If a network cannot be trained on the presses.
        TrainingError: If the loss is not finite.
    """
    training = config.training
    with threads_and_seed(training.threads, training.seed), second_thread() as executor:
        split = Split.by_position(data, training)
        for caution in split.cautions:
            _log.warning("%s", caution)
        features = split.features(misfit_noise(training.noise_model))
        network = InverseNetwork(split.domain, features, config.network)
        outside = OutsidePresses.of(split.domain, data.presses, data.outside, training.seed)

        def train_misfit() -> None:
            """Train the misfit perceptron on examples from the working area and from the rest of the film."""
            examples = misfit_examples(split, features, outside, training)
            train_perceptron(misfit_stage(network, examples, training), network.misfit_vector, config)

        # Second thread: train the misfit perceptron. This thread: train the contact perceptron
        misfit_training = executor.submit(train_misfit)
        linear_targets = None
        has_many_electrodes = network.n_electrode > FEW_ELECTRODES
        if has_many_electrodes and training.noise_model.white > 0.0:
            linear_targets = LinearTargets.compute(split.train, split.field, training.noise_model)
        stage = contact_stage(network, split.train, training.noise_model, training, linear_targets=linear_targets)
        train_perceptron(stage, network.contact, config)
        misfit_training.result()
    return TrainedNetwork(network.eval(), split, outside)


@contextmanager
def threads_and_seed(count: int, seed: int) -> Iterator[None]:
    """Set the seed and the number of threads of PyTorch for a `with` block (context manager).

    BLAS and OpenMP get the same number of threads. After the block, the previous values are restored. The number of
    threads is limited because the threads of these libraries wait for each other without sleeping. If another program
    used a core, the libraries would be many times slower.

    Args:
        count: Number of threads.
        seed: Seed of the random numbers.
    """
    previous_count = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        # `fork_rng` restores the random state after the block; without devices, only that of the CPU.
        with threadpool_limits(count), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(previous_count)


def train_perceptron(stage: TrainingStage, perceptron: TrainablePerceptron, config: FitConfig) -> None:
    """Train a perceptron. If the configuration requires it, also round the hidden weights to 8 bits.

    After the rounding, the other weights are trained further, with the loss of the last step.

    Args:
        stage: Loss and number of steps.
        perceptron: The perceptron of the stage.
        config: Form of the weights.
    """
    stage.run()
    if config.network.weights != "int8":
        return

    perceptron.round_hidden_matrices()

    def last_loss(_: float, random: torch.Generator) -> Tensor:
        """Return the loss at the end of the training."""
        return stage.loss(1.0, random)

    replace(stage, loss=last_loss, steps=round(ROUNDED_FRACTION * stage.steps)).run()


def contact_stage(
    network: InverseNetwork,
    train: LabelledPresses,
    noise: Noise,
    config: TrainingConfig,
    *,
    linear_targets: LinearTargets | None = None,
) -> TrainingStage:
    """Define the training of the contact perceptron on charges with fresh noise.

    If there are linear targets, the
    mean of the network learns from them during the first `LINEAR_TARGET_FRACTION` of the steps. Later, or without
    linear targets, it learns from the true contacts. The
    covariance always learns from the errors.

    Args:
        network: The network, whose contact perceptron is trained.
        train: Presses for training.
        noise: Noise that is added to the charges in every step.
        config: Number of steps, batch size, learning rate and seed.
        linear_targets: Targets of the presses of `train` for the first steps; None to use only the contacts.
    """
    domain = network.domain
    charge = as_tensor(train.charge)
    unit_contact = as_tensor(domain.to_unit(train.contact))
    batch = min(config.batch, len(charge))

    def loss(progress: float, random: torch.Generator) -> Tensor:
        """Return the loss of a random batch with new noise.

        Args:
            progress: Fraction of completed steps.
            random: Random number generator of the batch and of its noise.
        """
        rows = torch.randint(len(charge), (batch,), generator=random)
        contact = unit_contact[rows]
        if linear_targets is not None and progress < LINEAR_TARGET_FRACTION:
            noisy_batch, target, noise_factor = linear_targets.draw(rows, random)
            posterior = network.posterior(noisy_batch)
            # The errors are proportional to the noise. The division by the factor gives the errors that charges with
            # their usual noise would cause.
            return contact_loss(posterior, target, (contact - posterior.mean) / noise_factor)

        noisy_batch = charge[rows] + fresh_noise(charge[rows], noise, random)
        posterior = network.posterior(noisy_batch)
        return contact_loss(posterior, contact, contact - posterior.mean)

    sizes = config.sizes(network.n_electrode)
    rate = config.learning_rate * sizes.rate_factor
    return TrainingStage("contact", network.contact, loss, sizes.steps, rate, config.seed)
