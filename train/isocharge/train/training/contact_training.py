"""Training of the contact perceptron: its losses and the noise of the charges."""

import torch
from scipy.special import chdtr, chdtrc
from torch import Tensor

from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.network import InverseNetwork, Posterior, as_tensor

MAX_NORMAL_ERROR = 2.0
"""Error in standard deviations above which the loss of the covariance grows with the logarithm of the error instead of
its square."""

MIN_SINE = 0.003
"""Smallest sine of an angle of the correlations in the loss. Smaller sines count as this value."""


def mean_loss(posterior: Posterior, target: Tensor) -> Tensor:
    """Compute half of the weighted squared errors of the mean of each press, shape (n,).

    The gradient of a Gaussian likelihood with respect to the mean is divided by the variance. Therefore, a network
    learns the mean slowly where it overestimates the standard deviation (Seitzer et al., 2022, arXiv 2203.09168). In
    this loss, the squared errors of a Gaussian likelihood are multiplied by the estimated standard deviation. These
    factors are scaled so that their mean over the presses is 1.

    Args:
        posterior: Estimated unit coordinates with their standard deviations.
        target: Unit coordinates that the mean should have, shape (n, 3).
    """
    std = torch.exp(posterior.log_std.detach())
    squares = (posterior.mean - target) ** 2 / (std * std.mean(dim=0))
    return 0.5 * squares.sum(dim=1)


def covariance_loss(posterior: Posterior, error: Tensor) -> Tensor:
    """Compute the sum of the losses of the standard deviations and of the correlations for each press, shape (n,).

    Both are negative logarithms of likelihoods, without constants. The standard deviations are fitted to the errors,
    and the correlations to the errors divided by the standard deviations. The likelihoods are Gaussian for errors up to
    `MAX_NORMAL_ERROR` standard deviations, and have longer tails beyond (Huber 1964, proposal 2). Where the map from
    contacts to charges nearly folds, the errors have longer tails than a normal distribution. A Gaussian likelihood
    would enlarge the intervals of all contacts because of these errors.

    Args:
        posterior: Standard deviations and angles of the correlations (`isocharge.train.training.folded_network`).
        error: Errors of the unit coordinates, shape (n, 3), which are constants in this loss.
    """
    deviation = error.detach() * torch.exp(-posterior.log_std)
    std_loss = posterior.log_std.sum(dim=1) + _half_long_tailed_square(deviation)

    # The Cholesky factor of the correlations has the rows (1, 0, 0), (cos a, sin a, 0) and (cos b, sin b cos c,
    # sin b sin c), where the angles a, b and c are pi / 2 + turn. It is inverted row by row, which gives errors with
    # unit covariance.
    sin_a, sin_b, sin_c = torch.cos(posterior.turn).clamp(min=MIN_SINE).unbind(dim=1)
    cos_a, cos_b, cos_c = torch.sin(-posterior.turn).unbind(dim=1)
    x_deviation, y_deviation, force_deviation = deviation.detach().unbind(dim=1)
    white_y = (y_deviation - cos_a * x_deviation) / sin_a
    white_force = (force_deviation - cos_b * x_deviation - sin_b * cos_c * white_y) / (sin_b * sin_c)
    log_determinant = torch.log(sin_a * sin_b * sin_c)
    return std_loss + log_determinant + _half_long_tailed_square(torch.stack([white_y, white_force], dim=1))


def _half_long_tailed_square(deviation: Tensor) -> Tensor:
    """Compute half of the sum of the squares of each row, shape (n,). Large squares are replaced by smaller values.

    These values increase logarithmically. At `MAX_NORMAL_ERROR`, the logarithmic function has the same value and the
    same slope as the square. The result is divided by the mean square of a normal variable with this limit. If the
    errors are normally distributed, the minimum of the loss is therefore at their standard deviation.

    Args:
        deviation: Errors in standard deviations, shape (n, k).
    """
    squares = deviation**2
    largest_square = MAX_NORMAL_ERROR**2
    tail = largest_square * (1.0 + torch.log(squares.clamp(min=largest_square) / largest_square))
    long_tailed_square = torch.where(squares < largest_square, squares, tail)
    # The mean square of a limited normal variable is the integral of the square within the limits, which follows from a
    # chi-squared distribution with three degrees of freedom, plus the squared limit times the probability beyond them.
    mean_square = float(chdtr(3, largest_square) + largest_square * chdtrc(1, largest_square))
    return 0.5 * long_tailed_square.sum(dim=1) / mean_square


def contact_stage(
    network: InverseNetwork,
    train: LabelledPresses,
    noise: Noise,
    config: TrainingConfig,
) -> TrainingStage:
    """Define the training of the contact perceptron on charges with fresh noise.

    Args:
        network: The network, whose contact perceptron is trained.
        train: Presses for training.
        noise: Noise that is added to the charges in every step.
        config: Number of steps, batch size, learning rate and seed.
    """
    domain = network.domain
    charge = as_tensor(train.charge)
    noise_std = as_tensor(noise.sigma(train.charge))
    unit_contact = as_tensor(domain.to_unit(train.contact))

    def loss(random: torch.Generator) -> Tensor:
        """Return the loss of a random batch with new noise.

        Args:
            random: Random number generator of the batch and of its noise.
        """
        rows = torch.randint(len(charge), (config.batch,), generator=random)
        target = unit_contact[rows]
        posterior = network.posterior(torch.normal(charge[rows], noise_std[rows], generator=random))
        # The two losses have separate gradients. The first loss does not change the outputs for the covariance, and the
        # second loss does not change the mean.
        return (mean_loss(posterior, target) + covariance_loss(posterior, target - posterior.mean)).mean()

    sizes = config.sizes(network.features.n_electrode)
    rate = config.learning_rate * sizes.rate_factor
    return TrainingStage("contact", network.contact, loss, sizes.steps, rate, config.seed)
