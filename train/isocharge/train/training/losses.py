"""Loss functions of the contact and misfit perceptrons, and noise that is added to charges during the training."""

import numpy as np
import torch
from torch import Tensor

from isocharge.simulate import Domain
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.contact_errors import rms
from isocharge.train.training.correlation import MAX_DEVIATION

WARM_UP_MEAN_WEIGHT = 30.0
"""Weight of the squared errors of the mean in the warm-up loss."""

WARM_UP_STD_WEIGHT = 0.1
"""Weight of the standard deviations in the warm-up loss."""

STD_EXPONENT = 0.75
"""Exponent of the variances by which the squared errors of the mean are weighted: 0 gives the likelihood, 1 gives least
squares."""

CORRELATION_WEIGHT = 0.3
"""Weight of the loss of the correlations. A weight of 1 gives the same ellipses, and position errors that are 0.5 %
larger."""

MIN_TRAINING_SINE = 0.03
"""Smallest sine of an angle of the correlations in the training of the hidden layers. Smaller sines count as this
value."""

MAX_NORMAL_ERROR = 3.0
"""Whitened error above which the loss of the correlations grows with the logarithm of the error instead of its square.
Where two errors are nearly proportional to each other, a square would cause gradients with which a training
diverges."""


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


def with_fresh_noise(charge: Tensor, noise: Noise, random: torch.Generator) -> Tensor:
    """Add noise to charges. The noise and the arguments are those of `fresh_noise`."""
    return charge + fresh_noise(charge, noise, random)


