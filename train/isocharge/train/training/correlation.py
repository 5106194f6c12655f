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
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.simulate import NoiseModel
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.folding import KNOWN, FoldedNetwork
from isocharge.train.training.network import whitening

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
"""How often the search may begin anew, as a line search may find no step where two unit vectors nearly meet; the steps
of each (more change the coverage by less than 0.005), and those that its idea of the curvature is made of."""

FARTHEST = 5.0
"""Deviations up to which an error counts: beyond it is none of a Gaussian."""

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
    logs = network.inputs(charge)
    features = network.layers.features(logs)
    contact, std, *_ = network.of_answers(network.layers.from_features(features, logs))
    errors = np.column_stack([truth[:, :2] - contact[:, :2], np.log(truth[:, 2] / contact[:, 2])])
    weight, bias = network.layers.last
    of_contact = weight[:, :KNOWN].any(axis=1)
    features = np.hstack([features[:, of_contact], logs])
    deviation = errors / np.column_stack([std[:, :2], std[:, 2] / contact[:, 2]])
    with threadpool_limits(1):  # many small steps: two threads take three times as long
        slopes, angles = _fit_angles(features, deviation)
    head = np.zeros((len(weight), 3))
    head[of_contact] = slopes[: -logs.shape[1]]

    def widened(values: Array, added: Array) -> Array:
        return np.concatenate([values[..., :KNOWN], added @ ANGLE_SUMS, values[..., KNOWN:]], axis=-1)

    last = widened(weight, head), widened(bias, angles)
    skip = widened(network.layers.skip, slopes[-logs.shape[1] :])
    return replace(network, layers=replace(network.layers, last=last, skip=skip))


def _fit_angles(features: Array, deviation: Array) -> tuple[Array, Array]:
    """Slopes (k, 3) and shift (3,) of the angles, from features (n, k) and errors over their deviations (n, 3)."""
    mean, matrix = whitening(features[::SPARSE], LEAST_SPREAD)
    inputs = torch.from_numpy((features - mean) @ matrix)
    targets = torch.from_numpy(np.clip(deviation, -FARTHEST, FARTHEST))

    def loss(values: Array) -> tuple[float, Array]:
        head = torch.tensor(values.reshape(-1, 3), requires_grad=True)
        angles = inputs @ head[1:] + head[0]
        total = correlation_loss(angles, targets) + RIDGE * torch.sum(head[1:] ** 2)
        total.backward()  # type: ignore[no-untyped-call]
        return total.item(), np.asarray(head.grad).ravel()

    start = np.zeros((1 + features.shape[1], 3))
    start[0] = 0.5 * np.pi  # no correlation
    found, options = start.ravel(), {"ftol": 0.0, "gtol": SMALL_GRADIENT, "maxiter": STEPS, "maxcor": REMEMBERED}
    for _ in range(STARTS):
        result = minimize(loss, found, jac=True, method="L-BFGS-B", options=options)
        found = result.x
        if result.status < 2:  # at its minimum or after its steps
            break
    else:
        _log.warning("the correlations are not learned to the end: the gradient is %.1g", np.abs(result.jac).max())
    found = found.reshape(start.shape)
    slopes = matrix @ found[1:]
    return slopes, found[0] - mean @ slopes


def correlation_loss(angles: Tensor, deviation: Tensor) -> Tensor:
    """Negative logarithm of a Gaussian likelihood with unit variances, but for a constant; shapes (n, 3)."""
    (sin_a, sin_b, sin_c), (cos_a, cos_b, cos_c) = angles.sin().T, angles.cos().T
    first, second, third = deviation.T
    second = (second - cos_a * first) / sin_a
    third = (third - cos_b * first - sin_b * cos_c * second) / (sin_b * sin_c)
    loss: Tensor = torch.log(torch.abs(sin_a * sin_b * sin_c)) + 0.5 * (second**2 + third**2)
    return loss.mean()
