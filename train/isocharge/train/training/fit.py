"""Fit a network: presses in, an object that answers charges out.

The contact network learns mean and standard deviation by maximum likelihood on charges with fresh noise in every step;
the first steps learn the mean by least squares, because a likelihood with free deviations is slow to find it. With a
teacher it learns the teacher's answers to those charges instead. The misfit network learns from charges of all kinds,
whose distance from the nearest known contact is searched for beforehand.
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

from isocharge.common.arrays import Array
from isocharge.common.errors import ConfigError, DatasetError
from isocharge.common.resumable_run import ResumableRun
from isocharge.simulate.dataset.shards import Dataset
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.fold_free import SMALLEST_SHARE, ambiguous_pairs, fold_free_domain, probable_fold
from isocharge.train.data.measured import held_out
from isocharge.train.data.misfit_charges import MisfitExamples, draw_misfit_examples, misfit_noise
from isocharge.train.data.presses import LabelledPresses, split_by_position
from isocharge.train.training.config import FitConfig, TrainingConfig
from isocharge.train.training.descent import Descent, TrainingStage, tensor_bytes, tensors
from isocharge.train.training.folding import FoldedNetwork, fold_network
from isocharge.train.training.network import Features, InverseNetwork, Perceptron, compress_length
from isocharge.train.training.source import Provenance, Teacher, TrainingData

_log = logging.getLogger(__name__)

WARM_UP = 0.15
"""Length of the first stage, which learns the mean by least squares, over all steps, dimensionless."""

SETTLING = 0.25
"""Steps that the other weights are trained on for, once the hidden ones are rounded, over those before."""

WATCHED = 0.5
"""Ratio of the positions that are watched while a network trains to those that are held out."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A fitted network, and what it is for.

    Attributes:
        network: The network as plain layers in NumPy.
        sensor: The sensor whose charges it takes.
        probes: Notations of the probes.
        domain: The contacts that it knows.
        noise: Noise that it was trained for.
        test: Presses that it is judged by; it did not learn from them.
        good: Presses of which 1 % may have a misfit above the alarm's.
        sha256: Checksum of what it was fitted to.
        provenance: For the release.
        asked: The domain that was asked for; larger than the network's where the map folds.
        cautions: What users of the network should know, a sentence each.
    """

    network: FoldedNetwork
    sensor: Sensor
    probes: tuple[str, ...]
    domain: Domain
    noise: NoiseModel
    test: LabelledPresses
    good: LabelledPresses
    sha256: str
    provenance: Provenance
    asked: Domain
    cautions: tuple[str, ...] = ()

    def predict(self, charge: Array) -> tuple[Array, Array, Array]:
        """Charges (n, n_electrode), pC, to contact (n, 3), mm and N, standard deviations (n, 3), and misfit (n, 1)."""
        return self.network.predict(charge)


def fit(source: Dataset | TrainingData, config: FitConfig | None = None, *, run: ResumableRun | None = None) -> Fitted:
    """Fit a network to presses.

    Args:
        source: A dataset, simulated or measured, or other training data: of a student, or of presses on a rig.
        config: Sizes, steps, noise and seed; the defaults if absent.
        run: Keeps the state, so that a killed fit goes on.

    Raises:
        ConfigError: If a setting is out of its range, or for another number of electrodes.
        DatasetError: If the presses cannot train an inverse.
        TrainingError: If the loss is not finite.

    Warns the logger of this module where the map folds, and where contacts far apart have the same charges.
    """
    data = source if isinstance(source, TrainingData) else TrainingData.of(source)
    settings = (config or FitConfig()).checked()
    trained = train_network(data, settings, run=run)
    split, taught = trained.split, data.teacher
    made_with = {
        "config": settings.to_dict(),
        "torch": torch.__version__,
        **({"cautions": list(split.cautions)} if split.cautions else {}),
        **({"teacher": taught.label} if taught else {}),
        **data.provenance.made_with,
    }
    return Fitted(
        network=fold_network(trained.network),
        sensor=data.sensor,
        probes=data.probes,
        domain=split.domain,
        noise=settings.training.noise_model,
        test=split.held if data.test is None else data.test,
        good=data.presses.within(split.domain.radius) if data.presses.measured else split.held,
        sha256=data.sha256,
        provenance=replace(data.provenance, made_with=made_with),
        asked=data.domain,
        cautions=split.cautions,
    )


def fit_identity(data: TrainingData, config: FitConfig) -> dict[str, object]:
    """All that decides about the weights: the identity of a resumable run."""
    return {
        "dataset_sha256": data.sha256,
        "noise": config.training.noise_model.to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
        **({"teacher_sha256": data.teacher.sha256} if data.teacher else {}),
    }


@dataclass(frozen=True)
class Split:
    """Presses for their purposes, where the map can be inverted.

    Attributes:
        domain: The contacts that the network will know.
        train: To learn from.
        watched: To stop by.
        held: To measure errors on.
        field: The map from contacts to charges.
        cautions: About folds and ambiguous pairs, a sentence each.
    """

    domain: Domain
    train: LabelledPresses
    watched: LabelledPresses
    held: LabelledPresses
    field: ChargeField
    cautions: tuple[str, ...]

    @classmethod
    def of(cls, data: TrainingData, training: TrainingConfig) -> "Split":
        """Split presses by position, within the largest disk in which the map certainly does not fold."""
        presses, names = data.presses, data.sensor.electrode_names
        first = ChargeField.fit(data.domain, names, *split_by_position(presses, training.hold_out, training.seed))
        domain, cautions = _without_folds(first, presses, misfit_noise(training.noise_model))
        inside = presses if domain == data.domain else presses.within(domain.radius)
        if presses.measured:
            out = held_out(inside.contact)
            trainable, held = inside[~out], inside[out]
        else:
            trainable, held = split_by_position(inside, training.hold_out, training.seed)
        train, watched = split_by_position(trainable, WATCHED * training.hold_out, training.seed + 1)
        return cls(domain, train, watched, held, ChargeField.fit(domain, names, train, watched), tuple(cautions))


def _without_folds(field: ChargeField, presses: LabelledPresses, noise: NoiseModel) -> tuple[Domain, list[str]]:
    """The largest disk in which the map certainly does not fold, and sentences on what is known about it."""
    asked, domain = field.domain, fold_free_domain(field, noise)
    if domain.radius < SMALLEST_SHARE * asked.radius:
        raise DatasetError(
            f"the map from contacts to charges folds {domain.radius:g} mm from the centre, of {asked.radius:g} "
            "mm asked for: beyond, two contacts give the same charges; add an electrode, or take a biaxial film"
        )
    cautions = []
    if domain != asked:
        cautions.append(
            f"the map from contacts to charges folds beyond {domain.radius:g} mm: two contacts give the same charges "
            f"there; the model is trained for {domain.radius:g} mm, not {asked.radius:g} mm, on "
            f"{len(presses.within(domain.radius))} of {len(presses)} presses"
        )
    elif np.isfinite(fold := probable_fold(field, noise)):
        return domain, [
            f"the map from contacts to charges seems to fold about {fold:.2g} mm from the centre, where two "
            "contacts give the same charges; the presses cannot tell it for certain, and the model is trained "
            f"across it, up to {asked.radius:g} mm; see 'isocharge simulate identify', then ask for a smaller "
            "radius or add an electrode"
        ]
    if pairs := ambiguous_pairs(field, noise, domain.radius).summary:
        which = "no model tells which of them it is; see 'isocharge simulate identify'"
        cautions.append(f"{pairs[0].lower()}{pairs[1:-1]}; {which}")
    return domain, cautions


@dataclass(frozen=True)
class TrainedNetwork:
    """A network as torch trained it, and the presses that it learned from."""

    network: InverseNetwork
    split: Split


def train_network(data: TrainingData, config: FitConfig, *, run: ResumableRun | None = None) -> TrainedNetwork:
    """Train both perceptrons; arguments and errors as `fit`."""
    names, expected, training = data.sensor.electrode_names, config.network.electrodes, config.training
    if expected and expected != len(names):
        raise ConfigError(
            f"network.electrodes: the configuration is for {expected} electrodes, the dataset of "
            f"{data.sensor.name!r} has {len(names)} ({', '.join(names)}); use another dataset or leave the key out"
        )
    with threads_and_seed(training.threads, training.seed):
        split = Split.of(data, training)
        for caution in split.cautions:
            _log.warning("%s", caution)
        features, sizes = Features.fit(split.train.charge), config.network
        network = InverseNetwork(split.domain, features, sizes.hidden, sizes.misfit_hidden)
        _Training(network, split, config, data.teacher, run).run()
    return TrainedNetwork(network.eval(), split)


@contextmanager
def threads_and_seed(count: int, seed: int) -> Iterator[None]:
    """Seed and thread count for the block, the caller's restored after it.

    BLAS is held to the same number: its threads spin at barriers, and a busy second core makes them many times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count, user_api="blas"), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)


