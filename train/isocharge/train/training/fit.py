"""Training: a dataset in, a trained `InverseNetwork` out.

The contact network learns mean and standard deviation by maximum likelihood on charges with fresh noise in every step;
the first steps learn the mean by least squares, because a likelihood with free deviations is slow to find it. Without
noise Levenberg-Marquardt finishes the mean. The misfit network learns from charges of all kinds, whose distance from
the nearest known contact is searched for beforehand.

With a teacher the contact network learns the teacher's answers to those charges instead of the presses.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from isocharge.common.errors import ConfigError, DatasetError
from isocharge.common.progress import StageProgress, Warn
from isocharge.simulate.dataset.shards import Dataset
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.fold_free import SMALLEST_SHARE, fold_free_domain, probable_fold_mm, twins_within
from isocharge.train.data.measured import held_out, is_measured
from isocharge.train.data.misfit_charges import MisfitExamples, draw_misfit_examples
from isocharge.train.data.noise import misfit_noise, noisy_charges
from isocharge.train.data.presses import LabelledPresses, domain_of, presses_of, split_by_position
from isocharge.train.training.checkpoint import Checkpoint
from isocharge.train.training.config import FitConfig, TrainingConfig
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.levenberg_marquardt import FIRST, levenberg_marquardt
from isocharge.train.training.misfit_data import WATCHED, MisfitData
from isocharge.train.training.network import Features, InverseNetwork, Perceptron
from isocharge.train.training.teacher import Teacher, teaching_loss

WARM_UP = 0.15
"""Length of the first stage, which learns the mean by least squares, over all steps, dimensionless."""

SETTLING = 0.25
"""Steps that the other weights are trained on for, once the hidden ones are rounded, over those before."""


@dataclass(frozen=True)
class Fit:
    """A trained model and what it was not shown.

    Attributes:
        network: The model.
        field: The forward map that the misfit was learned with.
        held: Presses held out for measuring errors.
        config: What it was trained with.
        asked: The domain of the dataset; larger than the network's where the map folds.
        measured: Whether the presses were measured, so that their charges have noise already.
        cautions: What the user of the model should know, a sentence each.
    """

    network: InverseNetwork
    field: ChargeField
    held: LabelledPresses
    config: FitConfig
    asked: ContactDomain
    measured: bool = False
    cautions: tuple[str, ...] = ()


def fit_network(
    dataset: Dataset,
    config: FitConfig,
    progress: StageProgress | None = None,
    *,
    checkpoint: Checkpoint | None = None,
    teacher: Teacher | None = None,
    warn: Warn = warnings.warn,
) -> Fit:
    """Train on a dataset.

    Args:
        dataset: Clean charges, to which noise is added here; or measured ones, to which it is added as well while
            training, against learning them by heart, and not to those held out.
        config: Sizes, steps, seed.
        progress: Called with steps done, all steps, and a text with the loss and errors on watched presses.
        checkpoint: Keeps the state, so that a stopped run goes on.
        teacher: A model whose answers are learned; the presses' contacts if absent.
        warn: Called where the map folds, and where contacts far apart have the same charges.

    Raises:
        ConfigError: If the noise level is unknown.
        DatasetError: If the dataset cannot train an inverse.
        TrainingError: If the loss is not finite.
    """
    training, cautions = config.training, list[str]()
    noise_model(training.noise)  # an unknown level is said before the work
    asked, presses = domain_of(dataset), presses_of(dataset)
    _check_electrodes(dataset, config)
    with threads_and_seed(training.threads, training.seed):
        domain, presses = _without_folds(asked, presses, training, cautions.append)
        for caution in cautions:
            warn(caution)
        trainable, held = _split(presses, training, is_measured(dataset))
        train, watched = split_by_position(trainable, WATCHED * training.hold_out, training.seed + 1)
        field = _field(domain, train, watched)
        network = InverseNetwork(
            domain, Features.fit(train.charge_pC), config.network.hidden, config.network.misfit_hidden
        )
        _Training(network, field, train, watched, config, checkpoint or Checkpoint(), teacher, progress).run()
    network.eval()
    return Fit(network, field, held, config, asked, is_measured(dataset), tuple(cautions))


def _split(
    presses: LabelledPresses, training: TrainingConfig, measured: bool
) -> tuple[LabelledPresses, LabelledPresses]:
    """Presses to train on, and those held out."""
    if not measured:
        return split_by_position(presses, training.hold_out, training.seed)
    held = held_out(presses.contact)
    return presses[~held], presses[held]


def _field(domain: ContactDomain, train: LabelledPresses, watched: LabelledPresses) -> ChargeField:
    return ChargeField.fit(domain, train.contact, train.charge_pC, (watched.contact, watched.charge_pC))


def _check_electrodes(dataset: Dataset, config: FitConfig) -> None:
    names, expected = dataset.sensor.electrode_names, config.network.electrodes
    if expected and expected != len(names):
        raise ConfigError(
            f"network.electrodes: the configuration is for {expected} electrodes, the dataset of "
            f"{dataset.sensor.name!r} has {len(names)} ({', '.join(names)}); use another dataset or leave the key out"
        )


def _without_folds(
    asked: ContactDomain, presses: LabelledPresses, training: TrainingConfig, warn: Warn
) -> tuple[ContactDomain, LabelledPresses]:
    """The largest disk in which the map certainly does not fold, and the presses in it."""
    field = _field(asked, *split_by_position(presses, training.hold_out, training.seed))
    noise = misfit_noise(noise_model(training.noise))
    domain = fold_free_domain(field, noise)
    if domain == asked:
        if np.isfinite(fold_mm := probable_fold_mm(field, noise)):
            warn(
                f"the map from contacts to charges seems to fold about {fold_mm:.2g} mm from the centre, where two "
                f"contacts give the same charges; the presses cannot tell it for certain, and the model is trained "
                f"across it, up to {asked.radius_mm:g} mm; see 'isocharge simulate identify', then ask for a smaller "
                "radius or add an electrode"
            )
        else:
            _warn_of_twins(field, noise, asked, warn)
        return asked, presses
    if domain.radius_mm < SMALLEST_SHARE * asked.radius_mm:
        raise DatasetError(
            f"the map from contacts to charges folds {domain.radius_mm:g} mm from the centre, of {asked.radius_mm:g} "
            "mm asked for: beyond, two contacts give the same charges; add an electrode, or take a biaxial film"
        )
    inside = presses[np.hypot(presses.contact[:, 0], presses.contact[:, 1]) <= domain.radius_mm]
    warn(
        f"the map from contacts to charges folds beyond {domain.radius_mm:g} mm: two contacts give the same charges "
        f"there; the model is trained for {domain.radius_mm:g} mm, not {asked.radius_mm:g} mm, on {len(inside)} of "
        f"{len(presses)} presses"
    )
    _warn_of_twins(field, noise, domain, warn)
    return domain, inside


def _warn_of_twins(field: ChargeField, noise: NoiseModel, domain: ContactDomain, warn: Warn) -> None:
    if twins := twins_within(field, noise, domain.radius_mm).words:
        warn(f"{twins[0].lower()}{twins[1:-1]}; no model tells which of them it is; see 'isocharge simulate identify'")


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
    """One run: data as tensors, and the stages one after the other."""

    def __init__(
        self,
        network: InverseNetwork,
        field: ChargeField,
        train: LabelledPresses,
        watched: LabelledPresses,
        settings: FitConfig,
        checkpoint: Checkpoint,
        teacher: Teacher | None,
        progress: StageProgress | None,
    ) -> None:
        self.network, self.field, self.train, self.watched = network, field, train, watched
        self.config, self.rounded = settings.training, settings.network.weights == "int8"
        self.checkpoint, self.teacher, self.progress = checkpoint, teacher, progress
        config = self.config
        self.noise = noise_model(config.noise)
        self.charge = torch.tensor(train.charge_pC).float()
        self.unit = torch.tensor(field.domain.to_unit(train.contact)).float()
        self.watched_charge = torch.tensor(noisy_charges(watched, self.noise, config.seed)).float()
        self.watched_unit = torch.tensor(field.domain.to_unit(watched.contact)).float()
        self.total = sum(map(self._steps, (config.steps, config.misfit_steps))) + config.finish_steps

    def _steps(self, steps: int) -> int:
        """All steps of a stage, those after rounding included."""
        return steps + round(SETTLING * steps) * self.rounded

    def run(self) -> None:
        config = self.config
        contact = TrainingStage(
            "contact",
            self.network.contact,
            self._contact_loss,
            self._contact_score,
            config.steps,
            round(WARM_UP * config.steps),
        )
        self._train_part(contact, self.network.contact, 0)
        if config.finish_steps:
            self._finish()
        data = MisfitData.of(self.network, self._misfit_examples(), config)
        misfit = TrainingStage("misfit", self.network.misfit_vector, data.loss, data.score, config.misfit_steps)
        self._train_part(misfit, self.network.misfit_vector, self._steps(config.steps) + config.finish_steps)

    def _train_part(self, task: TrainingStage, part: Perceptron, before: int) -> None:
        """Train a perceptron; where weights are rounded, round its hidden ones and train the others on."""
        self._descend(task, before)
        if self.rounded:
            part.round_hidden()
            settling = replace(
                task,
                name=f"{task.name}-rounded",
                loss=lambda step, random: task.loss(task.steps + step, random),
                steps=round(SETTLING * task.steps),
                warm_up_steps=0,
            )
            self._descend(settling, before + task.steps)

    def _descend(self, task: TrainingStage, before: int) -> None:
        descent = Descent(task, self.config.learning_rate, self.config.patience, self.config.seed)
        descent.run(self.checkpoint, lambda step, text: self._report(before + step, text))

    def _report(self, done: int, text: str) -> None:
        if self.progress:
            self.progress(done, self.total, text)

    def _contact_loss(self, step: int, random: torch.Generator) -> Tensor:
        rows = torch.randint(len(self.charge), (min(self.config.batch, len(self.charge)),), generator=random)
        charge_pC = with_fresh_noise(self.charge[rows], self.noise, random)
        mean, log_std = self.network.posterior(charge_pC)
        warm_up = step < round(WARM_UP * self.config.steps)
        if self.teacher is None:
            return (start_loss if warm_up else likelihood_loss)(mean, log_std, self.unit[rows])
        taught = self.teacher.posterior(charge_pC, self.network.domain)
        return start_loss(mean, log_std, taught[0]) if warm_up else teaching_loss(mean, log_std, *taught)

    def _contact_score(self) -> tuple[float, str]:
        with torch.no_grad():
            mean, log_std = self.network.posterior(self.watched_charge)
            loss = likelihood_loss(mean, log_std, self.watched_unit).item()
            off = ((mean - self.watched_unit) * self.network.scale) ** 2
        position, force = off[:, :2].sum(dim=1).mean().sqrt().item(), off[:, 2].mean().sqrt().item()
        return loss, f"{loss:.3f} on watched presses: {position:.4f} mm and {100.0 * force:.3f} % of force rms"

    def _finish(self) -> None:
        """Levenberg-Marquardt for the mean in double precision; the deviations are then those of watched presses."""
        part = self.network.contact.double()
        inputs, targets = self.network.inputs(self.charge).double(), self.unit.double()
        state = self.checkpoint.load("finish") or {"step": 0, "damping": FIRST, "part": part.state_dict()}
        part.load_state_dict(state["part"])
        step = state["step"]
        left = self.config.finish_steps - step
        for square, damping in levenberg_marquardt(part, inputs, targets, left, state["damping"]):
            step += 1
            state = {"step": step, "damping": damping, "part": part.state_dict()}
            self.checkpoint.save("finish", partial(_as_it_is, state))
            self._report(self.config.steps + step, f"finish: {square:.3g}, {self._mean_off()}")
        self.checkpoint.save("finish", lambda: {**state, "step": self.config.finish_steps}, now=True)
        self._constant_deviations()
        part.float()

    def _mean_off(self) -> str:
        with torch.no_grad():
            mean = self.network.contact(self.network.inputs(self.watched_charge).double())[:, :3]
            off = ((mean - self.watched_unit) * self.network.scale).double() ** 2
        return f"{off[:, :2].sum(dim=1).mean().sqrt():.5f} mm and {100.0 * off[:, 2].mean().sqrt():.4f} % of force rms"

    def _constant_deviations(self) -> None:
        """Root-mean-square errors of the watched presses as the deviations, whatever the charges."""
        last, skip = self.network.contact.layers()[-1], self.network.contact.skip
        with torch.no_grad():
            off = self.network.contact(self.network.inputs(self.watched_charge).double())[:, :3] - self.watched_unit
            last.weight[3:] = skip.weight[3:] = 0.0
            last.bias[3:] = 0.5 * (off**2).mean(dim=0).log()

    def _misfit_examples(self) -> MisfitExamples:
        """Examples from the checkpoint, or drawn: the search for their nearest contacts takes long enough to store."""
        if (stored := self.checkpoint.load("charges")) is not None:
            return MisfitExamples(*(stored[name].numpy() for name in ("charge_pC", "miss")))
        examples = draw_misfit_examples(
            self.train, self.field, misfit_noise(self.noise), self.config.misfit_charges, self.config.seed
        )
        self.checkpoint.save(
            "charges", lambda: {name: torch.tensor(getattr(examples, name)) for name in ("charge_pC", "miss")}, now=True
        )
        return examples


def _as_it_is(state: dict[str, Any]) -> dict[str, Any]:
    return state


def with_fresh_noise(charge_pC: Tensor, noise: NoiseModel, random: torch.Generator) -> Tensor:
    sigma = torch.hypot(torch.tensor(1e12 * noise.white), noise.gain * charge_pC)
    return charge_pC + sigma * torch.randn(charge_pC.shape, generator=random)


def start_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Least squares for the mean; the deviations follow it without pulling at it."""
    squares = (mean - unit) ** 2
    follow = log_std + 0.5 * squares.detach() * torch.exp(-2.0 * log_std)
    return (30.0 * squares + 0.1 * follow).sum(dim=1).mean()


def likelihood_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Negative logarithm of a Gaussian likelihood, but for a constant."""
    return (log_std + 0.5 * ((mean - unit) * torch.exp(-log_std)) ** 2).sum(dim=1).mean()
