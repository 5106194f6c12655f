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
from functools import partial
from importlib import metadata

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.common.errors import ConfigError
from isocharge.common.resumable_run import ResumableRun
from isocharge.serve.model.charge_series import FILE as CHARGES
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import ChargeMap, Dataset, Domain, NoiseModel
from isocharge.simulate.forward.charge_map import within
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.channel_noise import ChannelNoise, Noise
from isocharge.train.data.charge_field import ChargeField, invertible_domain
from isocharge.train.data.misfit_charges import draw_misfit_examples, misfit_noise
from isocharge.train.data.presses import LabelledPresses, held_out, split_by_position
from isocharge.train.training.config import FitConfig, TrainingConfig
from isocharge.train.training.correlation import with_correlation
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.fitted import Fitted
from isocharge.train.training.network import (
    InverseNetwork,
    TrainablePerceptron,
    as_tensor,
    compress_length,
    fold_network,
)
from isocharge.train.training.source import Teacher, TrainingData

_log = logging.getLogger(__name__)

WARM_UP = 0.15
"""Length of the first stage, which learns the mean by least squares, over all steps, dimensionless."""

SETTLING = 0.25
"""Steps that the other weights are trained on for, once the hidden ones are rounded, over those before."""

WATCHED = 0.5
"""Ratio of the positions that are watched while a network trains to those that are held out."""


SHARPER = 0.1
"""Size from which features of any sign are logarithmic, over that from which noise grows with the charge. Measured: 1
comes to 1.08 of the Bayes limit of the position on a taut uniaxial film, 0.1 to 1.05."""


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
    with threads_and_seed(settings.training.threads, settings.training.seed):
        noise = settings.training.noise_model
        network = with_correlation(fold_network(trained.network), split.train, noise, settings.training.seed)
    made_with = {
        "config": settings.to_dict(),
        "torch": torch.__version__,
        **({"cautions": list(split.cautions)} if split.cautions else {}),
        **({"teacher": taught.label} if taught else {}),
        **data.provenance.made_with,
    }
    files = {**data.provenance.files, **({CHARGES: split.folded.to_bytes()} if split.folded else {})}
    return Fitted(
        network=network,
        sensor=data.sensor,
        probes=data.probes,
        domain=split.domain,
        noise=settings.training.noise_model,
        test=split.held if data.test is None else data.test,
        good=data.presses.within(split.domain.radius) if data.presses.measured else split.held,
        sha256=data.sha256,
        provenance=replace(data.provenance, made_with=made_with, files=files),
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
        field: The map from contacts to charges: fitted to what is left where the map folds, or to all presses if that
            fits better.
        cautions: About folds and ambiguous pairs, a sentence each.
        folded: The charges of all presses where the map folds among them, so that contacts can be followed across.
    """

    domain: Domain
    train: LabelledPresses
    watched: LabelledPresses
    held: LabelledPresses
    field: ChargeMap
    cautions: tuple[str, ...]
    folded: ChargeSeries | None

    @classmethod
    def of(cls, data: TrainingData, training: TrainingConfig) -> "Split":
        """Split presses by position, within the largest disk in which the map certainly does not fold."""
        presses, names = data.presses, data.sensor.electrode_names
        first = ChargeField.fit(data.domain, names, *split_by_position(presses, training.hold_out, training.seed))
        domain, cautions = invertible_domain(first, presses, misfit_noise(training.noise_model))
        inside = presses if domain == data.domain else presses.within(domain.radius)
        if presses.measured:
            out = held_out(inside.contact)
            trainable, held = inside[~out], inside[out]
        else:
            trainable, held = split_by_position(inside, training.hold_out, training.seed)
        train, watched = split_by_position(trainable, WATCHED * training.hold_out, training.seed + 1)
        field = ChargeField.fit(domain, names, train, watched)
        of_all = domain != data.domain and first.error < field.error
        field_within = within(first, domain.radius) if of_all else field
        folded = first.of_positive if domain != data.domain else None
        return cls(domain, train, watched, held, field_within, cautions, folded)

    def features(self, noise: NoiseModel) -> WhitenedFeatures:
        """Logarithms, unless some charge has none."""
        charge = self.train.charge
        if not (self.train.signed or self.watched.signed or self.held.signed):
            return WhitenedFeatures.fit_logarithms(charge)
        channels = ChannelNoise.alike(noise, charge.shape[1])
        return WhitenedFeatures.fit_signed(charge, replace(channels, white=SHARPER * channels.white).bend(charge))


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
        features, sizes = split.features(misfit_noise(training.noise_model)), config.network
        network = InverseNetwork(split.domain, features, sizes)
        stage = contact_stage(network, split.train, split.watched, training.noise_model, training, data.teacher)
        train_part(stage, network.contact, config, run)
        train_part(
            misfit_stage(network, _misfit_examples(split, features, training, run), training),
            network.misfit_vector,
            config,
            run,
        )
    return TrainedNetwork(network.eval(), split)


@contextmanager
def threads_and_seed(count: int, seed: int) -> Iterator[None]:
    """Seed and thread count for the block, the caller's restored after it.

    BLAS and OpenMP are held to the same number: their threads spin at barriers, and a busy second core makes them many
    times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count), torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)