class _Training:
    """One training: data as tensors, and the stages one after the other."""

    def __init__(
        self,
        network: InverseNetwork,
        split: Split,
        settings: FitConfig,
        teacher: Teacher | None,
        run: ResumableRun | None,
    ) -> None:
        self.network, self.split, self.teacher, self.resumable = network, split, teacher, run
        self.config, self.rounded = settings.training, settings.network.weights == "int8"
        self.noise, self.warm_up = self.config.noise_model, round(WARM_UP * self.config.steps)
        to_unit = split.domain.to_unit
        self.charge = torch.tensor(split.train.charge).float()
        self.unit = torch.tensor(to_unit(split.train.contact)).float()
        self.watched_charge = torch.tensor(split.watched.noisy(self.noise, self.config.seed)).float()
        self.watched_unit = torch.tensor(to_unit(split.watched.contact)).float()

    def run(self) -> None:
        contact, config = self.network.contact, self.config
        stage = TrainingStage(
            "contact", contact, self._contact_loss, self._contact_score, config.steps, warm_up_steps=self.warm_up
        )
        self._train_part(stage, contact)
        examples, vector = self._misfit_examples(), self.network.misfit_vector
        data = _MisfitData.of(self.network, examples, config)
        self._train_part(TrainingStage("misfit", vector, data.loss, data.score, config.misfit_steps), vector)

    def _train_part(self, stage: TrainingStage, part: Perceptron) -> None:
        """Train a perceptron; where weights are rounded, round its hidden ones and train the others on."""
        self._descend(stage)
        if self.rounded:
            part.round_hidden()
            settling = replace(
                stage,
                name=f"{stage.name}-rounded",
                loss=lambda step, random: stage.loss(stage.steps + step, random),
                steps=round(SETTLING * stage.steps),
                warm_up_steps=0,
            )
            self._descend(settling)

    def _descend(self, stage: TrainingStage) -> None:
        Descent(stage, self.config.learning_rate, self.config.patience, self.config.seed).run(self.resumable)

    def _contact_loss(self, step: int, random: torch.Generator) -> Tensor:
        rows = torch.randint(len(self.charge), (min(self.config.batch, len(self.charge)),), generator=random)
        charge = with_fresh_noise(self.charge[rows], self.noise, random)
        mean, log_std = self.network.posterior(charge)
        if self.teacher is None:
            return (start_loss if step < self.warm_up else likelihood_loss)(mean, log_std, self.unit[rows])
        taught = self.teacher.posterior(charge, self.network.domain)
        return start_loss(mean, log_std, taught[0]) if step < self.warm_up else teaching_loss(mean, log_std, *taught)

    def _contact_score(self) -> tuple[float, str]:
        with torch.no_grad():
            mean, log_std = self.network.posterior(self.watched_charge)
            loss = likelihood_loss(mean, log_std, self.watched_unit).item()
            off = ((mean - self.watched_unit) * self.network.scale) ** 2
        position, force = off[:, :2].sum(dim=1).mean().sqrt().item(), off[:, 2].mean().sqrt().item()
        return loss, f"{loss:.3f} on watched presses: {position:.4f} mm and {100.0 * force:.3f} % of force rms"

    def _misfit_examples(self) -> MisfitExamples:
        """Examples that the run kept, or drawn: the search for their nearest contacts takes long enough to keep."""
        if self.resumable and (kept := self.resumable.load("misfit-charges", tensors)) is not None:
            return MisfitExamples(*(values.numpy() for values in kept))
        config, noise = self.config, misfit_noise(self.noise)
        examples = draw_misfit_examples(self.split.train, self.split.field, noise, config.misfit_charges, config.seed)
        if self.resumable:
            kept = [torch.tensor(examples.charge), torch.tensor(examples.residual)]
            self.resumable.save("misfit-charges", tensor_bytes(kept))
        return examples


