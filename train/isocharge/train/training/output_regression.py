"""Functions that fit only the last layer of a trained network again, by ridge regression."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.training.folded_network import LOG_STD, MEAN, FoldedNetwork, relative_log_std
from isocharge.train.training.folding import transform_inputs
from isocharge.train.training.perceptron import Layer, Perceptron, evaluate, evaluate_hidden_layers

EXACT_RIDGE = 1e-5
"""Factor of the penalty on squared changes of the weights, for targets without noise.

The mean squared error has the factor 1.
"""

NOISY_RIDGE = 0.03
"""Factor of the penalty on squared changes of the weights, for targets that contain the squares of single errors.

The mean squared error has the factor 1.
"""

MAX_ERROR = 3.0
"""Largest error, in standard deviations, in the regression of the standard deviations by `adapt_to_charges`.

Larger errors are reduced to this value. Otherwise, their squares would change the logarithm of the standard deviation
too much in one step.
"""

N_SCORING_STEPS = 3
"""Number of steps of Fisher's scoring in `adapt_to_charges`."""

CORE_ERROR = 2.0
"""Largest error, in standard deviations, in `fit_std`. Larger errors are reduced to this value."""

N_CORE_STEPS = 5
"""Number of steps of Fisher's scoring in `fit_std`. Each step is shorter than without the limit of the errors."""

CORE_RIDGE = 1e-3
"""Factor of the penalty on squared changes of the weights in `fit_std`. The mean squared error has the factor 1."""


@dataclass(frozen=True)
class Regression:
    """One ridge regression of the last layer.

    Attributes:
        target: Function that computes the targets of the last layer from its present outputs, both of shape (n,
            n_output).
        ridge: Factor of the penalty on squared changes of the weights. The mean squared error has the factor 1.
    """

    target: Callable[[Array], Array]
    ridge: float


def adapt_to_charges(network: FoldedNetwork, charge: Array, equivalent_charge: Array, contact: Array) -> FoldedNetwork:
    """Adapt a network to charges that differ from the charges of its training.

    The new network is fitted so that its estimates from `charge` agree with the estimates of the given network from
    `equivalent_charge`. First, a linear map from the features of `charge` to the features of `equivalent_charge` is
    included in the first layer. Then the last layer is fitted to the remaining differences between the estimates.
    Finally, the standard deviations are fitted to the errors of the new network by maximising the Gaussian likelihood.
    The maximum is found by Fisher's scoring (McCullagh and Nelder 1989, section 2.5). Each step of this method is a
    regression on the squares of error / standard deviation.

    Args:
        network: The given network.
        charge: Charges with noise, shape (n, n_electrode), pC.
        equivalent_charge: Charges of the same contacts on the film for which the given network was trained, shape (n,
            n_electrode), pC.
        contact: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The new network.
    """
    features = network.features.evaluate(charge)
    equivalent_features = network.features.evaluate(equivalent_charge)
    equivalent_outputs = evaluate(network.layers, equivalent_features)
    log_contact = np.column_stack([contact[:, :2], np.log(contact[:, 2])])  # (x, y, ln F)

    # Include the linear map between the features in the first layer.
    feature_map = _linear_fit(features, equivalent_features)
    transformed_layers = transform_inputs(network.layers, feature_map)

    def contact_targets(outputs: Array) -> Array:
        """Return the outputs for the equivalent charges, but with the standard deviations of the present outputs."""
        targets = np.array(equivalent_outputs)
        targets[:, LOG_STD] = outputs[:, LOG_STD]
        return targets

    def std_targets(outputs: Array) -> Array:
        """Return the present outputs with new standard deviations, which one scoring step computes."""
        # The limit reduces the mean square of normal errors by only 0.5 %, so the expected square remains 1.
        return _scoring_step(outputs, log_contact, MAX_ERROR, expected_square=1.0)

    # Fit the last layer first to the contacts, and then in several scoring steps to the standard deviations.
    contact_regression = Regression(contact_targets, EXACT_RIDGE)
    std_regressions = [Regression(std_targets, NOISY_RIDGE) for _ in range(N_SCORING_STEPS)]
    layers = refit_last_layer(transformed_layers, features, [contact_regression, *std_regressions])
    return replace(network, layers=layers)


def _scoring_step(outputs: Array, log_contact: Array, largest_error: float, expected_square: float) -> Array:
    """Change the standard deviations among the outputs of a network by one step of Fisher's scoring.

    The step adds (e^2 / expected_square - 1) / 2 to the logarithm of each standard deviation. In this formula, e is the
    absolute error divided by the standard deviation, and is limited to `largest_error`.

    Args:
        outputs: Outputs of the last layer, shape (n, n_answer).
        log_contact: True contacts (x, y, ln F), shape (n, 3), mm and logarithm of N.
        largest_error: Largest value of e. Larger errors are reduced to it.
        expected_square: Mean of e^2 if the standard deviations are right.

    Returns:
        Outputs with the changed standard deviations, shape (n, n_answer).
    """
    error = np.abs(outputs[:, MEAN] - log_contact) * np.exp(-relative_log_std(outputs))  # in standard deviations
    limited_error = np.minimum(error, largest_error)
    changed_outputs = outputs.copy()
    changed_outputs[:, LOG_STD] += 0.5 * (limited_error**2 / expected_square - 1.0)
    return changed_outputs


