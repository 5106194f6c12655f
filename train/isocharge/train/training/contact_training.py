"""Training of the contact perceptron: its losses, the noise of the charges, and the final fit of its covariance."""

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.network import InverseNetwork, Posterior, as_tensor

DEGREES_OF_FREEDOM = 5.0
"""Degrees of freedom nu of the t distribution that determines how the loss of the covariance counts large errors."""

TAIL_FACTOR = 3.71
"""Factor of the logarithm in the loss of the covariance, for the degrees of freedom nu above, dimensionless.

With the factor 1 / (2 - 2 sqrt(pi nu / 2) erfcx(sqrt(nu / 2))), the loss of normally distributed errors is smallest at
their standard deviation. The reason is that, for a standard normal z, the mean of z times the derivative of the loss is
then 1.
"""

MIN_SINE = 0.003
"""Smallest sine of an angle of the correlations in the loss. Smaller sines count as this value."""


def mean_loss(posterior: Posterior, target: Tensor) -> Tensor:
    """Compute for each press half of the weighted sum of the squared errors of the mean, shape (n,).

    The gradient of a Gaussian likelihood with respect to the mean is divided by the variance. Therefore, a network
    learns the mean slowly for presses whose standard deviation it overestimates (Seitzer et al., 2022, arXiv
    2203.09168). In this loss, the squared errors of a Gaussian likelihood are multiplied by the estimated standard
    deviation. The factors are scaled so that their mean over the presses is 1.

    Args:
        posterior: Estimated unit coordinates with their standard deviations.
        target: Unit coordinates that the mean should have, shape (n, 3).
    """
    std = torch.exp(posterior.log_std.detach())  # a constant in this loss
    # The square over the variance, times the factor std / (mean of std)
    weighted_squares = (posterior.mean - target) ** 2 / (std * std.mean(dim=0))
    return 0.5 * weighted_squares.sum(dim=1)


def covariance_loss(posterior: Posterior, error: Tensor) -> Tensor:
    """Compute the negative log-likelihood of the errors of each press without its constant terms, shape (n,).

    The errors are divided by the standard deviations, and their correlations are removed. The three resulting values
    are independent. The assumed distribution of each of the three values has longer tails than a normal distribution:
    where the map from contacts to charges nearly folds, a few errors are large. Because of these few errors, a Gaussian
    likelihood would enlarge the intervals of all contacts.

    Args:
        posterior: Logarithms of the standard deviations of x, y and ln F, shape (n, 3), and turns, shape (n, 3). A turn
            is an angle of the correlations (`isocharge.train.training.folded_network`) minus pi / 2.
        error: Errors of the unit coordinates, shape (n, 3), which are constants in this loss.
    """
    # Errors in standard deviations. Without gradients of the errors (`detach`), the loss does not train the mean.
    x_deviation, y_deviation, force_deviation = (error.detach() * torch.exp(-posterior.log_std)).unbind(dim=1)

    # The angles a, b and c of the correlations are pi / 2 + turn, so that sin(a) = cos(turn) and cos(a) = sin(-turn).
    # `MIN_SINE` keeps the divisors below away from zero.
    sin_a, sin_b, sin_c = torch.cos(posterior.turn).clamp(min=MIN_SINE).unbind(dim=1)
    cos_a, cos_b, cos_c = torch.sin(-posterior.turn).unbind(dim=1)

    # The Cholesky factor of the correlations has the rows (1, 0, 0), (cos a, sin a, 0) and (cos b, sin b cos c,
    # sin b sin c). Its product with the independent errors (x_deviation, independent_y, independent_force) gives the
    # deviations. These equations are solved one after the other.
    independent_y = (y_deviation - cos_a * x_deviation) / sin_a
    independent_force = (force_deviation - cos_b * x_deviation - sin_b * cos_c * independent_y) / (sin_b * sin_c)
    log_determinant = posterior.log_std.sum(dim=1) + torch.log(sin_a * sin_b * sin_c)

    # The logarithm of the t distribution replaces half of the square of a normal distribution. `TAIL_FACTOR` makes the
    # loss smallest at the true standard deviation if the errors are normally distributed.
    squared_errors = torch.stack([x_deviation, independent_y, independent_force]) ** 2  # independent, shape (3, n)
    return log_determinant + TAIL_FACTOR * torch.log1p(squared_errors / DEGREES_OF_FREEDOM).sum(dim=0)


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
        """Return the loss of a random batch of the training presses with new noise.

        The arrays `charge` and `noise_std`, shape (n, n_electrode), and `unit_contact`, shape (n, 3), belong to all
        presses.

        Args:
            random: Random number generator of the batch and of its noise.
        """
        rows = torch.randint(len(charge), (config.batch,), generator=random)
        target = unit_contact[rows]
        noisy_charge = torch.normal(charge[rows], noise_std[rows], generator=random)
        posterior = network.posterior(noisy_charge)
        # The two losses have separate gradients. The first loss does not change the outputs for the covariance, and the
        # second loss does not change the mean.
        loss_of_mean = mean_loss(posterior, target)
        loss_of_covariance = covariance_loss(posterior, target - posterior.mean)
        return (loss_of_mean + loss_of_covariance).mean()

    # The sizes are the settings in `config`, or defaults for the number of electrodes. The rate is lower for many
    # electrodes.
    sizes = config.sizes(network.features.n_electrode)
    rate = config.learning_rate * sizes.rate_factor
    return TrainingStage("contact", network.contact, loss, sizes.steps, rate, config.seed)