@dataclass(frozen=True)
class _MisfitData:
    """The misfit network's data: inputs and compressed vectors, the last `watched` of them not trained on."""

    network: InverseNetwork
    inputs: Tensor
    targets: Tensor
    watched: int
    batch: int

    @classmethod
    def of(cls, network: InverseNetwork, examples: MisfitExamples, config: TrainingConfig) -> "_MisfitData":
        inputs = network.inputs(torch.tensor(examples.charge).float())
        watched = round(WATCHED * config.hold_out * len(inputs))
        return cls(network, inputs, compress_length(torch.tensor(examples.residual)).float(), watched, config.batch)

    def loss(self, _: int, random: torch.Generator) -> Tensor:
        rows = torch.randint(len(self.inputs) - self.watched, (self.batch,), generator=random)
        return self._squares(self.inputs[rows], self.targets[rows]).mean()

    def score(self) -> tuple[float, str]:
        with torch.no_grad():
            mean = self._squares(self.inputs[-self.watched :], self.targets[-self.watched :]).mean().item()
        return mean, f"{mean:.4f} on watched charges"

    def _squares(self, inputs: Tensor, targets: Tensor) -> Tensor:
        squares: Tensor = ((self.network.misfit_vector(inputs) - targets) ** 2).sum(dim=1)
        return squares


