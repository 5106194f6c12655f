"""Training of the contact perceptron: its losses, the noise of the charges, and its targets.

Targets that follow the noise of the charges
--------------------------------------------

A press at the contact c has the charges Q(c) + n, where n is the noise. A network that minimises the squared errors
learns the posterior mean of the contact. If the noise is small, the posterior mean is the generalised least squares
estimate (Aitken 1936), which is linear in the noise:

    m = c + A n,   A = (J' W J + P)^-1 J' W.

Here J contains the derivatives of the charges with respect to the contact, W is the inverse of the covariance of the
noise, and P is the inverse of the covariance of the contacts in the domain (the prior).

The posterior mean m is a better target for the network than the contact c, for two reasons. First, m is nearly a
function of the charges, while the relation between c and the charges contains random noise. Second, A hardly depends on
the size of the noise. Therefore, the noise can be enlarged in the training, so that the network learns more clearly how
m changes with the charges. Both reasons matter for sensors with many electrodes. A change of the contact changes their
charges along only three directions. The network has to learn that noise along all other directions has no influence on
m.

The posterior mean is linear in the noise only if the standard deviation of the contact is small. For every other press,
the target is the contact, and the noise is not enlarged.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import chdtr, chdtrc
from torch import Tensor

from isocharge.simulate import ChargeMap
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.network import InverseNetwork, Posterior, as_tensor

LINEAR_TARGET_FRACTION = 0.7
"""Fraction of the steps in which the network of a sensor with more than `FEW_ELECTRODES` electrodes learns from linear
targets. With three and four electrodes, these targets do not reduce the errors."""

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


LARGEST_LINEAR_STD = 0.012
"""Standard deviation of the contact up to which the estimate counts as linear in the noise, in unit coordinates.

The noise is not enlarged beyond this standard deviation, either.
"""


@dataclass(frozen=True)
class LinearTargets:
    """Matrices that determine how the targets of presses change with the noise that is added to the charges.

    Attributes:
        noise_response: Matrices, shape (n, 3, n_electrode), 1/pC. The matrix of a press times the vector of its noise
            is the change of its estimated contact. The matrix is zero if the estimated contact of a press is not linear
            in the noise.
        noise_factor: Factor by which the noise of each press is enlarged, shape (n, 1).
    """

    noise_response: Tensor
    noise_factor: Tensor

    @classmethod
    def compute(cls, presses: LabelledPresses, charge_map: ChargeMap, noise: Noise) -> "LinearTargets":
        """Compute for each press the matrix A. If the noise n is added to the charges, the estimate changes by A n.

        With the derivatives J of the charges, the inverse W of the noise covariance, and the prior precision P, the
        matrix is A = (J' W J + P)^-1 J' W, where J' is the transpose of J. If the estimate of a press is not linear in
        the noise, its matrix is zero.

        Args:
            presses: Presses without noise.
            charge_map: Map from contacts to charges, which gives the derivatives J and the unit coordinates.
            noise: Noise of the charges.
        """
        domain = charge_map.domain
        unit_derivatives = charge_map.derivatives(presses.contact) * domain.scale  # J, shape (n, n_electrode, 3)
        noise_std = noise.sigma(presses.charge)
        whitened_jacobian = unit_derivatives / noise_std[:, :, None]  # W^(1/2) J
        transposed = whitened_jacobian.swapaxes(1, 2)  # J' W^(1/2), shape (n, 3, n_electrode)
        prior_precision = 3.0 * np.eye(3)  # P, of unit coordinates that are uniformly distributed between -1 and 1
        precision = transposed @ whitened_jacobian + prior_precision  # J' W J + P, shape (n, 3, 3)
        noise_response = np.linalg.solve(precision, transposed / noise_std[:, None, :])

        # If the contact is too uncertain, the estimate is not linear, and the noise is not enlarged (factor 1). If the
        # contact is very certain, the noise is enlarged up to the limit of linearity. The inverse of the precision is
        # the covariance of the contact, and its diagonal contains the variances.
        contact_variance = np.linalg.inv(precision).diagonal(axis1=1, axis2=2)
        largest_std = np.sqrt(contact_variance.max(axis=1))
        is_linear = largest_std <= LARGEST_LINEAR_STD
        noise_response[~is_linear] = 0.0
        noise_factor = np.maximum(LARGEST_LINEAR_STD / largest_std, 1.0)
        return cls(
            noise_response=as_tensor(noise_response),
            noise_factor=as_tensor(noise_factor[:, None]),
        )

    def enlarge(self, noise: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Enlarge the noise of some presses, and compute the changes of their targets in unit coordinates.

        Args:
            noise: Noise of the charges, shape (m, n_electrode), pC.
            rows: Indices of the presses, shape (m,).

        Returns:
            The enlarged noise, the changes, shape (m, 3), and the factors of the noise, shape (m, 1).
        """
        noise_factor = self.noise_factor[rows]
        enlarged_noise = noise_factor * noise
        contact_change = (self.noise_response[rows] @ enlarged_noise[:, :, None])[:, :, 0]  # matrix times vector
        return enlarged_noise, contact_change, noise_factor


def contact_stage(
    network: InverseNetwork,
    train: LabelledPresses,
    noise: Noise,
    config: TrainingConfig,
    *,
    linear_targets: LinearTargets | None = None,
) -> TrainingStage:
    """Define the training of the contact perceptron on charges with fresh noise.

    If there are linear targets, the
    mean of the network learns from them during the first `LINEAR_TARGET_FRACTION` of the steps. Later, or without
    linear targets, it learns from the true contacts. The
    covariance always learns from the errors.

    Args:
        network: The network, whose contact perceptron is trained.
        train: Presses for training.
        noise: Noise that is added to the charges in every step.
        config: Number of steps, batch size, learning rate and seed.
        linear_targets: Targets of the presses of `train` for the first steps; None to use only the contacts.
    """
    domain = network.domain
    charge = as_tensor(train.charge)
    white, gain = (torch.as_tensor(values, dtype=torch.float32) for values in (noise.white, noise.gain))
    noise_std = torch.hypot(white, gain * charge)
    unit_contact = as_tensor(domain.to_unit(train.contact))
    batch = min(config.batch, len(charge))

    def loss(progress: float, random: torch.Generator) -> Tensor:
        """Return the loss of a random batch with new noise.

        Args:
            progress: Fraction of completed steps.
            random: Random number generator of the batch and of its noise.
        """
        rows = torch.randint(len(charge), (batch,), generator=random)
        added_noise = noise_std[rows] * torch.randn((batch, charge.shape[1]), generator=random)
        contact = unit_contact[rows]
        target = contact
        noise_factor = torch.ones(())
        if linear_targets is not None and progress < LINEAR_TARGET_FRACTION:
            added_noise, contact_change, noise_factor = linear_targets.enlarge(added_noise, rows)
            target = contact + contact_change
        posterior = network.posterior(charge[rows] + added_noise)
        # The errors are proportional to the noise. The division by the factor gives the errors that charges with their
        # usual noise would cause.
        error = (contact - posterior.mean) / noise_factor
        # The two losses have separate gradients. The first loss does not change the outputs for the covariance, and the
        # second loss does not change the mean.
        return (mean_loss(posterior, target) + covariance_loss(posterior, error)).mean()

    sizes = config.sizes(network.features.n_electrode)
    rate = config.learning_rate * sizes.rate_factor
    return TrainingStage("contact", network.contact, loss, sizes.steps, rate, config.seed)
