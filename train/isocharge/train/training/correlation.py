"""Additional outputs of a trained network, which give the correlations between its errors of x, y and ln F.

The other outputs of the network do not change. Every matrix of correlations between three errors is the Gram matrix of
three unit vectors. The vectors (1, 0, 0), (cos a, sin a, 0) and (cos b, sin b cos c, sin b sin c) have unit length for
all angles a, b and c, so they always give a valid correlation matrix. The vectors are also the rows of the Cholesky
factor of this matrix. Products of sines and cosines can be written as sums of cosines. The correlations are therefore
linear in eight cosines:

    xy = cos a,  xF = cos b,
    yF = (cos(a - b) + cos(a + b)) / 2 + (cos(a - b - c) + cos(a - b + c) - cos(a + b - c) - cos(a + b + c)) / 4.

In the exported graph, one node computes the cosines, and another node computes their weighted sums. The angles are
linear functions of the last hidden layer of the contact perceptron and of the input features. The linear functions are
fitted to the errors of the network by maximum likelihood.
"""

import logging
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array, Singles
from isocharge.simulate import NoiseModel
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.features import whitening
from isocharge.train.training.folded_network import N_CONTACT_ANSWERS, FoldedNetwork
from isocharge.train.training.perceptron import Layer, evaluate_hidden_layers, evaluate_output_layer

_log = logging.getLogger(__name__)

N_EXAMPLES = 30_000
"""Number of presses with noise to which the angles are fitted."""

RIDGE = 1e-4
"""Weight of the squared coefficients in the loss, for inputs of unit variance. It keeps a fit to few presses stable."""

MIN_RELATIVE_STD = 0.02
"""Smallest standard deviation of a principal component of the inputs that is scaled to unit variance.

It is relative to the largest standard deviation. The coefficients of smaller components would be too large for float32.
"""

WHITENING_STRIDE = 7
"""Distance between the examples from which the whitening of the inputs is computed. All other examples are skipped."""

GRADIENT_TOLERANCE = 2e-3
"""Largest derivative of the loss at which the minimisation stops."""

MAX_STARTS = 5
"""Largest number of starts of the minimisation. A line search can fail if two unit vectors are nearly equal."""

MAX_ITERATIONS = 90
"""Largest total number of iterations of all starts. More iterations hardly change the coverage."""

N_UPDATES = 20
"""Number of past updates that L-BFGS keeps."""

FIRST_STEP = 0.125
"""Length of the first step of the minimisation. A longer step can lead to angles with two equal unit vectors."""

MAX_DEVIATION = 5.0
"""Largest error in the loss, in standard deviations. Larger errors are reduced to it, because they are not Gaussian."""

MIN_SINE = 1e-4
"""Smallest absolute value of a sine by which the loss divides, so that quotients stay within the range of float32."""

ANGLES_TO_COSINE_ARGUMENTS = np.array(
    [
        [1, 0, 1, 1, 1, 1, 1, 1],  # coefficients of a
        [0, 1, -1, 1, -1, -1, 1, 1],  # coefficients of b
        [0, 0, 0, 0, -1, 1, -1, 1],  # coefficients of c
    ],
    dtype=float,
)
"""Matrix, shape (3, 8), from the angles (a, b, c) to the arguments of the eight cosines.

The arguments are a, b, a - b, a + b, a - b - c, a - b + c, a + b - c and a + b + c.
"""


def with_correlation(network: FoldedNetwork, presses: LabelledPresses, noise: NoiseModel, seed: int) -> FoldedNetwork:
    """Return a network that also estimates the correlations between its errors of x, y and ln F.

    Three angles a, b and c determine the correlations. The description of this module explains the angles. Each angle
    is a linear function of the input features and of the hidden units that influence the contact. The linear functions
    are fitted to the errors of the network on presses with noise. The other outputs of the network do not change.

    Args:
        network: The trained network.
        presses: Presses on which the network was trained.
        noise: Noise that is added to the charges of the presses.
        seed: Seed of the noise.

    Returns:
        Network with eight additional answers: the sums and differences of a, b and c from whose cosines the
        correlations are computed.
    """
    # Compute the outputs of the network for copies of the presses with noise.
    layers = network.layers
    examples = presses.repeated(N_EXAMPLES)
    features = network.features.evaluate(examples.noisy(noise, seed))
    hidden_output = evaluate_hidden_layers(layers.hidden, layers.activation, features)
    answers = evaluate_output_layer(layers, hidden_output, features)
    contact, std, *_ = network.outputs_from_answers(answers)

    # Fit the linear functions for the angles. Their inputs are the outputs of the hidden units that influence the
    # contact, followed by the features.
    contact_weight = layers.last.weight[:, :N_CONTACT_ANSWERS]  # shape (n_hidden, N_CONTACT_ANSWERS)
    is_contact_unit = np.any(contact_weight != 0.0, axis=1)
    inputs = np.hstack([hidden_output[:, is_contact_unit], features])
    with threadpool_limits(1):  # the steps are so small that two threads would be slower than one
        angle_layer = _fit_angles(inputs, _errors_over_std(examples.contact, contact, std))

    # Split the fitted weights into those of the hidden units and those of the features. All hidden units that do not
    # influence the contact get the weight zero.
    n_contact_unit = np.count_nonzero(is_contact_unit)
    contact_unit_weight, skip_weight = np.split(angle_layer.weight, [n_contact_unit])
    hidden_weight = np.zeros((hidden_output.shape[1], 3))
    hidden_weight[is_contact_unit] = contact_unit_weight

    # The correlations are weighted sums of cosines of a, b, a - b, a + b and so on. The new output layer computes these
    # eight arguments instead of the three angles.
    argument_layer = Layer(hidden_weight @ ANGLES_TO_COSINE_ARGUMENTS, angle_layer.bias @ ANGLES_TO_COSINE_ARGUMENTS)
    return network.with_angles(argument_layer, skip_weight @ ANGLES_TO_COSINE_ARGUMENTS)


