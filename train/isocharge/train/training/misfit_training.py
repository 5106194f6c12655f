"""Examples and loss for the training of the misfit perceptron.

An example consists of a set of charges and the residuals of these charges with respect to the nearest contact. The
nearest contact is found by a search.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.common.defaults import FEW_ELECTRODES
from isocharge.train.data.channel_noise import ChannelNoise, Noise
from isocharge.train.data.misfit_charges import (
    ExampleOptions,
    draw_misfit_examples,
    draw_outside_examples,
    misfit_noise,
)
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.folded_network import MISFIT_UNIT
from isocharge.train.training.losses import focused_squared_distance
from isocharge.train.training.network import InverseNetwork, as_tensor, compress_length
from isocharge.train.training.split import Split

MISFIT_RATE_FACTOR = 1.5
"""Learning rate of the misfit network, relative to the learning rate of the contact network. It can be larger, because
the targets of the misfit network have no noise."""

OUTSIDE_SHARE = 0.15
"""Share of the examples of the misfit network that are presses outside the working area, dimensionless.

If the dataset has no such presses, there are no such examples.
"""

MANY_OUTSIDE_SHARE = 0.3
"""Share of presses outside the working area for sensors with more than `FEW_ELECTRODES` electrodes, dimensionless.

It is larger, because the misfit of these sensors can reveal nearly all presses outside the working area.
"""

SEARCH_STARTS = 2
"""Number of starts of a search for the nearest contact."""

MANY_SEARCH_STARTS = 4
"""Number of starts of a search for sensors with more than `FEW_ELECTRODES` electrodes.

It is larger, because the misfit of these sensors has more local minima.
"""

FOCUS_MISFIT = 10.0
"""Misfit at which the weight of an example is half of the largest weight, in standard deviations of the noise.

It is twice the smallest threshold of the flag `misfit`.
"""


def misfit_examples(
    split: Split, features: WhitenedFeatures, outside: OutsidePresses | None, config: TrainingConfig
) -> Array:
    """Draw the examples from which the misfit network of simulated presses learns.

    Args:
        split: Presses for training, and the charge field in which the search finds the nearest contacts.
        features: Input features of the network. Their limits are also the limits of the charges of both signs.
        outside: Presses outside the working area, from which a share of the examples is drawn; None if there are none.
        config: Noise, number of examples and seed.

    Returns:
        Array of shape (2, n, n_electrode): first the charges, pC, and then their residuals with respect to the nearest
        contact, in standard deviations of the noise.
    """
    charge_features = features.charge_features
    n_electrode = charge_features.n_electrode
    has_many_electrodes = n_electrode > FEW_ELECTRODES
    noise: Noise = misfit_noise(config.noise_model)
    options = ExampleOptions(starts=MANY_SEARCH_STARTS if has_many_electrodes else SEARCH_STARTS)
    if charge_features.mean is not None:  # the charges have both signs
        noise = ChannelNoise.alike(misfit_noise(config.noise_model), n_electrode)
        options = replace(options, limits=(charge_features.low_pC, charge_features.high_pC))

    count = config.sizes(n_electrode).misfit_charges
    n_outside = 0
    if outside is not None:
        n_outside = round((MANY_OUTSIDE_SHARE if has_many_electrodes else OUTSIDE_SHARE) * count)
    examples = draw_misfit_examples(split.train, split.field, noise, count - n_outside, config.seed, options=options)
    if outside is None:
        return examples
    outside_examples = draw_outside_examples(
        outside.train.charge, split.field, noise, n_outside, config.seed, options=options
    )
    return np.concatenate([examples, outside_examples], axis=1)


def misfit_stage(network: InverseNetwork, examples: Array, config: TrainingConfig) -> TrainingStage:
    """Define the training of the misfit perceptron.

    The targets of the perceptron are the residuals with compressed lengths. Examples with misfits far above
    `FOCUS_MISFIT` have smaller weights than other examples.

    Args:
        network: Network whose misfit perceptron is trained.
        examples: Charges Q, pC, and their residuals (Q - Q(c)) / sigma, shape (2, n, n_electrode), where c is the
            nearest contact and sigma the standard deviation of the noise.
        config: Number of steps and batch size.
    """
    charges, residuals = examples
    inputs = network.inputs(as_tensor(charges))
    targets = compress_length(torch.tensor(residuals)).float()
    focus = float(np.arcsinh(FOCUS_MISFIT / MISFIT_UNIT))  # compressed length of a residual of length `FOCUS_MISFIT`

    def loss(_: float, random: torch.Generator) -> Tensor:  # the loss is the same in every step
        """Return the weighted mean of the squared distances for a random batch of the examples."""
        rows = torch.randint(len(inputs), (config.batch,), generator=random)
        return focused_squared_distance(network.misfit_vector(inputs[rows]), targets[rows], focus)

    steps = config.sizes(network.n_electrode).misfit_steps
    rate = MISFIT_RATE_FACTOR * config.learning_rate
    return TrainingStage("misfit", network.misfit_vector, loss, steps, rate, config.seed)
