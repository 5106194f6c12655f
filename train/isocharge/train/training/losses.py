"""Loss functions of the contact and misfit perceptrons, and noise that is added to charges during the training."""

from statistics import NormalDist

import torch
from torch import Tensor

from isocharge.train.data.channel_noise import Noise
from isocharge.train.training.network import Posterior

MAX_NORMAL_ERROR = 2.0
"""Error in standard deviations above which the loss of the covariance grows with the logarithm of the error instead of
its square."""

MIN_SINE = 0.003
"""Smallest sine of an angle of the correlations in the loss. Smaller sines count as this value."""


def fresh_noise(charge: Tensor, noise: Noise, random: torch.Generator) -> Tensor:
    """Draw normally distributed noise for charges.

    Args:
        charge: Charges without noise, any shape, pC.
        noise: White noise and noise of the gains.
        random: Random number generator.

    Returns:
        The noise, same shape as the charges, pC.
    """
    white = torch.as_tensor(noise.white, dtype=torch.float32)
    gain = torch.as_tensor(noise.gain, dtype=torch.float32)
    sigma = torch.hypot(white, gain * charge)
    return sigma * torch.randn(charge.shape, generator=random)


def contact_loss(posterior: Posterior, target: Tensor, error: Tensor) -> Tensor:
    """Compute the loss of the contact perceptron: that of the mean plus that of the covariance.

    The two losses have separate gradients. The first loss does not change the outputs for the covariance, and the
    second loss does not change the mean.

    Args:
        posterior: Estimated unit coordinates with their standard deviations and correlations.
        target: Unit coordinates that the mean should have, shape (n, 3): the true contact or a better estimate of the
            posterior mean.
        error: Errors of the mean that the covariance should describe, shape (n, 3).
    """
    return (mean_loss(posterior, target) + covariance_loss(posterior, error)).mean()


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
    """Compute the loss of the standard deviations plus that of the correlations of each press, shape (n,).

    Both are negative logarithms of likelihoods, without constants. The standard deviations are fitted to the errors,
    and the correlations to the errors divided by the standard deviations. The likelihoods are Gaussian for errors up to
    `MAX_NORMAL_ERROR` standard deviations, and have longer tails beyond (Huber 1964, proposal 2). Where the map from
    contacts to charges nearly folds, the errors have longer tails than a normal distribution. A Gaussian likelihood
    would enlarge the intervals of all contacts because of these errors.

    Args:
        posterior: Standard deviations and angles of the correlations (`isocharge.train.training.folding`).
        error: Errors of the unit coordinates, shape (n, 3), which are constants in this loss.
    """
    deviation = error.detach() * torch.exp(-posterior.log_std)
    std_loss = posterior.log_std.sum(dim=1) + _half_long_tailed_square(deviation)

    # The Cholesky factor of the correlations has the rows (1, 0, 0), (cos a, sin a, 0) and (cos b, sin b cos c,
    # sin b sin c). It is inverted row by row, which gives errors with unit covariance.
    sin_a, sin_b, sin_c = torch.cos(posterior.turn).clamp(min=MIN_SINE).unbind(dim=1)
    cos_a, cos_b, cos_c = torch.sin(-posterior.turn).unbind(dim=1)
    x_deviation, y_deviation, force_deviation = deviation.detach().unbind(dim=1)
    white_y = (y_deviation - cos_a * x_deviation) / sin_a
    white_force = (force_deviation - cos_b * x_deviation - sin_b * cos_c * white_y) / (sin_b * sin_c)
    log_determinant = torch.log(sin_a * sin_b * sin_c)
    return std_loss + log_determinant + _half_long_tailed_square(torch.stack([white_y, white_force], dim=1))


def _half_long_tailed_square(deviation: Tensor) -> Tensor:
    """Return half of the sum of the squares of each row, shape (n,), with logarithms instead of large squares.

    At `MAX_NORMAL_ERROR`, the logarithmic function has the same value and the same slope as the square. The result is
    divided by the mean square of a normal variable with this limit. If the errors are normally distributed, the minimum
    of the loss is therefore at their standard deviation.

    Args:
        deviation: Errors in standard deviations, shape (n, k).
    """
    squares = deviation**2
    largest_square = MAX_NORMAL_ERROR**2
    tail = largest_square * (1.0 + torch.log(squares.clamp(min=largest_square) / largest_square))
    long_tailed_square = torch.where(squares < largest_square, squares, tail)
    return 0.5 * long_tailed_square.sum(dim=1) / mean_square_of_limited_normal(MAX_NORMAL_ERROR)


def mean_square_of_limited_normal(limit: float) -> float:
    """Return the mean square of a standard normal variable whose absolute value is limited to `limit`.

    The mean square is the integral of the square within the limits, plus the squared limit times the probability beyond
    the limits.
    """
    normal = NormalDist()
    probability_within = normal.cdf(limit) - normal.cdf(-limit)
    square_within = probability_within - 2.0 * limit * normal.pdf(limit)  # integration by parts
    return square_within + limit**2 * (1.0 - probability_within)


def focused_squared_distance(vector: Tensor, target: Tensor, focus: float) -> Tensor:
    """Compute a weighted mean of the squared distances between vectors, with small weights for long targets.

    The weight is proportional to 1 / (1 + |target|^2 / focus^2). With these weights, the network becomes most accurate
    for misfits up to the threshold of the flag `misfit`. The exact value of a misfit far above this threshold matters
    little.

    Args:
        vector: Estimated vectors, shape (n, n_electrode).
        target: True vectors, same shape.
        focus: Length of a target at which its weight is half of the largest weight.
    """
    squared_distance = torch.sum((vector - target) ** 2, dim=-1)
    weight = 1.0 / (1.0 + torch.sum(target**2, dim=-1) / focus**2)
    return (weight * squared_distance).sum() / weight.sum()