def _errors_over_std(true_contact: Array, contact: Array, std: Array) -> Array:
    """Return true minus estimated (x, y, ln F), divided by the estimated standard deviations, shape (n, 3).

    Args:
        true_contact: True contacts (x, y, F), shape (n, 3), mm and N.
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        std: Estimated standard deviations of (x, y, F), shape (n, 3), mm and N.
    """
    position_error = true_contact[:, :2] - contact[:, :2]
    log_force_error = np.log(true_contact[:, 2] / contact[:, 2])
    log_force_std = std[:, 2] / contact[:, 2]  # because d ln F = dF / F
    error = np.column_stack([position_error, log_force_error])
    error_std = np.column_stack([std[:, :2], log_force_std])
    return np.asarray(error / error_std)


def _fit_angles(inputs: Array, deviation: Array) -> Layer[Array]:
    """Fit a linear layer that computes the angles a, b and c.

    The fit minimises `correlation_loss` plus a penalty on the squared weights. For the fit, the inputs are whitened: a
    linear map gives them unit variances without correlations. The returned layer includes this map.

    The variables of the minimisation are the bias and the weights divided by `FIRST_STEP`. The first step of the L-BFGS
    method changes the variables by about 1. It therefore changes the bias and the weights by about `FIRST_STEP`.

    Args:
        inputs: Inputs of the layer, shape (n, n_input).
        deviation: Errors of (x, y, ln F) divided by their standard deviations, shape (n, 3).

    Returns:
        Layer from the inputs to the angles: weight, shape (n_input, 3), and bias, shape (3,).
    """
    # Compute whitened inputs, shape (n, n_input), and limited errors, shape (3, n), in single precision.
    mean, matrix = whitening(inputs[::WHITENING_STRIDE], MIN_RELATIVE_STD)
    whitened_inputs = np.ascontiguousarray((inputs - mean) @ matrix, dtype=np.float32)
    clipped_deviation = np.clip(deviation, -MAX_DEVIATION, MAX_DEVIATION)
    transposed_deviation = np.ascontiguousarray(clipped_deviation.T, dtype=np.float32)
    n_input = inputs.shape[1]

    def loss(scaled_parameters: Array) -> tuple[float, Array]:
        """Return the loss and its gradient with respect to the scaled parameters.

        Args:
            scaled_parameters: Bias and weights of the three angles divided by `FIRST_STEP`, shape (3 * (1 + n_input),).
        """
        parameters = FIRST_STEP * scaled_parameters.reshape(-1, 3)
        bias, weight = np.split(parameters, [1])  # shapes (1, 3) and (n_input, 3)
        float32_weight = weight.astype(np.float32)
        angles = float32_weight.T @ whitened_inputs.T + bias.astype(np.float32).T  # shape (3, n)
        loss_without_penalty, angle_gradient = correlation_loss(angles, transposed_deviation)
        penalty = RIDGE * float((weight**2).sum())

        # Compute the gradient with respect to the parameters by the chain rule. The gradient with respect to the scaled
        # parameters is `FIRST_STEP` times as large.
        bias_gradient = angle_gradient.sum(axis=1, dtype=float)
        weight_gradient = whitened_inputs.T @ angle_gradient.T + 2.0 * RIDGE * float32_weight
        parameter_gradient = np.vstack([bias_gradient, weight_gradient])
        return loss_without_penalty + penalty, FIRST_STEP * parameter_gradient.ravel()

    # The minimisation begins without correlations: all angles are right angles, whose cosines are zero.
    start = np.zeros((1 + n_input, 3))  # the first row contains the bias
    start[0] = 0.5 * np.pi / FIRST_STEP
    scaled_solution = _minimise(loss, start.ravel())
    solution = FIRST_STEP * scaled_solution.reshape(start.shape)
    bias, weight_of_whitened = np.split(solution, [1])

    # Include the whitening in the layer:
    # ((inputs - mean) @ matrix) @ weight_of_whitened + bias = inputs @ weight + (bias - mean @ weight)
    weight = matrix @ weight_of_whitened
    return Layer(weight, bias[0] - mean @ weight)


