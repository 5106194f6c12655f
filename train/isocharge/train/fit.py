"""Training: a dataset in, a trained `InverseNetwork` out.

The contact network learns mean and standard deviation by maximum likelihood on charges with fresh noise in every step;
the first steps learn the mean by least squares, because a likelihood with free deviations is slow to find it. The
nearest-contact network learns to minimise the misfit itself, on presses, and on charges that no press gives: wrong
gains, a dead electrode, forces far outside.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from threadpoolctl import threadpool_limits
from torch import Tensor, nn

from isocharge.errors import ConfigError, TrainingError
from isocharge.simulate.dataset import Dataset
from isocharge.simulate.noise import noise_model
from isocharge.train.charge_field import ChargeField
from isocharge.train.config import FitConfig, TrainingConfig
from isocharge.train.network import Features, InverseNetwork, project
from isocharge.train.split import Presses, domain_of, split_by_position

Progress = Callable[[int, int, str], None]
"""Called with (steps done, steps in all, a line about the state)."""

WARM_UP = 0.15
"""Share of the steps that learn the mean by least squares."""

MUON_RATE = 6.0
"""Muon's rate over Adam's: a step of Muon has a given size whatever the gradient."""

REPORT_EVERY = 200
"""Steps between two calls of the progress function."""


@dataclass(frozen=True)
class Fit:
    """A trained model and what it was not shown.

    Attributes:
        network: The model.
        field: The forward map inside it.
        held: Presses kept for measuring errors.
        config: What it was trained with.
    """

    network: InverseNetwork
    field: ChargeField
    held: Presses
    config: FitConfig


def fit_network(dataset: Dataset, config: FitConfig, progress: Progress | None = None) -> Fit:
    """Train on a dataset.

    Args:
        dataset: Clean charges; noise is added here.
        config: Sizes, steps, seed.
        progress: Told about steps and loss.

    Raises:
        ConfigError: If the noise level is unknown or has no noise.
        DatasetError: If the dataset cannot train an inverse.
        TrainingError: If the loss is not finite.
    """
    training = config.training
    noise = noise_model(training.noise)
    if noise.white <= 0.0:
        raise ConfigError(
            f"training.noise: expected a level with noise (the misfit is in its units), got {noise.name!r}"
        )
    train, held = split_by_position(dataset, training.hold_out, training.seed)
    with _threads_and_seed(training):
        field = ChargeField.fit(
            domain_of(dataset), train.contact, train.charge_pC, (held.contact, held.charge_pC), noise
        )
        network = InverseNetwork(
            field, Features.fit(train.charge_pC), noise, config.network.hidden, config.network.nearest_hidden
        )
        _Training(network, field, train, training, progress).run()
    network.eval()
    return Fit(network, field, held, config)


@contextmanager
def _threads_and_seed(training: TrainingConfig) -> Iterator[None]:
    """Seed and thread count for the block, the caller's own restored after it.

    BLAS is held to the same number: its threads spin at barriers, and a busy second core makes them many times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(training.threads)
    try:
        with threadpool_limits(training.threads, user_api="blas"), torch.random.fork_rng(devices=[]):
            torch.manual_seed(training.seed)
            yield
    finally:
        torch.set_num_threads(threads)