def _linear_fit(inputs: Array, outputs: Array) -> Layer[Array]:
    """Fit a linear layer that computes given outputs from given inputs, by least squares.

    Args:
        inputs: Inputs of the layer, shape (n, n_input).
        outputs: Outputs that the layer should compute, shape (n, n_output).
    """
    design = np.column_stack([inputs, np.ones(len(inputs))])  # the column of ones is for the bias
    coefficients, *_ = np.linalg.lstsq(design, outputs)
    n_input = inputs.shape[1]
    weight, bias_row = np.split(coefficients, [n_input])
    return Layer(weight, bias_row[0])


def fit_std(network: FoldedNetwork, charge: Array, contact: Array) -> FoldedNetwork:
    """Fit the standard deviations of a trained network to its errors by changing the last layer.

    Where the map from contacts to charges nearly folds, the errors have longer tails than a normal distribution. If the
    Gaussian likelihood were maximised, the confidence intervals would contain more contacts than they should. The
    errors are therefore limited to `CORE_ERROR` standard deviations. The standard deviations are chosen so that the
    mean square of the limited errors is the same as for a normal variable with the same limit (Huber 1964, proposal 2).

    Args:
        network: The trained network.
        charge: Charges with noise, shape (n, n_electrode), pC.
        contact: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The network with the fitted standard deviations.
    """
    log_contact = np.column_stack([contact[:, :2], np.log(contact[:, 2])])  # (x, y, ln F)
    expected_square = _mean_square_of_limited_normal(CORE_ERROR)

    def std_targets(outputs: Array) -> Array:
        """Return the present outputs with new standard deviations, which one scoring step computes."""
        return _scoring_step(outputs, log_contact, CORE_ERROR, expected_square=expected_square)

    features = network.features.evaluate(charge)
    regressions = [Regression(std_targets, CORE_RIDGE) for _ in range(N_CORE_STEPS)]
    return replace(network, layers=refit_last_layer(network.layers, features, regressions))


def _mean_square_of_limited_normal(limit: float) -> float:
    """Return the mean square of a standard normal variable whose absolute value is limited to `limit`.

    The mean square is the integral of the square within the limits, plus the squared limit times the probability beyond
    the limits.
    """
    normal = NormalDist()
    probability_within = normal.cdf(limit) - normal.cdf(-limit)
    square_within = probability_within - 2.0 * limit * normal.pdf(limit)  # integration by parts
    return square_within + limit**2 * (1.0 - probability_within)


def add_variance(network: FoldedNetwork, charge: Array, variance: Array) -> FoldedNetwork:
    """Return a network whose estimated variances are increased by given variances.

    The last layer is fitted to the larger standard deviations at the given charges.

    Args:
        network: The given network.
        charge: Charges at which the variances are added, shape (n, n_electrode), pC.
        variance: Variances of (x, y, ln F) to add at these charges, shape (n, 3), mm^2, mm^2 and 1.
    """

    def larger_std(outputs: Array) -> Array:
        """Return the present outputs, but with standard deviations that include the additional variances."""
        relative_increase = variance * np.exp(-2.0 * relative_log_std(outputs))  # additional / present variance
        targets = outputs.copy()
        # ln sqrt(present + additional variance) = ln(present std) + ln(1 + relative increase) / 2
        targets[:, LOG_STD] += 0.5 * np.log1p(relative_increase)
        return targets

    features = network.features.evaluate(charge)
    layers = refit_last_layer(network.layers, features, [Regression(larger_std, EXACT_RIDGE)])
    return replace(network, layers=layers)


def refit_last_layer(
    perceptron: Perceptron[Array], features: Array, regressions: list[Regression]
) -> Perceptron[Array]:
    """Fit the last layer and the skip layer to new outputs by ridge regressions, which penalise changes of the weights.

    If a weight of the last layer is zero, it is not fitted. Each output therefore depends on the same hidden units as
    before.

    Args:
        perceptron: The given perceptron.
        features: Inputs of the perceptron, shape (n, n_input).
        regressions: Regressions, which are computed one after the other.

    Returns:
        The perceptron with new weights.
    """
    # The outputs are linear in the weights: outputs = design @ weights. The rows of `weights` are the weights of the
    # last layer, the weights of the skip layer, and the bias.
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, features)
    n_sample, n_hidden = hidden_output.shape
    n_input = features.shape[1]
    design = np.column_stack([hidden_output, features, np.ones(n_sample)])
    weights = np.vstack([perceptron.last.weight, perceptron.skip, perceptron.last.bias])
    n_output = weights.shape[1]
    last_is_fitted = weights[:n_hidden] != 0.0
    skip_and_bias_are_fitted = np.ones((n_input + 1, n_output), dtype=bool)
    is_fitted = np.vstack([last_is_fitted, skip_and_bias_are_fitted])

    normal_matrix = design.T @ design
    for regression in regressions:
        outputs = design @ weights
        output_change = regression.target(outputs) - outputs
        right_side = design.T @ output_change
        changed_columns = np.flatnonzero(output_change.any(axis=0))  # columns of outputs that differ from their targets
        for column in changed_columns:
            # Solve the normal equations for those weights of this output that are fitted.
            rows = np.flatnonzero(is_fitted[:, column])
            fitted_matrix = normal_matrix[np.ix_(rows, rows)]  # rows and columns of the fitted weights
            # The normal equations are sums over the samples, so the penalty on a mean is multiplied by their number.
            damped_matrix = fitted_matrix + regression.ridge * n_sample * np.eye(len(rows))
            weights[rows, column] += np.linalg.solve(damped_matrix, right_side[rows, column])

    last, skip, bias = np.split(weights, [n_hidden, n_hidden + n_input])
    return replace(perceptron, last=Layer(last, bias[0]), skip=skip)