def _minimise(loss: Callable[[Array], tuple[float, Array]], start: Array) -> Array:
    """Minimise a loss by the L-BFGS method, and start the method again if a line search fails.

    The minimisation ends if no derivative exceeds a tolerance, or after `MAX_ITERATIONS` iterations. If a line search
    fails in each of `MAX_STARTS` starts, the minimisation also ends, and a warning is logged.

    The variables are parameters divided by `FIRST_STEP`. The derivatives with respect to the variables are therefore
    `FIRST_STEP` times the derivatives with respect to the parameters.

    Args:
        loss: Function that returns the loss and its gradient for given variables.
        start: Variables at which the minimisation starts, shape (n,).

    Returns:
        Variables at which the minimisation ended, shape (n,).
    """
    tolerance = FIRST_STEP * GRADIENT_TOLERANCE  # for derivatives with respect to the variables
    # With ftol = 0, a small change of the loss does not end the search.
    options = {"ftol": 0.0, "gtol": tolerance, "maxcor": N_UPDATES}
    variables = start
    remaining_iterations = MAX_ITERATIONS
    for _ in range(MAX_STARTS):
        start_options = options | {"maxiter": remaining_iterations}
        result = minimize(loss, variables, jac=True, method="L-BFGS-B", options=start_options)
        variables = result.x
        remaining_iterations -= result.nit
        is_converged = np.abs(result.jac).max() <= tolerance
        if is_converged or remaining_iterations <= 0:
            return np.asarray(variables)
        # Otherwise, a line search has failed. The next start begins at the present variables.
    largest_gradient = np.abs(result.jac).max() / FIRST_STEP  # in the last start, with respect to the parameters
    _log.warning("the training of the correlations has not converged: the gradient is %.1g", largest_gradient)
    return np.asarray(variables)


def correlation_loss(angles: Array | Singles, deviation: Array | Singles) -> tuple[float, Array | Singles]:
    """Compute the negative logarithm of the Gaussian likelihood of correlated errors with unit variances.

    Terms that do not depend on the angles are omitted. The Cholesky factor of the correlation matrix has the rows (1,
    0, 0), (cos a, sin a, 0) and (cos b, sin b cos c, sin b sin c). The errors are whitened with the inverse of this
    factor. The absolute values of the sines are limited to at least `MIN_SINE`.

    Args:
        angles: Angles a, b and c, shape (3, n), rad.
        deviation: Errors of x, y and ln F divided by their standard deviations, shape (3, n).

    Returns:
        Mean of the loss over the n errors, and the derivatives of the mean with respect to the angles, shape (3, n).
    """
    sines = np.sin(angles)
    cos_a, cos_b, cos_c = np.cos(angles)
    sin_a, sin_b, sin_c = np.copysign(np.maximum(np.abs(sines), MIN_SINE), sines)

    # Whiten the errors by the inverse of the Cholesky factor, row by row. The determinant of the factor is
    # sin a sin b sin c. The square of `white_x` is omitted, because it does not depend on the angles.
    x_deviation, y_deviation, force_deviation = deviation
    white_x = x_deviation
    white_y = (y_deviation - cos_a * white_x) / sin_a
    white_force = (force_deviation - cos_b * white_x - sin_b * cos_c * white_y) / (sin_b * sin_c)
    loss = np.log(np.abs(sin_a * sin_b * sin_c)) + 0.5 * (white_y**2 + white_force**2)

    # Compute the derivatives of the loss with respect to a, b and c.
    cot_a = cos_a / sin_a
    cot_b = cos_b / sin_b
    cot_c = cos_c / sin_c
    a_derivative = cot_a + (white_y - white_force * cot_c) * (white_x - cot_a * white_y)
    b_derivative = cot_b + white_force * ((white_x - cot_b * cos_c * white_y) / sin_c - cot_b * white_force)
    c_derivative = cot_c + white_force * (white_y - cot_c * white_force)
    gradient = np.stack([a_derivative, b_derivative, c_derivative]) / np.float32(angles.shape[1])
    return float(loss.mean(dtype=float)), gradient
