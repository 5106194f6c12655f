"""Changes of the last layer of a trained network by ridge regression, without training the hidden layers again."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.perceptron import Layer, Perceptron, evaluate, evaluate_hidden_layers
from isocharge.train.training.folded_network import LOG_STD, MEAN, FoldedNetwork, relative_log_std
from isocharge.train.training.folding import transform_inputs

EXACT_RIDGE = 1e-5
"""Weight of the squared changes of the weights for targets without noise. The mean squared error has the weight 1."""

NOISY_RIDGE = 0.03
"""Weight of the squared changes of the weights for targets that contain the squares of single errors.

The mean squared error has the weight 1.
"""

MAX_ERROR = 3.0
"""Largest error, in standard deviations, that the regression of the standard deviations distinguishes. The square of a
larger error would change the logarithm of the standard deviation too much in one step."""

N_SCORING_STEPS = 3
"""Number of steps of Fisher's scoring for the standard deviations."""

CORE_ERROR = 2.0
"""Largest error, in standard deviations, that `fit_std` distinguishes."""

N_CORE_STEPS = 5
"""Number of scoring steps of `fit_std`. The limitation of the errors makes each step shorter."""

CORE_RIDGE = 1e-3
"""Weight of the squared changes of the weights in `fit_std`. The mean squared error has the weight 1."""


@dataclass(frozen=True)
class Regression:
    """One ridge regression of the last layer.

    Attributes:
        target: Function from the present answers to the target answers, both of shape (n, n_answer).
        ridge: Weight of the squared changes of the weights. The mean squared error has the weight 1.
    """

    target: Callable[[Array], Array]
    ridge: float


def adapt_to_charges(network: FoldedNetwork, charge: Array, equivalent: Array, contact: Array) -> FoldedNetwork:
    """Adapt a network to charges that differ from the charges of its training.

    The new network estimates from `charge` the contacts that the given network estimates from `equivalent`. First, a
    linear map from the features of `charge` to the features of `equivalent` is included in the first layer. Then the
    last layer is fitted to the remaining differences. The standard deviations are then fitted to the errors of the new
    network, so that the Gaussian likelihood is largest. The method is Fisher's scoring (McCullagh and Nelder 1989,
    2.5), a regression on the squares of error / standard deviation.

    Args:
        network: The given network.
        charge: Charges with noise, shape (n, n_electrode), pC.
        equivalent: Charges of the same contacts on the film for which the given network was trained, shape (n,
            n_electrode), pC.
        contact: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The new network.
    """
    features = network.features.evaluate(charge)
    equivalent_features = network.features.evaluate(equivalent)
    equivalent_outputs = evaluate(network.layers, equivalent_features)
    log_contact = np.column_stack([contact[:, :2], np.log(contact[:, 2])])  # (x, y, ln F)

    # The first layer includes the linear map between the features.
    transformed = transform_inputs(network.layers, _linear_fit(features, equivalent_features))

    def contact_targets(outputs: Array) -> Array:
        """Return the outputs for the equivalent charges, with the standard deviations of the present outputs."""
        targets = np.array(equivalent_outputs)
        targets[:, LOG_STD] = outputs[:, LOG_STD]
        return targets

    def std_targets(outputs: Array) -> Array:
        """Return the present outputs with standard deviations that are changed by one scoring step."""
        return _scoring_step(outputs, log_contact, MAX_ERROR, expected_square=1.0)

    # The last layer is fitted first to the contacts, and then in several scoring steps to the standard deviations.
    contact_regression = Regression(contact_targets, EXACT_RIDGE)
    std_regressions = [Regression(std_targets, NOISY_RIDGE) for _ in range(N_SCORING_STEPS)]
    layers = refit_last_layer(transformed, features, [contact_regression, *std_regressions])
    return replace(network, layers=layers)


def _scoring_step(outputs: Array, log_contact: Array, largest_error: float, expected_square: float) -> Array:
    """Return the outputs of a network with standard deviations that are changed by one step of Fisher's scoring.

    The step adds (e^2 / expected_square - 1) / 2 to the logarithm of a standard deviation. Here e is the error divided
    by the standard deviation, and is limited to `largest_error`.

    Args:
        outputs: Outputs of the last layer, shape (n, n_answer).
        log_contact: True contacts (x, y, ln F), shape (n, 3), mm and logarithm of N.
        largest_error: Largest error that the step distinguishes, in standard deviations.
        expected_square: Mean of e^2 if the standard deviations are right.
    """
    relative_error = np.abs(outputs[:, MEAN] - log_contact) * np.exp(-relative_log_std(outputs))
    limited_error = np.minimum(relative_error, largest_error)
    changed = outputs.copy()
    changed[:, LOG_STD] += 0.5 * (limited_error**2 / expected_square - 1.0)
    return changed


