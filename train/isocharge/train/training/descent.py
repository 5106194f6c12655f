"""Training of one network by gradient descent with the optimiser SOAP."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from isocharge.common.errors import TrainingError
from isocharge.common.progress import report
from isocharge.train.training.soap import Soap

RATE_INCREASE_FRACTION = 0.1
"""Fraction of the steps during which the learning rate increases, dimensionless."""

REPORT_EVERY = 200
"""Number of steps between two progress reports. The weights are stored as often."""

MAX_RETRIES = 4
"""Largest number of times that a training continues from stored weights. After that, it is given up."""


@dataclass(frozen=True)
class TrainingStage:
    """Definition of the training of one network.

    Attributes:
        name: Name of the network, for messages.
        network: Network to train.
        loss: Function that computes the loss of a new batch from the fraction of completed steps, 0 to 1, and a random
            generator.
        steps: Number of steps.
        rate: Largest learning rate.
        seed: Seed of the batches and the noise.
    """

    name: str
    network: nn.Module
    loss: Callable[[float, torch.Generator], Tensor]
    steps: int
    rate: float
    seed: int

    def run(self) -> None:
        """Train the network.

        The learning rate increases to its largest value during the first tenth of the steps, and then decreases to zero
        along a cosine. Weights that require no gradient, such as rounded weights, are not trained.

        If a loss or its gradient is not finite, the training continues from the latest stored weights with half of the
        learning rate.

        Raises:
            TrainingError: If this happens more than `MAX_RETRIES` times.
        """
        parameters = [parameter for parameter in self.network.parameters() if parameter.requires_grad]
        optimiser = Soap(parameters)
        rate = self.rate
        retry_count = 0
        stored_weights = copy.deepcopy(self.network.state_dict())
        random = torch.Generator().manual_seed(self.seed)
        for step in range(self.steps):
            progress = step / self.steps
            loss = self.loss(progress, random)
            self.network.zero_grad(set_to_none=False)
            loss.backward()  # type: ignore[no-untyped-call]
            gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
            if not torch.isfinite(loss + nn.utils.get_total_norm(gradients)):
                retry_count += 1
                if retry_count > MAX_RETRIES:
                    raise TrainingError(
                        f"the loss of the {self.name} network is {loss.item():g} at step {step + 1} of {self.steps}, "
                        f"also after {MAX_RETRIES} attempts with smaller learning rates; lower training.learning_rate, "
                        "or check the presses"
                    )
                self.network.load_state_dict(stored_weights)
                optimiser = Soap(parameters)
                rate *= 0.5
                continue
            is_reported = (step + 1) % REPORT_EVERY == 0 or step + 1 == self.steps
            if is_reported:
                stored_weights = copy.deepcopy(self.network.state_dict())
            optimiser.step(rate * relative_rate(progress))
            if is_reported:
                report(f"training the {self.name} network", step + 1, self.steps, f"loss {loss.item():.3f}")


def relative_rate(progress: float) -> float:
    """Return the learning rate divided by its largest value.

    Args:
        progress: Number of completed steps divided by the number of all steps.
    """
    if progress < RATE_INCREASE_FRACTION:
        return progress / RATE_INCREASE_FRACTION
    angle = math.pi * (progress - RATE_INCREASE_FRACTION) / (1.0 - RATE_INCREASE_FRACTION)  # from 0 to pi
    return 0.5 * (1.0 + math.cos(angle))