def train_part(stage: TrainingStage, part: TrainablePerceptron, config: FitConfig, run: ResumableRun | None) -> None:
    """Train a perceptron; where weights are to be rounded, round its hidden ones and train the others on."""
    settings = config.training
    Descent(stage, settings.learning_rate, settings.patience, settings.seed).run(run)
    if config.network.weights == "int8":
        part.round_hidden_matrices()
        settling = replace(
            stage,
            name=f"{stage.name}-rounded",
            loss=lambda step, random: stage.loss(stage.steps + step, random),
            steps=round(SETTLING * stage.steps),
            warm_up_steps=0,
        )
        Descent(settling, settings.learning_rate, settings.patience, settings.seed).run(run)


def contact_stage(
    network: InverseNetwork,
    train: LabelledPresses,
    watched: LabelledPresses,
    noise: Noise,
    config: TrainingConfig,
    teacher: Teacher | None = None,
) -> TrainingStage:
    """Contacts and their deviations, of the presses or of a teacher, from charges with fresh noise."""
    domain, warm_up = network.domain, round(WARM_UP * config.steps)
    charge, unit = as_tensor(train.charge), as_tensor(domain.to_unit(train.contact))
    watched_charge = as_tensor(watched.charge if watched.measured else watched.noisy(noise, config.seed))
    watched_unit = as_tensor(domain.to_unit(watched.contact))

    def loss(step: int, random: torch.Generator) -> Tensor:
        rows = torch.randint(len(charge), (min(config.batch, len(charge)),), generator=random)
        noisy = with_fresh_noise(charge[rows], noise, random)
        mean, log_std = network.posterior(noisy)
        if teacher is None:
            return (start_loss if step < warm_up else likelihood_loss)(mean, log_std, unit[rows])
        taught = teacher.posterior(noisy, domain)
        return start_loss(mean, log_std, taught[0]) if step < warm_up else teaching_loss(mean, log_std, *taught)

    def score() -> tuple[float, str]:
        return contact_score(*network.posterior(watched_charge), watched_unit, domain, "presses")

    return TrainingStage("contact", network.contact, loss, score, config.steps, warm_up)


def _misfit_examples(
    split: Split, features: WhitenedFeatures, config: TrainingConfig, run: ResumableRun | None
) -> Array:
    """What `draw_misfit_examples` gives; the search takes long enough to keep it in the run."""
    noise: Noise = misfit_noise(config.noise_model)
    draw = partial(draw_misfit_examples, split.train, split.field)
    charge_features = features.charge_features
    if charge_features.mean is not None:
        noise = ChannelNoise.alike(misfit_noise(config.noise_model), charge_features.n_electrode)
        draw = partial(draw, limits=(charge_features.low_pC, charge_features.high_pC))
    draw = partial(draw, noise, config.misfit_charges, config.seed)
    return run.keeping("misfit-charges").submit(draw).result() if run else draw()


def misfit_stage(network: InverseNetwork, examples: Array, config: TrainingConfig) -> TrainingStage:
    """The compressed vectors of examples; the last of them are only watched."""
    inputs = network.inputs(as_tensor(examples[0]))
    targets = compress_length(torch.tensor(examples[1])).float()
    trained = len(inputs) - max(1, round(WATCHED * config.hold_out * len(inputs)))

    def squares(rows: Tensor | slice) -> Tensor:
        return mean_square(network.misfit_vector(inputs[rows]), targets[rows])

    def loss(_: int, random: torch.Generator) -> Tensor:
        return squares(torch.randint(trained, (config.batch,), generator=random))

    def score() -> tuple[float, str]:
        mean = squares(slice(trained, None)).item()
        return mean, f"{mean:.4f} on watched charges"

    return TrainingStage("misfit", network.misfit_vector, loss, score, config.misfit_steps)


def contact_score(mean: Tensor, log_std: Tensor, unit: Tensor, domain: Domain, what: str) -> tuple[float, str]:
    """The loss on what is only watched, and a text with the errors there."""
    loss = likelihood_loss(mean, log_std, unit).item()
    x, y, force = ((mean - unit).double().numpy() * domain.scale).T
    return (
        loss,
        f"{loss:.3f} on watched {what}: {rms(np.hypot(x, y)):.4f} mm and {100.0 * rms(force):.3f} % of force rms",
    )


def with_fresh_noise(charge: Tensor, noise: Noise, random: torch.Generator) -> Tensor:
    """Noisy readings of charges of any shape, pC."""
    white, gain = (torch.as_tensor(number, dtype=torch.float32) for number in (noise.white, noise.gain))
    sigma = torch.hypot(white, gain * charge)
    return charge + sigma * torch.randn(charge.shape, generator=random)


def start_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Least squares for the mean; the deviations follow it without pulling at it."""
    squares = (mean - unit) ** 2
    follow = log_std + 0.5 * squares.detach() * torch.exp(-2.0 * log_std)
    return (30.0 * squares + 0.1 * follow).sum(dim=1).mean()


def likelihood_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Negative logarithm of a Gaussian likelihood, but for a constant."""
    return (log_std + 0.5 * ((mean - unit) * torch.exp(-log_std)) ** 2).sum(dim=1).mean()


def mean_square(vector: Tensor, target: Tensor) -> Tensor:
    """Mean square of the distance between vectors (..., n_electrode)."""
    return torch.sum((vector - target) ** 2, dim=-1).mean()


def teaching_loss(mean: Tensor, log_std: Tensor, taught_mean: Tensor, taught_log_std: Tensor) -> Tensor:
    """Kullback-Leibler divergence of a network's Gaussians from the teacher's, summed over (x, y, ln F)."""
    squares = torch.exp(2.0 * taught_log_std) + (mean - taught_mean) ** 2
    return (log_std - taught_log_std + 0.5 * (squares * torch.exp(-2.0 * log_std) - 1.0)).sum(dim=1).mean()
