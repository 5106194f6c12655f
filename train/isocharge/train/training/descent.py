"""Training of one network by gradient descent with early stopping.

The usual optimiser is SOAP (`isocharge.train.training.soap`). The learning rate increases during the first tenth of the
steps and then decreases to zero along a cosine.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from isocharge.common.errors import TrainingError
from isocharge.common.progress import report
from isocharge.train.training.soap import Soap

RATE_INCREASE_FRACTION = 0.1
"""Fraction of the steps during which the learning rate increases, dimensionless."""

SLOW_RATE_FACTOR = 0.1
"""Learning rate of slow parameters, relative to the learning rate of the other parameters."""

INITIAL_RATE = 0.04
"""Learning rate of the first step, relative to the largest rate."""

REPORT_EVERY = 200
"""Largest number of steps between two evaluations on the validation data."""

RETRY_RATE_FACTOR = 0.5
"""Factor of the learning rate after a loss that is not finite."""

MAX_RETRIES = 8
"""Largest number of losses that are not finite. After more of them, the training is given up."""


class Optimiser(Protocol):
    """An optimiser: `Soap`, or one of PyTorch.

    Attributes:
        param_groups: Parameters and settings of each group. The key `lr` is the learning rate.
    """

    param_groups: list[dict[str, Any]]

    def step(self) -> Any:
        """Change the parameters."""


def soap_optimiser(stage: "TrainingStage") -> list[Optimiser]:
    """Create the optimiser SOAP for the network of a training stage.

    The slow parameters of the stage have a smaller learning rate. Weights that require no gradient, such as rounded
    weights, are not trained.

    Args:
        stage: Training stage with the network and its slow parameters.

    Returns:
        A list with the optimiser.
    """
    # The operator == would compare the elements of tensors, so the tensors are compared by their identity.
    slow_ids = {id(parameter) for parameter in stage.slow_parameters}
    trained_parameters = [parameter for parameter in stage.network.parameters() if parameter.requires_grad]
    slow_parameters = [parameter for parameter in trained_parameters if id(parameter) in slow_ids]
    other_parameters = [parameter for parameter in trained_parameters if id(parameter) not in slow_ids]
    # Descent multiplies the learning rate of each group by its `rate_factor`.
    groups: list[dict[str, Any]] = [
        {"params": other_parameters, "rate_factor": 1.0},
        {"params": slow_parameters, "rate_factor": SLOW_RATE_FACTOR},
    ]
    groups_with_parameters = [group for group in groups if group["params"]]
    return [Soap(groups_with_parameters)]


@dataclass(frozen=True)
class TrainingStage:
    """Definition of the training of one network.

    Attributes:
        name: Name of the stage, for checkpoints and messages.
        network: Network to train.
        loss: Function that computes the loss of a new batch from the number of the step and a random generator.
        score: Function that returns the loss on validation data and a text for the progress report.
        steps: Number of steps.
        warm_up_steps: Number of steps at the beginning that minimise another loss. The weights of these steps are never
            kept as the best weights.
        rate_factor: Factor by which the learning rate of the settings is multiplied.
        largest_gradient: Largest norm of the gradient after the warm-up. A larger gradient is scaled to this norm.
        slow_parameters: Parameters of the network that have a smaller learning rate in SOAP.
        optimisers: Function that creates the optimisers for the network of a stage. Each of their groups of parameters
            has a key `rate_factor`, by which the learning rate of the group is multiplied.
    """

    name: str
    network: nn.Module
    loss: Callable[[int, torch.Generator], Tensor]
    score: Callable[[], tuple[float, str]]
    steps: int
    warm_up_steps: int = 0
    _: KW_ONLY
    rate_factor: float = 1.0
    largest_gradient: float = math.inf
    slow_parameters: tuple[Tensor, ...] = ()
    optimisers: Callable[["TrainingStage"], Sequence[Optimiser]] = soap_optimiser


class Descent:
    """One run of a training stage. An interrupted run can be continued from a checkpoint.

    Args:
        stage: Network, loss and validation score.
        rate: Largest learning rate.
        patience: Number of steps without a better validation score after which the training stops.
        seed: Seed of the batches and the noise.

    Attributes:
        best_score: Lowest validation score so far.
        best_weights: State of the network at this score. During the warm-up, the state at the latest validation.
    """

    def __init__(self, stage: TrainingStage, rate: float, patience: int, seed: int) -> None:
        """Prepare a training, which begins with the present weights of the network.

        Args:
            stage: Network, loss and validation score.
            rate: Largest learning rate, by which the `rate_factor` of the stage is multiplied.
            patience: Number of steps without a better validation score after which the training ends.
            seed: Seed of the batches and of the noise.
        """
        self.stage = stage
        self.patience = patience
        self.rate = rate
        self.retry_count = 0
        self.optimisers = stage.optimisers(stage)
        self.random = torch.Generator().manual_seed(seed)
        self.step = 0
        self.best_score = math.inf
        self.best_step = 0
        self.best_weights = copy.deepcopy(stage.network.state_dict())

    def run(self) -> None:
        """Train the network, and finally restore the weights with the best validation score.

        The training ends after all steps of the stage, or earlier if the validation score has not improved in the last
        `patience` steps. In both cases, the last step is followed by a validation.

        If a loss, a gradient or a validation score is not finite, the best weights so far are restored. The training
        continues from them with new optimisers and half of the learning rate.

        Raises:
            TrainingError: If the loss is not finite in more than `MAX_RETRIES` steps, or no validation score is finite.
        """
        validation_interval = min(REPORT_EVERY, self.patience)
        is_stalled = False
        while self.step < self.stage.steps and not is_stalled:
            loss = self.take_step()
            is_last_step = self.step == self.stage.steps
            if is_last_step or self.step % validation_interval == 0:
                self._evaluate(loss.item())
                is_stalled = self._is_stalled()

        if not math.isfinite(self.best_score):
            raise TrainingError(
                f"the {self.stage.name} network has no finite validation score after {self.step} steps; lower "
                "training.learning_rate, or check the presses"
            )
        self.stage.network.load_state_dict(self.best_weights)

    def take_step(self) -> Tensor:
        """Change the weights by one step of the optimisers, and return the loss of the batch before the change.

        The method first sets the learning rates of this step. After the warm-up, a gradient whose norm exceeds
        `largest_gradient` is scaled down to this norm. If the loss or the gradient is not finite, the best weights so
        far are restored instead.

        Raises:
            TrainingError: If too many losses were not finite.
        """
        stage = self.stage
        rate = self.rate * stage.rate_factor * _relative_rate(self.step / stage.steps)
        for optimiser in self.optimisers:
            for group in optimiser.param_groups:
                group["lr"] = rate * group["rate_factor"]

        loss = stage.loss(self.step, self.random)
        stage.network.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        is_warm_up = self.step < stage.warm_up_steps
        largest_gradient = math.inf if is_warm_up else stage.largest_gradient
        gradient_norm = torch.nn.utils.clip_grad_norm_(stage.network.parameters(), largest_gradient)
        self.step += 1
        if torch.isfinite(loss) and torch.isfinite(gradient_norm):
            for optimiser in self.optimisers:
                optimiser.step()
        else:
            self._restore_best_weights(loss.item())
        return loss

    def _restore_best_weights(self, loss: float) -> None:
        """Continue from the best weights so far, with new optimisers and a smaller learning rate.

        Args:
            loss: Loss of the latest batch.

        Raises:
            TrainingError: If this has happened too often.
        """
        self.retry_count += 1
        if self.retry_count > MAX_RETRIES:
            raise TrainingError(
                f"the {self.stage.name} loss is {loss} at step {self.step} of {self.stage.steps}, after {MAX_RETRIES} "
                "earlier losses that were not finite; lower training.learning_rate"
            )
        self.rate *= RETRY_RATE_FACTOR
        self.optimisers = self.stage.optimisers(self.stage)
        self.stage.network.load_state_dict(self.best_weights)

    def _evaluate(self, loss: float) -> None:
        """Compute the validation score, keep the weights if the score is the best so far, and report the progress.

        Weights from the warm-up are only kept until the first validation after the warm-up, because the warm-up steps
        minimise another loss.

        Args:
            loss: Loss of the latest batch.

        Raises:
            TrainingError: If the score is not finite, and too many losses were not finite.
        """
        with torch.no_grad():
            score, text = self.stage.score()
        is_warm_up = self.step <= self.stage.warm_up_steps
        if not math.isfinite(score):
            self._restore_best_weights(loss)
        elif is_warm_up or score < self.best_score:
            self.best_weights = copy.deepcopy(self.stage.network.state_dict())
            if not is_warm_up:
                self.best_score = score
                self.best_step = self.step
        report(f"training the {self.stage.name} network", self.step, self.stage.steps, f"loss {loss:.3f}, {text}")

    def _is_stalled(self) -> bool:
        """Return whether the validation score has not improved for `patience` steps. Warm-up steps are not counted."""
        first_counted_step = max(self.best_step, self.stage.warm_up_steps)
        return self.step - first_counted_step >= self.patience


def _relative_rate(progress: float) -> float:
    """Return the learning rate divided by its largest value.

    During the first steps (`RATE_INCREASE_FRACTION`), the relative rate increases from `INITIAL_RATE` to 1 along half a
    period of a cosine. The relative rate then decreases from 1 to 0 along another half period of a cosine.

    Args:
        progress: Number of completed steps divided by the number of all steps.
    """
    if progress < RATE_INCREASE_FRACTION:
        increase = 0.5 * (1.0 - math.cos(math.pi * progress / RATE_INCREASE_FRACTION))  # from 0 to 1
        return INITIAL_RATE + (1.0 - INITIAL_RATE) * increase
    angle = math.pi * (progress - RATE_INCREASE_FRACTION) / (1.0 - RATE_INCREASE_FRACTION)  # from 0 to pi
    return 0.5 * (1.0 + math.cos(angle))
