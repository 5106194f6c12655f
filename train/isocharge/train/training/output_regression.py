"""Changes of the last layer of a trained network by ridge regression, without training the hidden layers again."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from isocharge.common.arrays import Array
from isocharge.common.perceptron import Layer, Perceptron, evaluate, evaluate_hidden_layers
from isocharge.train.training.folded_network import LOG_STD, MEAN, FoldedNetwork, relative_log_std
from isocharge.train.training.folding import transform_inputs

EXACT_RIDGE = 1e-5
"""Ridge for targets without noise, relative to the mean square of a feature of unit size."""

NOISY_RIDGE = 0.03
"""Ridge for targets that contain the squares of single errors, relative to the mean square of a feature of unit
size."""

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
"""Ridge of `fit_std`, relative to the mean square of a feature of unit size."""


@dataclass(frozen=True)
class Regression:
    """One ridge regression of the last layer.

    Attributes:
        target: Function from the present answers to the target answers, both of shape (n, n_answer).
        ridge: Penalty on the change of the weights.
    """

    target: Callable[[Array], Array]
    ridge: float


def adapt_to_charges(network: FoldedNetwork, charge: Array, equivalent: Array, contact: Array) -> FoldedNetwork:
    """Adapt a network to charges that differ from those of its training.

    The new network estimates from `charge` the contacts that the given network estimates from `equivalent`. A linear
    map from the features of `charge` to those of `equivalent` is included in the first layer, and the last layer is
    fitted to the remaining differences. The standard deviations are then fitted to the errors of the new network by
    maximising the Gaussian likelihood with Fisher's scoring (McCullagh and Nelder 1989, 2.5), which is a regression on
    the squares of error / standard deviation.

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
    log_contact = np.column_stack([contact[:, :2], np.log(contact[:, 2])])

    # Linear map from the features of `charge` to those of `equivalent`, by least squares
    design = np.column_stack([features, np.ones(len(features))])
    coefficients, *_ = np.linalg.lstsq(design, equivalent_features)
    matrix, shift = np.split(coefficients, [features.shape[1]])
    transformed = transform_inputs(network.layers, Layer(matrix, shift[0]))

    def contact_targets(outputs: Array) -> Array:
        """Return the outputs for the equivalent charges, with the standard deviations of the present outputs."""
        targets = np.array(equivalent_outputs)
        targets[:, LOG_STD] = outputs[:, LOG_STD]
        return targets

    def std_targets(outputs: Array) -> Array:
        """Return outputs whose standard deviations are changed by one scoring step, from the present outputs."""
        relative_error = np.abs(outputs[:, MEAN] - log_contact) * np.exp(-relative_log_std(outputs))
        targets = outputs.copy()
        targets[:, LOG_STD] += 0.5 * (np.minimum(relative_error, MAX_ERROR) ** 2 - 1.0)
        return targets

    contact_regression = Regression(contact_targets, EXACT_RIDGE)
    std_regressions = [Regression(std_targets, NOISY_RIDGE) for _ in range(N_SCORING_STEPS)]
    return replace(network, layers=refit_last_layer(transformed, features, [contact_regression, *std_regressions]))


def fit_std(network: FoldedNetwork, charge: Array, contact: Array) -> FoldedNetwork:
    """Fit the standard deviations of a trained network to its errors, by a change of the last layer.

    At places where the map from contacts to charges nearly folds, the errors have longer tails than a normal
    distribution, and the intervals of a Gaussian likelihood contain more than the stated share of the contacts. Errors
    are therefore limited to `CORE_ERROR` standard deviations, and their mean square is compared with that of a limited
    normal variable (Huber 1964, proposal 2).

    Args:
        network: The trained network.
        charge: Charges with noise, shape (n, n_electrode), pC.
        contact: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The network with other standard deviations.
    """
    log_contact = np.column_stack([contact[:, :2], np.log(contact[:, 2])])
    central_share = norm.cdf(CORE_ERROR) - norm.cdf(-CORE_ERROR)
    central_square = central_share - 2.0 * CORE_ERROR * norm.pdf(CORE_ERROR)
    limited_square = central_square + CORE_ERROR**2 * (1.0 - central_share)

    def std_targets(outputs: Array) -> Array:
        """Return outputs whose standard deviations are changed by one scoring step, from the present outputs."""
        relative_error = np.abs(outputs[:, MEAN] - log_contact) * np.exp(-relative_log_std(outputs))
        targets = outputs.copy()
        targets[:, LOG_STD] += 0.5 * (np.minimum(relative_error, CORE_ERROR) ** 2 / limited_square - 1.0)
        return targets

    regressions = [Regression(std_targets, CORE_RIDGE)] * N_CORE_STEPS
    features = network.features.evaluate(charge)
    return replace(network, layers=refit_last_layer(network.layers, features, regressions))


def add_variance(network: FoldedNetwork, charge: Array, variance: Array) -> FoldedNetwork:
    """Return the network with larger standard deviations.

    Args:
        network: The given network.
        charge: Charges at which the variances are added, shape (n, n_electrode), pC.
        variance: Variances of (x, y, ln F) to add there, shape (n, 3), mm^2, mm^2 and 1.
    """

    def larger_std(outputs: Array) -> Array:
        """Return the outputs with the logarithms of the larger standard deviations."""
        relative_increase = variance * np.exp(-2.0 * relative_log_std(outputs))  # added over present variance
        targets = outputs.copy()
        targets[:, LOG_STD] += 0.5 * np.log1p(relative_increase)
        return targets

    features = network.features.evaluate(charge)
    return replace(network, layers=refit_last_layer(network.layers, features, [Regression(larger_std, EXACT_RIDGE)]))


def refit_last_layer(
    perceptron: Perceptron[Array], features: Array, regressions: list[Regression]
) -> Perceptron[Array]:
    """Fit the last layer and the skip layer to new outputs, by ridge regression of the changes of the weights.

    Weights that are zero remain zero, so that an output depends on the same hidden units as before.

    Args:
        perceptron: The perceptron.
        features: Inputs of the perceptron, shape (n, n_input).
        regressions: Regressions, which are computed one after the other.

    Returns:
        The perceptron with new weights.
    """
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, features)
    n_sample, n_hidden = hidden_output.shape
    n_input = features.shape[1]
    design = np.column_stack([hidden_output, features, np.ones(n_sample)])
    weights = np.vstack([perceptron.last.weight, perceptron.skip, perceptron.last.bias])
    is_skip_or_bias = np.ones((n_input + 1, weights.shape[1]), dtype=bool)
    is_used = np.vstack([weights[:n_hidden] != 0.0, is_skip_or_bias])
    normal_matrix = design.T @ design
    for regression in regressions:
        outputs = design @ weights
        change = regression.target(outputs) - outputs
        moment = design.T @ change
        for column in np.flatnonzero(change.any(axis=0)):
            used = np.flatnonzero(is_used[:, column])
            damped_matrix = normal_matrix[np.ix_(used, used)] + regression.ridge * n_sample * np.eye(len(used))
            weights[used, column] += np.linalg.solve(damped_matrix, moment[used, column])
    last, skip, bias = np.split(weights, [n_hidden, n_hidden + n_input])
    return replace(perceptron, last=Layer(last, bias[0]), skip=skip)
