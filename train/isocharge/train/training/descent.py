"""Training of one network by gradient descent with the optimiser SOAP.

SOAP applies Adam in the eigenbasis of the second moments of the gradient. Let G be the gradient of a weight matrix. The
optimiser averages the matrices G G^T and G^T G over the steps. In the basis of the eigenvectors of these averages, the
entries of the gradient are nearly uncorrelated. Adam scales each entry separately. In this basis, Adam therefore comes
close to a second-order method (Vyas et al., 2024, arXiv 2409.11321, algorithm 3). The eigenvectors change slowly, and
are updated every few steps by one orthogonal iteration.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from isocharge.common.errors import TrainingError
from isocharge.common.progress import report
from isocharge.train.training.network import TrainablePerceptron

DECAY = 0.95
"""Decay rate of the moving averages of the gradient and of its second moments."""

BASIS_PERIOD = 10
"""Number of steps between two updates of the eigenvectors."""


class Soap:
    """The optimiser SOAP for one parameter. A parameter with one dimension, such as a bias, is trained by Adam.

    The class is not derived from `torch.optim.Optimizer`, because creating the first object of that class imports
    PyTorch's compiler. This import takes more than a tenth of the time of a training.

    Attributes:
        parameter: The parameter, a vector or a matrix.
        step_count: Number of completed steps.
        mean_gradient: Moving average of the gradient.
        mean_square: Moving average of the squared entries of the gradient in the eigenbasis.
        moments: Moving averages of G G^T and of G^T G for a matrix; empty for a vector.
        bases: Eigenbases of the moments.
    """

    def __init__(self, parameter: Tensor) -> None:
        """Prepare the first step: all averages are zero, and the eigenbases are identity matrices.

        A matrix with the gradient G has two moments with their eigenbases: the average of G G^T for its rows, and the
        average of G^T G for its columns. A vector has no moments.

        Args:
            parameter: The parameter, a vector or a matrix.
        """
        self.parameter = parameter
        self.step_count = 0
        self.mean_gradient = torch.zeros_like(parameter)
        self.mean_square = torch.zeros_like(parameter)
        sizes = parameter.shape if parameter.ndim == 2 else ()
        self.moments = [torch.zeros(size, size) for size in sizes]
        self.bases = [torch.eye(size) for size in sizes]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Change the parameter by one step of SOAP (Vyas et al., 2024, algorithm 3).

        The averaged gradient is rotated into the eigenbasis. As in Adam, each entry of the rotated gradient is divided
        by the root mean square of this entry over the past steps. These ratios are rotated back, and give the direction
        of the step.

        The ratios are limited to the range from -1 to 1. Larger ratios arise only if an update of the eigenvectors
        moves a part of the averaged gradient to an entry whose mean square is nearly zero. Without the limit, the step
        would then be arbitrarily long.

        Args:
            rate: Learning rate, which is approximately the change of each entry.
        """
        # Update the moving averages. The eigenbases of the two moments are updated at times, each by one step of an
        # orthogonal iteration.
        gradient = self.parameter.grad
        assert gradient is not None
        new_weight = 1.0 - DECAY
        if self.moments:
            row_moment, column_moment = self.moments
            row_moment.lerp_(gradient @ gradient.T, new_weight)
            column_moment.lerp_(gradient.T @ gradient, new_weight)
            if self.step_count % BASIS_PERIOD == 0:
                pairs = zip(self.moments, self.bases, strict=True)
                self.bases = [torch.linalg.qr(moment @ basis).Q for moment, basis in pairs]
        self.step_count += 1
        self.mean_gradient.lerp_(gradient, new_weight)
        self.mean_square.lerp_(_rotate(gradient, self.bases) ** 2, new_weight)

        # The moving averages begin at zero. The averages are therefore divided by the total weight of all gradients so
        # far. The ratio contains the weight twice: for the averaged gradient, and below the root.
        total_weight = 1.0 - DECAY**self.step_count
        root_mean_square = torch.sqrt(self.mean_square / total_weight) + torch.finfo(gradient.dtype).tiny  # never zero
        ratio = _rotate(self.mean_gradient, self.bases) / (total_weight * root_mean_square)
        ratio.clamp_(-1.0, 1.0)
        direction = _rotate(ratio, [basis.T for basis in self.bases])
        self.parameter.add_(direction, alpha=-rate)


