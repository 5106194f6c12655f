"""Training of a network on presses.

The contact perceptron learns the mean and the covariance of the contact, with fresh noise on the charges in every step.
The misfit perceptron learns residuals, which are computed before the training. The residual of a set of charges is its
difference from the charges of the nearest contact.
"""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.progress import second_thread
from isocharge.serve.model.charge_file import FILE as CHARGES_FILE
from isocharge.serve.model.charge_file import charge_map_bytes
from isocharge.simulate import Dataset, Domain
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.channel_noise import Noise, misfit_noise
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.config import FitConfig
from isocharge.train.training.contact_training import contact_stage, refit_covariance
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.folded_network import FoldedNetwork
from isocharge.train.training.misfit_training import misfit_examples, misfit_stage
from isocharge.train.training.network import InverseNetwork, fold_network
from isocharge.train.training.training_data import Split, TrainingData


class Answers(NamedTuple):
    """Contacts, standard deviations and misfits that a network estimates from the charges of n presses.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        std: Standard deviations of the contacts, shape (n, 3), mm and N.
        misfit: Misfits, shape (n, 1), in standard deviations of the noise.
    """

    contact: Array
    std: Array
    misfit: Array


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A trained network, the presses of its training, and the conditions for which it was trained.

    Attributes:
        network: The network in NumPy.
        sensor: Description of the sensor for the metadata, which contains at least its name.
        electrodes: Names of the electrodes, in the order of the charges.
        probes: Notations of the probes.
        domain: Contacts for which the network was trained.
        noise: Noise for which the network was trained.
        test: Presses for measuring errors. The network was trained on other presses, unless `cross_validated` is given.
        sha256: Checksum of the training data.
        made_with: Entries that the metadata of a release contain in addition to the usual entries. The additional
            entries may be `cautions`, a list of sentences for users, and `constant_force` if the network always returns
            the same force.
        files: Contents of additional files in the version folder of a release, by file name.
        description: Sections in Markdown that the card of a release contains before the errors; empty for none.
        cross_validated: Answers to the charges of `test` by networks that were not trained on these presses; None if
            `network` itself was not trained on these presses.
        outside: Presses outside the working area; None if they were not simulated.
        yield_force_N: Force at which the film yields at the centre under the sharpest of the probes, N. None if the
            force is unknown or above the range of forces.
    """

    network: FoldedNetwork
    sensor: Mapping[str, Any]
    electrodes: tuple[str, ...]
    probes: tuple[str, ...]
    domain: Domain
    noise: Noise
    test: LabelledPresses
    sha256: str
    made_with: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)
    description: str = ""
    cross_validated: Answers | None = None
    outside: OutsidePresses | None = None
    yield_force_N: float | None = None

    def predict(self, charge: Array) -> Answers:
        """Estimate the contacts of presses from their charges, shape (n, n_electrode), pC."""
        contact, std, _, misfit = self.network.outputs(charge)
        return Answers(contact, std, misfit)


_log = logging.getLogger(__name__)


ROUNDED_FRACTION = 0.25
"""Number of steps after the rounding of the hidden weights, relative to the number of steps before the rounding."""


def fit(source: Dataset | TrainingData, config: FitConfig | None = None) -> Fitted:
    """Train a network on presses, and convert it to the form in which networks are released.

    The contact perceptron and the misfit perceptron are trained at the same time, in two threads. The misfit perceptron
    is trained on examples from the working area and from the rest of the film. A warning is logged if two contacts of
    the requested domain have the same charges.

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
    settings = (config or FitConfig()).checked().for_electrodes(len(data.sensor.electrode_names))
    training = settings.training
    with threads_and_seed(training.threads, training.seed), second_thread() as executor:
        split = Split.by_position(data, training)
        for caution in split.cautions:
            _log.warning("%s", caution)
        features = split.features(misfit_noise(training.noise_model))
        network = InverseNetwork(split.domain, features, split.train.charge, settings.network)
        outside = OutsidePresses.of(split.domain, data.presses, data.outside, training.seed)

        def train_misfit() -> None:
            """Train the misfit perceptron on examples from the working area and from the rest of the film."""
            examples = misfit_examples(split, features, outside, training)
            train_perceptron(misfit_stage(network, examples, training), settings)

        # Second thread: train the misfit perceptron. This thread: train the contact perceptron
        misfit_training = executor.submit(train_misfit)
        stage = contact_stage(network, split.train, training.noise_model, training)
        train_perceptron(stage, settings)
        refit_covariance(network, split.train, training.noise_model)
        misfit_training.result()

    made_with: dict[str, object] = {"config": settings.to_dict()}  # for the metadata of the model
    if split.cautions:
        made_with["cautions"] = list(split.cautions)
    files = {}
    if split.folded_charges is not None:  # the map from contacts to charges folds
        files[CHARGES_FILE] = charge_map_bytes(split.folded_charges)
    # `fold_network` includes the scaling of inputs and outputs in the layers.
    return Fitted(
        network=fold_network(network),
        sensor=sensor_to_dict(data.sensor),
        electrodes=data.sensor.electrode_names,
        probes=data.probes,
        domain=split.domain,
        noise=training.noise_model,
        test=split.test,
        sha256=data.sha256,
        made_with=made_with,
        files=files,
        outside=outside,
        yield_force_N=data.yield_force_N,
    )


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
        # `fork_rng` restores the random state after the block; without devices, only the state of the CPU.
        with threadpool_limits(count), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(previous_count)


def train_perceptron(stage: TrainingStage, config: FitConfig) -> None:
    """Train a perceptron. If the configuration requires it, also round the hidden weights to 8 bits.

    After the rounding, the other weights are trained further.

    Args:
        stage: The perceptron, its loss and the number of steps.
        config: Form of the weights.
    """
    stage.run()
    if config.network.weights != "int8":
        return

    stage.network.round_hidden_matrices()
    steps = round(ROUNDED_FRACTION * stage.steps)
    replace(stage, steps=steps).run()