REFIT_PRESSES = 32_768
"""Smallest number of presses with noise to which `refit_covariance` fits the covariance."""

RIDGE = 10.0
"""Value that is added to the sums of the squares of the hidden units in `refit_covariance`, dimensionless.

Without this value, the weights of units that are nearly linear functions of other units would be very large.
"""

LOSS_TOLERANCE = 1e-5
"""`refit_covariance` ends if the loss decreases by less than this fraction in one iteration, dimensionless."""


def refit_covariance(network: InverseNetwork, train: LabelledPresses, noise: Noise) -> None:
    """Fit the last layer for the standard deviations and the correlations to the errors of the trained mean.

    During the training, the errors of the mean decrease until the last step. The learned covariance therefore still
    reflects, in part, the larger errors of earlier steps. This function minimises the loss of the covariance on a large
    sample of presses by the method L-BFGS. The loss does not change the mean.

    The hidden units are correlated, and a fit of their weights would take hundreds of iterations. Instead, the function
    fits the weights of combinations of the hidden units that are nearly orthonormal over the presses. Let H be the
    matrix of the hidden units of all presses, and L the Cholesky factor of their Gram matrix H' H. The combinations are
    the columns of H L'^-1. The function fits a matrix M, which contains the changes of the weights of the combinations.
    The weights of the hidden units then change by M L^-1.

    Args:
        network: Network that learns the force, with a trained contact perceptron.
        train: Presses for training, which are repeated if they are few.
        noise: Noise that is added to the charges.
    """
    presses = train.repeated(REFIT_PRESSES)
    target = as_tensor(network.domain.to_unit(presses.contact))
    weight = network.contact.linear_layers[-1].weight.data  # shares its memory with the network; (n_output, n_hidden)
    with torch.no_grad():
        inputs = network.inputs(as_tensor(presses.noisy(noise, seed=0)))
        outputs = network.contact(inputs)
        hidden = network.contact.last_hidden(inputs)  # H, shape (n, n_hidden)
        gram_matrix = hidden.T @ hidden
        gram_matrix.diagonal().add_(RIDGE)
        inverse_gram_factor = torch.linalg.inv(torch.linalg.cholesky(gram_matrix))  # L^-1

    def loss_and_gradient(entries: Array) -> tuple[float, Array]:
        """Return the loss over all presses and its gradient with respect to the entries of the fitted matrix M.

        The weights of the last layer change by M L^-1, where L^-1 is `inverse_gram_factor`. `outputs` are the outputs
        for M = 0, and `hidden` are the hidden units, which the weights map to the outputs.

        Args:
            entries: Entries of M, each row after the other. M has the shape of `weight`, (n_output, n_hidden).
        """
        matrix_m = as_tensor(entries).view_as(weight).requires_grad_()
        new_outputs = outputs + hidden @ (matrix_m @ inverse_gram_factor).T
        posterior = Posterior(*new_outputs.split(3, dim=1))  # three means, three log stds and three turns
        loss = covariance_loss(posterior, target - posterior.mean).sum()
        (gradient,) = torch.autograd.grad(loss, matrix_m)
        return loss.item(), gradient.numpy().ravel()

    start = np.zeros(weight.numel())
    result = minimize(loss_and_gradient, start, jac=True, method="L-BFGS-B", tol=LOSS_TOLERANCE)
    weight += as_tensor(result.x).view_as(weight) @ inverse_gram_factor  # in place, so that the network changes