def _rotate(matrix: Tensor, bases: Sequence[Tensor]) -> Tensor:
    """Return a matrix in the basis given by the columns of two matrices. Without bases, return the matrix unchanged."""
    if not bases:
        return matrix
    row_basis, column_basis = bases
    return row_basis.T @ matrix @ column_basis


RATE_INCREASE_FRACTION = 0.1
"""Fraction of the steps during which the learning rate increases, dimensionless."""

REPORT_EVERY = 200
"""Number of steps whose mean loss is reported and checked. The loss fluctuates from batch to batch."""

MAX_LOSS_INCREASE = 1.0
"""Increase of the mean loss above its smallest value after which a training continues from earlier weights.

Loss functions are logarithms of a likelihood, or mean squares below 1. In a usual training, the mean loss increases by
up to 0.2.
"""


@dataclass(frozen=True)
class TrainingStage:
    """Definition of the training of one network.

    Attributes:
        name: Name of the network, for messages.
        network: Network to train.
        loss: Function that computes the loss of a new batch, which a random generator selects.
        steps: Number of steps.
        rate: Largest learning rate.
        seed: Seed of the batches and the noise.
    """

    name: str
    network: TrainablePerceptron
    loss: Callable[[torch.Generator], Tensor]
    steps: int
    rate: float
    seed: int

    def run(self) -> None:
        """Train the network.

        The learning rate increases to its largest value during the first tenth of the steps, and then decreases to zero
        along a cosine. Weights that require no gradient, such as rounded weights, are not trained.

        Rarely, a few steps destroy what a network has learned, and the rest of the training does not repair the
        network. If the mean loss increases by more than `MAX_LOSS_INCREASE`, the training therefore continues from the
        weights before the latest two reports, with half of the learning rate.

        Raises:
            TrainingError: If a loss is not finite.
        """
        parameters = [parameter for parameter in self.network.parameters() if parameter.requires_grad]
        optimisers = [Soap(parameter) for parameter in parameters]
        random = torch.Generator().manual_seed(self.seed)
        largest_rate = self.rate
        losses: list[float] = []  # since the latest report
        smallest_mean_loss = math.inf
        checkpoints: deque[list[Tensor]] = deque(maxlen=2)  # weights at the latest two reports
        for step in range(self.steps):
            # Change the weights by one step of the optimisers.
            loss = self.loss(random)
            losses.append(loss.item())
            if not math.isfinite(losses[-1]):
                raise TrainingError(
                    f"the loss of the {self.name} network is {losses[-1]:g} at step {step + 1} of {self.steps}; lower "
                    "training.learning_rate, or check the presses"
                )
            self.network.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            rate = largest_rate * relative_rate(step / self.steps)
            for optimiser in optimisers:
                optimiser.step(rate)
            if len(losses) < REPORT_EVERY and step + 1 < self.steps:
                continue

            # Report the mean loss, and return to earlier weights if it has increased too much.
            mean_loss = math.fsum(losses) / len(losses)
            losses = []
            report(f"training the {self.name} network", step + 1, self.steps, f"loss {mean_loss:.3f}")
            if mean_loss > smallest_mean_loss + MAX_LOSS_INCREASE:
                largest_rate *= 0.5
                # `checkpoints[0]` contains the weights of the older of the latest two reports.
                for parameter, earlier_weights in zip(parameters, checkpoints[0], strict=True):
                    parameter.data.copy_(earlier_weights)
            else:
                smallest_mean_loss = min(smallest_mean_loss, mean_loss)
                checkpoints.append([parameter.detach().clone() for parameter in parameters])


def relative_rate(progress: float) -> float:
    """Return the learning rate divided by its largest value. The rate rises linearly, then falls along half a cosine.

    Args:
        progress: Number of completed steps divided by the number of all steps.
    """
    if progress < RATE_INCREASE_FRACTION:
        return progress / RATE_INCREASE_FRACTION
    angle = math.pi * (progress - RATE_INCREASE_FRACTION) / (1.0 - RATE_INCREASE_FRACTION)  # from 0 to pi
    return 0.5 * (1.0 + math.cos(angle))
