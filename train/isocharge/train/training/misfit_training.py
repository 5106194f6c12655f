"""Training of the misfit perceptron: its examples and its loss.

An example consists of a set of charges and the residuals of these charges with respect to the nearest contact. The
nearest contact is found by a search. Most charges are the charges of a press with added errors. The standard deviation
of the errors is between a tenth and a thousand times the standard deviation of the noise. The errors affect any number
of electrodes, so that the examples include wrong gains, dead electrodes, and charges that no press causes.
"""

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.train.data.channel_noise import ChannelNoise, misfit_noise
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.folded_network import ChargeFeatures
from isocharge.train.training.network import InverseNetwork, as_tensor, compress_length
from isocharge.train.training.training_data import Split

LOG_DISTANCES = (-1.0, 3.0)
"""Decimal logarithms of the smallest and the largest distance from a press, in standard deviations of the noise."""


def draw_charges(rng: np.random.Generator, charge: Array, noise: ChannelNoise, count: int) -> Array:
    """Draw charges that differ from the charges of presses by errors of very different sizes.

    Presses are chosen at random, and normally distributed errors are added to the levels of their charges. The level of
    a charge is its value on a scale on which the noise has the standard deviation 1. In each press, a random share of
    the electrodes has errors with one random standard deviation, from less than the noise to a thousand times the
    noise. The logarithm of this standard deviation is uniformly distributed within `LOG_DISTANCES`. The errors of the
    other electrodes are as large as the noise.

    Args:
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC, from which presses are chosen at random.
        noise: Noise of good presses.
        count: Number of sets of charges to draw.

    Returns:
        Charges, shape (count, n_electrode), pC.
    """
    rows = rng.integers(len(charge), size=count)
    level = noise.level(charge[rows])
    # Whether an electrode has a special error, which is not due to noise. Each press has its own probability of them.
    is_special = rng.random(level.shape) < rng.random((count, 1))
    special_std = 10.0 ** rng.uniform(*LOG_DISTANCES, (count, 1))  # `LOG_DISTANCES` contains decimal logarithms
    error_std = np.where(is_special, special_std, 1.0)  # the noise has the standard deviation 1
    error = error_std * rng.standard_normal(level.shape)
    return noise.charge(level + error)


OUTSIDE_SHARE = 0.25
"""Share of the examples of the misfit network that are presses outside the working area, dimensionless.

If the dataset has no presses outside the working area, this share is zero.
"""


FOCUS_LENGTH = float(np.arcsinh(2.0))
"""Compressed length of the misfit vector at which the weight of an example is half of the largest weight.

The misfit is then twice the threshold of the flag `misfit`.
"""


def misfit_examples(
    split: Split, features: ChargeFeatures, outside: OutsidePresses | None, config: TrainingConfig
) -> Array:
    """Draw the examples from which the misfit network learns, for a model of simulated presses.

    An example consists of charges, and of their residual: the difference from the charges of the nearest contact. Most
    charges are drawn at random (`draw_charges`). All other charges belong to presses outside the working area.

    Args:
        split: Presses for training, and the map from contacts to charges with which the nearest contacts are found.
        features: Input features of the network. The charges of the examples are limited to the range of the features.
        outside: Presses outside the working area, from which a share of the examples is drawn; None if there are none.
        config: Noise, number of examples and seed.

    Returns:
        Array of shape (2, n, n_electrode): first the charges, pC, and then their residuals with respect to the nearest
        contact, in standard deviations of the noise.
    """
    rng = np.random.default_rng(config.seed)
    noise = ChannelNoise.alike(misfit_noise(config.noise_model))  # the same noise on every electrode
    count = config.sizes(features.n_electrode).misfit_charges
    outside_charge = np.empty((0, features.n_electrode))
    if outside is not None:
        rows = rng.integers(len(outside.train), size=round(OUTSIDE_SHARE * count))
        outside_charge = noise.add(outside.train.charge[rows], rng)
    drawn_charge = draw_charges(rng, split.train.charge, noise, count - len(outside_charge))
    charge = np.clip(np.concatenate([drawn_charge, outside_charge]), features.low_pC, features.high_pC)
    # Find the residuals at the nearest contacts in parts, so that the training can be stopped between them.
    parts = np.array_split(charge, 20)
    searches = [search(split.field, part, noise.sigma(part)) for part in track(parts, "nearest contacts")]
    return np.stack([charge, np.concatenate([residual for _contact, residual in searches])])


def misfit_stage(network: InverseNetwork, examples: Array, config: TrainingConfig) -> TrainingStage:
    """Define the training of the misfit perceptron.

    The targets of the perceptron are the residuals, whose lengths are the misfits. The inverse hyperbolic sine
    compresses the lengths. Examples with vectors much longer than `FOCUS_LENGTH` have smaller weights than other
    examples.

    Args:
        network: Network whose misfit perceptron is trained.
        examples: Charges Q, pC, and their residuals (Q - Q(c)) / sigma, shape (2, n, n_electrode). Here, c is the
            nearest contact, and sigma is the standard deviation of the noise.
        config: Number of steps, batch size, learning rate and seed.
    """
    charges, residuals = examples
    inputs = network.inputs(as_tensor(charges))
    targets = compress_length(torch.tensor(residuals)).float()

    def loss(random: torch.Generator) -> Tensor:
        """Return the mean of the weighted squared distances for a random batch of the examples."""
        rows = torch.randint(len(inputs), (config.batch,), generator=random)
        return focused_squared_distance(network.misfit_vector(inputs[rows]), targets[rows])

    # `network.misfit_vector` is the misfit perceptron, which is called above, and whose weights are trained.
    steps = config.sizes(network.features.n_electrode).misfit_steps
    return TrainingStage("misfit", network.misfit_vector, loss, steps, config.learning_rate, config.seed)


def focused_squared_distance(vector: Tensor, target: Tensor) -> Tensor:
    """Compute the mean of the weighted squared distances between vectors, with small weights for long targets.

    The weight is 1 / (1 + |target|^2 / FOCUS_LENGTH^2). With these weights, the network becomes most accurate for
    misfits up to the threshold of the flag `misfit`. The exact value of a misfit far above this threshold matters
    little.

    Args:
        vector: Estimated vectors, shape (n, n_electrode).
        target: True vectors, same shape.
    """
    squared_length = torch.sum(target**2, dim=-1)
    weight = 1.0 / (1.0 + squared_length / FOCUS_LENGTH**2)
    squared_distance = torch.sum((vector - target) ** 2, dim=-1)
    return (weight * squared_distance).mean()