def with_fresh_noise(charge: Tensor, noise: NoiseModel, random: torch.Generator) -> Tensor:
    """Noisy readings of charges of any shape, pC."""
    sigma = torch.hypot(torch.tensor(noise.white), noise.gain * charge)
    return charge + sigma * torch.randn(charge.shape, generator=random)


def start_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Least squares for the mean; the deviations follow it without pulling at it."""
    squares = (mean - unit) ** 2
    follow = log_std + 0.5 * squares.detach() * torch.exp(-2.0 * log_std)
    return (30.0 * squares + 0.1 * follow).sum(dim=1).mean()


def likelihood_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Negative logarithm of a Gaussian likelihood, but for a constant."""
    return (log_std + 0.5 * ((mean - unit) * torch.exp(-log_std)) ** 2).sum(dim=1).mean()


def teaching_loss(mean: Tensor, log_std: Tensor, taught_mean: Tensor, taught_log_std: Tensor) -> Tensor:
    """Kullback-Leibler divergence of a network's Gaussians from the teacher's, summed over (x, y, ln F)."""
    squares = torch.exp(2.0 * taught_log_std) + (mean - taught_mean) ** 2
    return (log_std - taught_log_std + 0.5 * (squares * torch.exp(-2.0 * log_std) - 1.0)).sum(dim=1).mean()
