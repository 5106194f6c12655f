"""Training of a network on presses.

The contact perceptron learns the mean and the standard deviation of the contact by maximum likelihood, with fresh noise
on the charges in every step. In the first steps it learns the mean by least squares. If a teacher is given, it learns
the teacher's answers to these charges instead. The misfit perceptron learns from charges of many kinds, whose distance
from the nearest contact of the domain is computed beforehand.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.common.errors import ConfigError
from isocharge.common.progress import second_thread
from isocharge.common.resumable_run import ResumableRun
from isocharge.serve.model.charge_series import FILE as CHARGES_FILE
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import ChargeMap, Dataset, Domain, NoiseModel
from isocharge.simulate.forward.charge_map import within
from isocharge.train.data.channel_noise import ChannelNoise, Noise
from isocharge.train.data.charge_field import ChargeField, invertible_domain
from isocharge.train.data.misfit_charges import draw_misfit_examples, draw_outside_examples, misfit_noise
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses, held_out, split_by_position
from isocharge.train.training.config import FEW_ELECTRODES, FitConfig, TrainingConfig
from isocharge.train.training.correlation import with_correlation
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.fitted import Fitted
from isocharge.train.training.folded_network import MISFIT_UNIT
from isocharge.train.training.losses import (
    distillation_loss,
    focused_squared_distance,
    validation_score,
    warm_up_loss,
    weighted_likelihood_loss,
    with_fresh_noise,
)
from isocharge.train.training.network import (
    InverseNetwork,
    TrainablePerceptron,
    as_tensor,
    compress_length,
    fold_network,
)
from isocharge.train.training.output_regression import fit_std
from isocharge.train.training.source import Teacher, TrainingData

_log = logging.getLogger(__name__)

WARM_UP_FRACTION = 0.15
"""Fraction of the steps that use the warm-up loss, dimensionless."""

ROUNDED_FRACTION = 0.25
"""Number of steps after the hidden weights are rounded, relative to the number of steps before, dimensionless."""

VALIDATION_FRACTION = 0.5
"""Number of validation positions relative to the number of test positions, dimensionless."""

MISFIT_RATE_FACTOR = 1.5
"""Learning rate of the misfit network, whose targets have no noise, relative to that of the contact network."""

N_STD_PRESSES = 60_000
"""Number of presses with noise to which the standard deviations of a trained network are fitted."""

N_OUTSIDE_PRESSES = 6_000
"""Number of presses outside the working area from which charges for the misfit network are drawn."""

OUTSIDE_SHARE = 0.15
"""Share of the examples of the misfit network that are presses outside the working area, if those are simulated,
dimensionless."""

MANY_OUTSIDE_SHARE = 0.3
"""The same share with more than `FEW_ELECTRODES` electrodes, dimensionless. They can notice nearly all presses outside
the working area."""

SEARCH_STARTS = 2
"""Number of starts of a search for the nearest contact."""

MANY_SEARCH_STARTS = 4
"""The same number with more than `FEW_ELECTRODES` electrodes, whose charges have more local minima of the misfit."""

FOCUS_MISFIT = 10.0
"""Misfit at which the weight of an example of the misfit network is half of the largest weight, in standard deviations.
It is twice the smallest limit of the flag `misfit`."""

SIGNED_FEATURE_SCALE = 0.1
"""Charge above which features of charges of both signs are logarithmic, relative to the charge above which the noise is
proportional to the charge. On a taut uniaxial film the position error is 1.05 of the Bayes limit with 0.1, and 1.08
with 1."""


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
class Split:
    """The presses of a training, split by position, in the domain where the map can be inverted.

    Attributes:
        domain: Contacts for which the network is trained.
        train: Presses for training.
        validation: Presses for early stopping.
        test: Presses for measuring errors.
        field: Map from contacts to charges, fitted to the presses of the domain, or to all presses if that fits better.
        cautions: Sentences about folds of the map and about contacts with the same charges.
        folded_charges: Charges of all presses, including the region where the map folds; None if it does not fold.
    """

    domain: Domain
    train: LabelledPresses
    validation: LabelledPresses
    test: LabelledPresses
    field: ChargeMap
    cautions: tuple[str, ...]
    folded_charges: ChargeSeries | None

    @classmethod
    def of(cls, data: TrainingData, training: TrainingConfig) -> "Split":
        """Split presses into those for training, validation and test, and fit a charge field to them.

        Only presses within the largest disk in which the map certainly does not fold are used.

        Args:
            data: Presses of the sensor.
            training: Fractions of the presses, noise and seed.
        """
        presses = data.presses
        names = data.sensor.electrode_names
        whole_field = ChargeField.fit(data.domain, names, *split_by_position(presses, training.hold_out, training.seed))
        domain, cautions = invertible_domain(whole_field, presses, misfit_noise(training.noise_model))
        is_folded = domain != data.domain
        inside = presses.within(domain.radius) if is_folded else presses
        if presses.measured:
            is_test = held_out(inside.contact)
            remaining = inside[~is_test]
            test = inside[is_test]
        else:
            remaining, test = split_by_position(inside, training.hold_out, training.seed)
        validation_share = VALIDATION_FRACTION * training.hold_out
        train, validation = split_by_position(remaining, validation_share, training.seed + 1)

        field: ChargeMap = whole_field
        if is_folded or presses.measured:  # the first field was fitted to presses beyond the fold, or to test presses
            field = ChargeField.fit(domain, names, train, validation)
            if is_folded and whole_field.error < field.error:
                field = within(whole_field, domain.radius)
        folded_charges = whole_field.of_positive if is_folded else None
        return cls(domain, train, validation, test, field, cautions, folded_charges)

    def features(self, noise: NoiseModel) -> WhitenedFeatures:
        """Fit the input features: logarithms if all charges are positive, otherwise inverse hyperbolic sines."""
        charge = self.train.charge
        if not (self.train.signed or self.validation.signed or self.test.signed):
            return WhitenedFeatures.fit_logarithms(charge)
        channels = ChannelNoise.alike(noise, charge.shape[1])
        scaled = replace(channels, white=SIGNED_FEATURE_SCALE * channels.white)
        return WhitenedFeatures.fit_signed(charge, scaled.bend(charge))


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
        mean, log_std = network.posterior(noisy)
        is_warm_up = step < warm_up_steps
        if teacher is None:
            loss_function = warm_up_loss if is_warm_up else weighted_likelihood_loss
            return loss_function(mean, log_std, target[rows])
        teacher_mean, teacher_log_std = teacher.posterior(noisy, domain)
        if is_warm_up:
            return warm_up_loss(mean, log_std, teacher_mean)
        return distillation_loss(mean, log_std, teacher_mean, teacher_log_std)

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


@dataclass(frozen=True)
class MisfitExamples:
    """Draws the examples for the misfit network. The run saves them, because the search takes long.

    Attributes:
        split: Presses for training, and the charge field in which the nearest contacts are searched for.
        features: Features of the network, which limit the charges.
        config: Noise, number of examples and seed.
        run: Run that saves the examples; None if they are not saved.
    """

    split: Split
    features: WhitenedFeatures
    config: TrainingConfig
    run: ResumableRun | None

    def inner(self) -> Array:
        """Return charges, pC, and residuals of examples made from presses in the working area.

        The shape is (2, n, n_electrode); see `draw_misfit_examples`.
        """
        draw = partial(
            draw_misfit_examples, self.split.train, self.split.field, self._noise(), starts=self._search_starts
        )
        return self._kept("misfit-charges", partial(draw, self.config.misfit_charges, self.config.seed))

    def with_outside(self, inner_examples: Array, outside: OutsidePresses | None) -> Array:
        """Replace a share of the examples by presses outside the working area.

        Args:
            inner_examples: Result of `inner`.
            outside: The film outside the working area; None if it is not simulated.

        Returns:
            Charges, pC, and residuals, same shape, in random order.
        """
        if outside is None:
            return inner_examples
        seed = self.config.seed
        outside_share = MANY_OUTSIDE_SHARE if self._has_many_electrodes else OUTSIDE_SHARE
        n_outside = round(outside_share * self.config.misfit_charges)
        charge = outside.draw(N_OUTSIDE_PRESSES, seed).charge
        draw = partial(draw_outside_examples, charge, self.split.field, self._noise(), starts=self._search_starts)
        outside_examples = self._kept("misfit-outside", partial(draw, n_outside, seed))
        examples = np.concatenate([inner_examples[:, n_outside:], outside_examples], axis=1)
        return np.random.default_rng(seed).permutation(examples, axis=1)

    @property
    def _has_many_electrodes(self) -> bool:
        return self.features.charge_features.n_electrode > FEW_ELECTRODES

    @property
    def _search_starts(self) -> int:
        """Number of starts of a search for the nearest contact."""
        return MANY_SEARCH_STARTS if self._has_many_electrodes else SEARCH_STARTS

    def _noise(self) -> Noise:
        """Return the noise of good presses; for charges of any sign, the noise of each channel."""
        noise = misfit_noise(self.config.noise_model)
        charge_features = self.features.charge_features
        if charge_features.mean is None:
            return noise
        return ChannelNoise.alike(noise, charge_features.n_electrode)

    def _kept(self, name: str, draw: Callable[..., Array]) -> Array:
        """Return the examples that a function draws, or that the run has saved under a name."""
        charge_features = self.features.charge_features
        limited_draw = draw
        if charge_features.mean is not None:
            limited_draw = partial(draw, limits=(charge_features.low_pC, charge_features.high_pC))
        if self.run is None:
            return limited_draw()
        saved: Array = self.run.storing_executor(name).submit(limited_draw).result()
        return saved


def misfit_stage(network: InverseNetwork, examples: Array, config: TrainingConfig) -> TrainingStage:
    """Return the training of the misfit perceptron.

    Args:
        network: The network, whose misfit perceptron is trained.
        examples: Charges, pC, and residuals (Q - Q(c)) / sigma at the nearest contact c, shape (2, n, n_electrode).
            The last of them are used for validation.
        config: Number of steps and batch size.
    """
    charges, residuals = examples
    inputs = network.inputs(as_tensor(charges))
    targets = compress_length(torch.tensor(residuals)).float()
    n_validation = max(1, round(VALIDATION_FRACTION * config.hold_out * len(inputs)))
    n_train = len(inputs) - n_validation

    focus = float(np.arcsinh(FOCUS_MISFIT / MISFIT_UNIT))

    def distance(rows: Tensor | slice) -> Tensor:
        """Return the weighted mean squared distance between outputs and targets, for some rows of the examples."""
        return focused_squared_distance(network.misfit_vector(inputs[rows]), targets[rows], focus)

    def loss(_: int, random: torch.Generator) -> Tensor:
        """Return the weighted mean squared distance for a random batch."""
        batch_rows = torch.randint(n_train, (config.batch,), generator=random)
        return distance(batch_rows)

    def score() -> tuple[float, str]:
        """Return the weighted mean squared distance for the validation examples, and a text with it."""
        validation_loss = distance(slice(n_train, None)).item()
        return validation_loss, f"{validation_loss:.4f} on watched charges"

    return TrainingStage(
        "misfit", network.misfit_vector, loss, score, config.misfit_steps, rate_factor=MISFIT_RATE_FACTOR
    )