def warm_up_loss(mean: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """Compute the loss of the warm-up, in which the mean is fitted by least squares.

    The standard deviations are fitted to the errors of the mean, but they do not influence the mean. If the mean and
    the standard deviations were fitted together by a Gaussian likelihood, the mean would be found slowly.

    Args:
        mean: Estimated unit coordinates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        target: True unit coordinates, shape (n, 3).
    """
    error = mean - target
    std_loss = _std_loss(log_std, error)
    return (WARM_UP_MEAN_WEIGHT * error**2 + WARM_UP_STD_WEIGHT * std_loss).sum(dim=1).mean()


def likelihood_loss(mean: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """Compute the negative logarithm of a Gaussian likelihood, without the constant term.

    Args:
        mean: Estimated unit coordinates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        target: True unit coordinates, shape (n, 3).
    """
    deviation = (mean - target) * torch.exp(-log_std)
    return (log_std + 0.5 * deviation**2).sum(dim=1).mean()


def weighted_likelihood_loss(mean: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """Compute a loss with the same minimum as `likelihood_loss`, but with larger weights for uncertain presses.

    Args:
        mean: Estimated unit coordinates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        target: True unit coordinates, shape (n, 3).
    """
    return (_weighted_mean_loss(mean, log_std, target) + _std_loss(log_std, mean - target)).sum(dim=1).mean()


def linear_target_loss(mean: Tensor, log_std: Tensor, target: Tensor, error: Tensor) -> Tensor:
    """Compute a loss like `weighted_likelihood_loss`, but with different targets for mean and standard deviation.

    The mean learns from targets that follow the noise, and the standard deviations learn from separately given errors.

    Args:
        mean: Estimated unit coordinates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        target: Unit coordinates that the mean should have, shape (n, 3).
        error: Errors of the mean to which the standard deviations are fitted, shape (n, 3).
    """
    return (_weighted_mean_loss(mean, log_std, target) + _std_loss(log_std, error)).sum(dim=1).mean()


def _weighted_mean_loss(mean: Tensor, log_std: Tensor, target: Tensor) -> Tensor:
    """Compute half of the weighted squared errors of the mean.

    The gradient of a Gaussian likelihood with respect to the mean is divided by the variance. Therefore, a network
    learns the mean slowly where it overestimates the standard deviation (Seitzer et al., 2022, arXiv 2203.09168). In
    this loss, the squared errors of a Gaussian likelihood are multiplied by the estimated standard deviation to the
    power of `2 * STD_EXPONENT`. These factors are scaled so that their mean over the presses is 1. The standard
    deviations are constants in this loss, so they receive no gradient.

    Args:
        mean: Estimated unit coordinates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        target: Unit coordinates that the mean should have, shape (n, 3).

    Returns:
        Loss of every coordinate, shape (n, 3).
    """
    fixed_log_std = log_std.detach()
    mean_of_factors = torch.exp(2.0 * STD_EXPONENT * fixed_log_std).mean(dim=0)
    # The factor std^(2 STD_EXPONENT), divided by the variance of the Gaussian likelihood
    weight = torch.exp((2.0 * STD_EXPONENT - 2.0) * fixed_log_std) / mean_of_factors
    return 0.5 * weight * (mean - target) ** 2


def _std_loss(log_std: Tensor, error: Tensor) -> Tensor:
    """Compute the negative logarithm of a Gaussian likelihood as a function of only the standard deviations.

    Args:
        log_std: Logarithms of the standard deviations, shape (n, 3).
        error: Errors of the mean, shape (n, 3), which are constants in this loss.

    Returns:
        Loss of every coordinate, shape (n, 3).
    """
    return log_std + 0.5 * error.detach() ** 2 * torch.exp(-2.0 * log_std)


def robust_correlation_loss(angles: Tensor, deviation: Tensor) -> Tensor:
    """Compute the negative logarithm of a likelihood of correlated errors with unit variances.

    Terms that do not depend on the angles are omitted. The loss trains the hidden layers to represent the correlations.
    The likelihood is Gaussian for whitened errors up to `MAX_NORMAL_ERROR`. For larger errors, the likelihood has
    longer tails, so that single presses do not dominate the gradient. The errors receive no gradient. Therefore, this
    loss does not train the outputs for the mean and the standard deviation.

    Args:
        angles: Angles a, b and c of `isocharge.train.training.correlation` minus a right angle, shape (n, 3), rad.
            Three zeros give no correlations.
        deviation: Errors of the unit coordinates divided by their standard deviations, shape (n, 3).
    """
    # With x = a - pi / 2: sin a = cos x and cos a = -sin x.
    sin_a, sin_b, sin_c = torch.cos(angles).clamp(min=MIN_TRAINING_SINE).unbind(dim=1)
    cos_a, cos_b, cos_c = torch.sin(-angles).unbind(dim=1)
    x_deviation, y_deviation, force_deviation = deviation.detach().clamp(-MAX_DEVIATION, MAX_DEVIATION).unbind(dim=1)

    # The Cholesky factor of the correlations has the rows (1, 0, 0), (cos a, sin a, 0) and (cos b, sin b cos c,
    # sin b sin c). It is inverted row by row. The results and `x_deviation`, whose square does not depend on the
    # angles, have unit covariance.
    white_y = (y_deviation - cos_a * x_deviation) / sin_a
    white_force = (force_deviation - cos_b * x_deviation - sin_b * cos_c * white_y) / (sin_b * sin_c)
    squares = _long_tailed_square(white_y) + _long_tailed_square(white_force)
    log_determinant = torch.log(sin_a * sin_b * sin_c)
    return (log_determinant + 0.5 * squares).mean()


def _long_tailed_square(values: Tensor) -> Tensor:
    """Return the square of each value up to `MAX_NORMAL_ERROR`, and a logarithmic function of each larger value.

    At `MAX_NORMAL_ERROR`, the logarithmic function has the same value and the same slope as the square. The signs of
    the values do not matter.
    """
    squares = values**2
    largest_square = MAX_NORMAL_ERROR**2
    tail = largest_square * (1.0 + torch.log(squares.clamp(min=largest_square) / largest_square))
    return torch.where(squares < largest_square, squares, tail)


def distillation_loss(mean: Tensor, log_std: Tensor, teacher_mean: Tensor, teacher_log_std: Tensor) -> Tensor:
    """Compute the Kullback-Leibler divergence between the normal distributions of the network and of its teacher.

    Args:
        mean: Unit coordinates that the network estimates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        teacher_mean: Unit coordinates that the teacher estimates, shape (n, 3).
        teacher_log_std: Logarithms of the teacher's standard deviations, shape (n, 3).

    Returns:
        Mean over the n presses of the sum over (x, y, ln F).
    """
    squares = torch.exp(2.0 * teacher_log_std) + (mean - teacher_mean) ** 2
    divergence = log_std - teacher_log_std + 0.5 * (squares * torch.exp(-2.0 * log_std) - 1.0)
    return divergence.sum(dim=1).mean()


def mean_squared_distance(vector: Tensor, target: Tensor) -> Tensor:
    """Compute the mean of the squared distances between vectors of shape (..., n_electrode)."""
    return torch.sum((vector - target) ** 2, dim=-1).mean()


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


def validation_score(
    mean: Tensor, log_std: Tensor, target: Tensor, domain: Domain, data_noun: str
) -> tuple[float, str]:
    """Compute the likelihood loss for validation data, and a text about the errors for the progress report.

    Args:
        mean: Estimated unit coordinates, shape (n, 3).
        log_std: Logarithms of their standard deviations, shape (n, 3).
        target: True unit coordinates, shape (n, 3).
        domain: Scale of the unit coordinates.
        data_noun: Noun for the validation data in the text, for example "presses".

    Returns:
        The loss, and a text with the loss and with the rms errors of position and force.
    """
    loss = likelihood_loss(mean, log_std, target).item()
    error = (mean - target).double().numpy() * domain.scale
    x_error_mm, y_error_mm, log_force_error = error.T
    position_mm = rms(np.hypot(x_error_mm, y_error_mm))
    force_percent = 100.0 * rms(log_force_error)
    return loss, f"{loss:.3f} on watched {data_noun}: {position_mm:.4f} mm and {force_percent:.3f} % of force rms"