class _Training:
    """One run: data as tensors, a generator, and the two loops."""

    def __init__(
        self,
        network: InverseNetwork,
        field: ChargeField,
        train: Presses,
        config: TrainingConfig,
        progress: Progress | None,
    ) -> None:
        self.network, self.config, self.progress = network, config, progress
        self.charge = torch.tensor(train.charge_pC).float()
        self.unit = torch.tensor(field.domain.to_unit(train.contact)).float()
        self.random = torch.Generator().manual_seed(config.seed)

    def run(self) -> None:
        warm_up = round(WARM_UP * self.config.steps)

        def contact_loss(step: int, charge: Tensor, unit: Tensor) -> Tensor:
            mean, log_std = self.network.posterior(self._noisy(charge))
            return _start_loss(mean, log_std, unit) if step < warm_up else _likelihood_loss(mean, log_std, unit)

        def nearest_loss(step: int, charge: Tensor, unit: Tensor) -> Tensor:
            if step < round(WARM_UP * self.config.nearest_steps):
                return ((self.network.propose(self._noisy(charge)) - unit) ** 2).sum(dim=1).mean()
            return self._misfit_loss(self._noisy(self._corrupt(charge)))

        total = self.config.steps + self.config.nearest_steps
        self._descend(self.network.contact, contact_loss, self.config.steps, (0, total), "contact")
        self._descend(
            self.network.nearest, nearest_loss, self.config.nearest_steps, (self.config.steps, total), "misfit"
        )

    def _descend(
        self,
        part: nn.Module,
        loss_of: Callable[[int, Tensor, Tensor], Tensor],
        steps: int,
        position: tuple[int, int],
        label: str,
    ) -> None:
        """Minimise a loss over one part of the network."""
        optimisers = _optimisers(part, self.config.learning_rate)
        schedules = [
            torch.optim.lr_scheduler.OneCycleLR(each, each.defaults["lr"], total_steps=steps + 1, pct_start=0.1)
            for each in optimisers
        ]
        for step, rows in zip(range(steps), self._batches(), strict=False):
            loss = loss_of(step, self.charge[rows], self.unit[rows])
            part.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            for optimiser, schedule in zip(optimisers, schedules, strict=True):
                optimiser.step()
                schedule.step()
            if step % REPORT_EVERY == 0 or step == steps - 1:
                self._report(loss, position[0] + step + 1, position[1], label)

    def _report(self, loss: Tensor, done: int, total: int, label: str) -> None:
        value = loss.item()
        if not torch.isfinite(loss):
            raise TrainingError(f"the {label} loss is {value} at step {done} of {total}; lower training.learning_rate")
        if self.progress:
            self.progress(done, total, f"{label} loss {value:.3f}")

    def _batches(self) -> Iterator[Tensor]:
        """Row numbers, every sample once an epoch, for ever."""
        batch = min(self.config.batch, len(self.charge))
        while True:
            order = torch.randperm(len(self.charge), generator=self.random)
            yield from torch.split(order, batch)[: len(order) // batch]

    def _normal(self, shape: torch.Size) -> Tensor:
        return torch.randn(shape, generator=self.random)

    def _noisy(self, charge: Tensor) -> Tensor:
        return charge + self.network.sigma(charge) * self._normal(charge.shape)

    def _corrupt(self, charge: Tensor) -> Tensor:
        """A quarter of the rows as they are, 30 % with wrong gains, 15 % with a dead electrode, 30 % scaled."""
        count, n_electrode = charge.shape
        kind = torch.rand(count, 1, generator=self.random)
        gain = torch.exp(0.15 * self._normal(charge.shape))
        dead = torch.randint(n_electrode, (count, 1), generator=self.random) == torch.arange(n_electrode)
        scale = 10.0 ** (2.0 * torch.rand(count, 1, generator=self.random) - 1.0)
        wrong = torch.where(kind < 0.55, charge * gain, torch.where(kind < 0.7, charge * ~dead, charge * scale))
        return torch.where(kind < 0.25, charge, wrong)

    def _misfit_loss(self, charge: Tensor) -> Tensor:
        """log(1 + misfit^2) of the proposal, plus a pull towards the domain, outside of which there is no slope."""
        proposal = self.network.propose(charge)
        distance = self.network.distance(charge, project(proposal))
        beyond = torch.stack([proposal[:, :2].norm(dim=1), proposal[:, 2].abs()]) - 1.0
        outside = (beyond.clamp(min=0.0) ** 2).sum(dim=0)
        return (torch.log1p(distance**2) + 3.0 * outside).mean()


def _optimisers(part: nn.Module, rate: float) -> list[torch.optim.Optimizer]:
    """Muon (Jordan et al. 2024) for the hidden layers' matrices, Adam with a short memory for the rest.

    At equal steps the pair halves the error that plain Adam reaches on clean charges.
    """
    matrices = [parameter for parameter in part.parameters() if parameter.ndim == 2][1:-1]
    hidden = {id(parameter) for parameter in matrices}
    rest = [parameter for parameter in part.parameters() if id(parameter) not in hidden]
    adam = torch.optim.Adam(rest, lr=rate, betas=(0.9, 0.98))
    return [torch.optim.Muon(matrices, lr=MUON_RATE * rate, weight_decay=0.0), adam] if matrices else [adam]


def _start_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Least squares for the mean; the deviations follow it without pulling at it."""
    squares = (mean - unit) ** 2
    follow = log_std + 0.5 * squares.detach() * torch.exp(-2.0 * log_std)
    return (30.0 * squares + 0.1 * follow).sum(dim=1).mean()


def _likelihood_loss(mean: Tensor, log_std: Tensor, unit: Tensor) -> Tensor:
    """Negative logarithm of a Gaussian likelihood, but for a constant."""
    return (log_std + 0.5 * ((mean - unit) * torch.exp(-log_std)) ** 2).sum(dim=1).mean()