def _linear_fit(inputs: Array, outputs: Array) -> Layer[Array]:
    """Return the linear layer that computes outputs from inputs with the smallest sum of squared errors.

    Args:
        inputs: Inputs, shape (n, n_input).
        outputs: Outputs to be computed, shape (n, n_output).
    """
    design = np.column_stack([inputs, np.ones(len(inputs))])  # the column of ones is for the bias
    coefficients, *_ = np.linalg.lstsq(design, outputs)
    n_input = inputs.shape[1]
    weight, bias_row = np.split(coefficients, [n_input])
    return Layer(weight, bias_row[0])


def fit_std(network: FoldedNetwork, charge: Array, contact: Array) -> FoldedNetwork:
    """Fit the standard deviations of a trained network to its errors, by a change of the last layer.

    Where the map from contacts to charges nearly folds, the errors have longer tails than a normal distribution. The
    intervals of a Gaussian likelihood then contain more than the stated share of the contacts. Errors are therefore
    limited to `CORE_ERROR` standard deviations. The mean square of these limited errors is compared with the mean
    square of a normal variable with the same limit (Huber 1964, proposal 2).

    Args:
        network: The trained network.
        charge: Charges with noise, shape (n, n_electrode), pC.
        contact: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The network with other standard deviations.
    """
    log_contact = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
    # Mean square of a standard normal variable that is limited to plus or minus `CORE_ERROR`: the integral of the
    # square within the limits, plus the squared limit times the probability beyond them.
    normal = NormalDist()
    probability_within = normal.cdf(CORE_ERROR) - normal.cdf(-CORE_ERROR)
    square_within = probability_within - 2.0 * CORE_ERROR * normal.pdf(CORE_ERROR)
    limited_mean_square = square_within + CORE_ERROR**2 * (1.0 - probability_within)

    def std_targets(outputs: Array) -> Array:
        """Return the present outputs with standard deviations that are changed by one scoring step."""
        return _scoring_step(outputs, log_contact, CORE_ERROR, expected_square=limited_mean_square)

    features = network.features.evaluate(charge)
    regressions = [Regression(std_targets, CORE_RIDGE) for _ in range(N_CORE_STEPS)]
    return replace(network, layers=refit_last_layer(network.layers, features, regressions))


def add_variance(network: FoldedNetwork, charge: Array, variance: Array) -> FoldedNetwork:
    """Return the network with larger standard deviations, whose squares contain given additional variances.

    The last layer is fitted to the larger standard deviations at the given charges.

    Args:
        network: The given network.
        charge: Charges at which the variances are added, shape (n, n_electrode), pC.
        variance: Variances of (x, y, ln F) to add there, shape (n, 3), mm^2, mm^2 and 1.
    """

    def larger_std(outputs: Array) -> Array:
        """Return the outputs with the logarithms of the larger standard deviations."""
        relative_increase = variance * np.exp(-2.0 * relative_log_std(outputs))  # added over present variance
        targets = outputs.copy()
        # ln sqrt(present + added variance) = ln(present std) + ln(1 + relative increase) / 2
        targets[:, LOG_STD] += 0.5 * np.log1p(relative_increase)
        return targets

    features = network.features.evaluate(charge)
    layers = refit_last_layer(network.layers, features, [Regression(larger_std, EXACT_RIDGE)])
    return replace(network, layers=layers)


def refit_last_layer(
    perceptron: Perceptron[Array], features: Array, regressions: list[Regression]
) -> Perceptron[Array]:
    """Fit the last layer and the skip layer to new outputs, by ridge regression of the changes of the weights.

    Weights of the last layer that are zero remain zero, so that an output depends on the same hidden units as before.

    Args:
        perceptron: The perceptron.
        features: Inputs of the perceptron, shape (n, n_input).
        regressions: Regressions, which are computed one after the other.

    Returns:
        The perceptron with new weights.
    """
    # The outputs are linear in the weights: outputs = design @ weights. The rows of the weights are those of the last
    # layer, those of the skip layer, and the bias.
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, features)
    n_sample, n_hidden = hidden_output.shape
    n_input = features.shape[1]
    design = np.column_stack([hidden_output, features, np.ones(n_sample)])
    weights = np.vstack([perceptron.last.weight, perceptron.skip, perceptron.last.bias])
    is_skip_or_bias = np.ones((n_input + 1, weights.shape[1]), dtype=bool)
    is_fitted = np.vstack([weights[:n_hidden] != 0.0, is_skip_or_bias])

    normal_matrix = design.T @ design
    for regression in regressions:
        outputs = design @ weights
        change = regression.target(outputs) - outputs
        right_side = design.T @ change
        changed_columns = np.flatnonzero(change.any(axis=0))  # outputs that are already equal to their targets remain
        for column in changed_columns:
            # Solve the normal equations for the fitted weights of this output. The other weights remain zero.
            rows = np.flatnonzero(is_fitted[:, column])
            fitted_part = normal_matrix[np.ix_(rows, rows)]  # these rows and these columns of the matrix
            damped_matrix = fitted_part + regression.ridge * n_sample * np.eye(len(rows))
            weights[rows, column] += np.linalg.solve(damped_matrix, right_side[rows, column])

    last, skip, bias = np.split(weights, [n_hidden, n_hidden + n_input])
    return replace(perceptron, last=Layer(last, bias[0]), skip=skip)
