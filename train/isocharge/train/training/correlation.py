"""How the errors of x, y and ln F go together: a linear head on a trained network, whose answers it leaves alone.

A correlation matrix is the Gram matrix of three unit vectors. With

    (1, 0, 0),  (cos a, sin a, 0),  (cos b, sin b cos c, sin b sin c)

any three angles give one that is valid, and the rows are its Cholesky factor. Products of sines and cosines are sums of
cosines, so the correlations are linear in eight of these:

    xy = cos a,  xF = cos b,
    yF = (cos(a - b) + cos(a + b)) / 2 + (cos(a - b - c) + cos(a - b + c) - cos(a + b - c) - cos(a + b + c)) / 4.

In a graph that is one node for the cosines and one for the sums. The angles are linear in the last hidden layer of the
contact network and in the logarithms of the charges, and learned by maximum likelihood from the network's errors.
"""

import logging

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array, Singles
from isocharge.common.perceptron import Layer, evaluate_hidden_layers, evaluate_output_layer
from isocharge.simulate import NoiseModel
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.features import whitening
from isocharge.train.training.folded_network import N_CONTACT_ANSWERS, FoldedNetwork

_log = logging.getLogger(__name__)

EXAMPLES = 30_000
"""Noisy presses that the head learns from."""

RIDGE = 1e-4
"""Weight of the squared coefficients in the loss, for features of unit variance: few presses do not turn it."""

LEAST_SPREAD = 0.02
"""Deviation of a combination of features, over the largest, below which it counts for less: its coefficient would be
large and be lost in the digits of a float32."""

SPARSE = 7
"""One example in so many is enough for the mean and the axes of the features."""

SMALL_GRADIENT = 2e-3
"""Largest derivative of the loss at its minimum."""

STARTS, STEPS, REMEMBERED = 5, 90, 20
"""How often the search may begin anew, as a line search may find no step where two unit vectors nearly meet; its steps
(more change the coverage by less than 0.005), and those that its idea of the curvature is made of."""

FIRST_STEP = 0.125
"""Length of a search's first step: a longer one leads to where unit vectors meet."""

FARTHEST = 5.0
"""Deviations up to which an error counts: beyond it is none of a Gaussian."""

LEAST_SINE = 1e-4
"""Sines of angles count as no smaller: the squares of what is divided by three of them are numbers of a float32."""

ANGLE_SUMS = np.array([[1, 0, 1, 1, 1, 1, 1, 1], [0, 1, -1, 1, -1, -1, 1, 1], [0, 0, 0, 0, -1, 1, -1, 1]], dtype=float)
"""From the angles (a, b, c) to the arguments of the cosines."""


def with_correlation(network: FoldedNetwork, presses: LabelledPresses, noise: NoiseModel, seed: int) -> FoldedNetwork:
    """The network with a head for the correlations; its other answers stay as they are.

    Args:
        network: Trained and folded.
        presses: Those that it learned from.
        noise: Added to their charges.
        seed: Of the noise.
    """
    examples = presses[np.arange(max(EXAMPLES, len(presses))) % len(presses)]
    charge, truth = examples.noisy(noise, seed), examples.contact
    logs = network.features.evaluate(charge)
    features = evaluate_hidden_layers(network.layers.hidden, network.layers.activation, logs)
    contact, std, *_ = network.outputs_from_answers(evaluate_output_layer(network.layers, features, logs))
    errors = np.column_stack([truth[:, :2] - contact[:, :2], np.log(truth[:, 2] / contact[:, 2])])
    weight, _ = network.layers.last
    of_contact = weight[:, :N_CONTACT_ANSWERS].any(axis=1)
    features = np.hstack([features[:, of_contact], logs])
    deviation = errors / np.column_stack([std[:, :2], std[:, 2] / contact[:, 2]])
    with threadpool_limits(1):  # many small steps: two threads take three times as long
        slopes, angles = _fit_angles(features, deviation)
    head = np.zeros((len(weight), 3))
    head[of_contact] = slopes[: -logs.shape[1]]
    last = Layer(head @ ANGLE_SUMS, angles @ ANGLE_SUMS)
    return network.with_angles(last, slopes[-logs.shape[1] :] @ ANGLE_SUMS)


def _fit_angles(features: Array, deviation: Array) -> tuple[Array, Array]:
    """Slopes (k, 3) and shift (3,) of the angles, from features (n, k) and errors over their deviations (n, 3)."""
    mean, matrix = whitening(features[::SPARSE], LEAST_SPREAD)
    inputs = np.ascontiguousarray((features - mean) @ matrix, dtype=np.float32)
    targets = np.ascontiguousarray(np.clip(deviation, -FARTHEST, FARTHEST).T, dtype=np.float32)

    def loss(steps: Array) -> tuple[float, Array]:
        head = FIRST_STEP * steps.reshape(-1, 3)
        slopes = head[1:].astype(np.float32)
        angles = slopes.T @ inputs.T + head[0].astype(np.float32)[:, None]
        total, by_angle = correlation_loss(angles, targets)
        gradient = np.vstack([by_angle.sum(axis=1, dtype=float), inputs.T @ by_angle.T + 2.0 * RIDGE * slopes])
        return total + RIDGE * float((head[1:] ** 2).sum()), FIRST_STEP * gradient.ravel()

    start = np.zeros((1 + features.shape[1], 3))
    start[0] = 0.5 * np.pi / FIRST_STEP  # no correlation
    found, options = start.ravel(), {"ftol": 0.0, "gtol": FIRST_STEP * SMALL_GRADIENT, "maxcor": REMEMBERED}
    left = STEPS
    for _ in range(STARTS):
        result = minimize(loss, found, jac=True, method="L-BFGS-B", options=options | {"maxiter": left})
        found, left = result.x, left - result.nit
        if left <= 0 or np.abs(result.jac).max() <= options["gtol"]:
            break
    else:
        largest = np.abs(result.jac).max() / FIRST_STEP
        _log.warning("the correlations are not learned to the end: the gradient is %.1g", largest)
    found *= FIRST_STEP
    found = found.reshape(start.shape)
    slopes = matrix @ found[1:]
    return slopes, found[0] - mean @ slopes


def correlation_loss(angles: Array | Singles, deviation: Array | Singles) -> tuple[float, Array | Singles]:
    """Negative logarithm of a Gaussian likelihood with unit variances, but for a constant, mean over n errors.

    Args:
        angles: Shape (3, n).
        deviation: Errors over their deviations, shape (3, n).

    Returns:
        The loss, and its derivatives by the angles, shape (3, n).
    """
    sine, (cos_a, cos_b, cos_c) = np.sin(angles), np.cos(angles)
    sin_a, sin_b, sin_c = np.copysign(np.maximum(np.abs(sine), LEAST_SINE), sine)
    first, second, third = deviation
    second = (second - cos_a * first) / sin_a
    third = (third - cos_b * first - sin_b * cos_c * second) / (sin_b * sin_c)
    loss = np.log(np.abs(sin_a * sin_b * sin_c)) + 0.5 * (second**2 + third**2)
    cot_a, cot_b, cot_c = (cos / sin for cos, sin in ((cos_a, sin_a), (cos_b, sin_b), (cos_c, sin_c)))
    by_a = cot_a + (second - third * cot_c) * (first - cot_a * second)
    by_b = cot_b + third * ((first - cot_b * cos_c * second) / sin_c - cot_b * third)
    by_c = cot_c + third * (second - cot_c * third)
    return float(loss.mean(dtype=float)), np.stack([by_a, by_b, by_c]) / np.float32(angles.shape[1])
