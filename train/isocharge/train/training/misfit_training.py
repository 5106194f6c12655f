"""Examples and loss for the training of the misfit perceptron.

An example consists of a set of charges and the residuals of these charges with respect to the nearest contact. The
nearest contact is found by a search.
"""

from dataclasses import dataclass

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
from isocharge.train.training.split import VALIDATION_FRACTION, Split

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


@dataclass(frozen=True)
class MisfitExamples:
    """Source of the examples from which the misfit network learns.

    An example consists of a set of charges and their residuals with respect to the nearest contact.

    Attributes:
        split: Presses for training, and the charge field in which the search finds the nearest contacts.
        features: Input features of the network. Their limits are also the limits of the charges of both signs.
        config: Noise, number of examples and seed.
    """

    split: Split
    features: WhitenedFeatures
    config: TrainingConfig

    def inner(self) -> Array:
        """Draw examples from presses inside the working area; see `draw_misfit_examples`.

        Returns:
            Array of shape (2, n, n_electrode): first the charges, pC, and then their residuals with respect to the
            nearest contact, in standard deviations of the noise.
        """
        return draw_misfit_examples(
            self.split.train,
            self.split.field,
            self._noise(),
            self._example_count,
            self.config.seed,
            options=self._options,
        )

    def with_outside(self, inner_examples: Array, outside: OutsidePresses | None) -> Array:
        """Replace a fraction of the examples by examples of presses outside the working area.

        Args:
            inner_examples: Result of `inner`.
            outside: Presses outside the working area. If there are none (None), the examples are returned unchanged.

        Returns:
            Charges and residuals in random order, with the shape and the units of `inner_examples`.
        """
        if outside is None:
            return inner_examples
        seed = self.config.seed
        outside_share = MANY_OUTSIDE_SHARE if self._has_many_electrodes else OUTSIDE_SHARE
        n_outside = round(outside_share * self._example_count)
        outside_examples = draw_outside_examples(
            outside.train.charge,
            self.split.field,
            self._noise(),
            n_outside,
            seed,
            options=self._options,
        )

        # Arrays of examples have the shape (2, n, n_electrode). The first `n_outside` examples are replaced. The second
        # axis is then shuffled, because the last examples are used for validation.
        kept_examples = inner_examples[:, n_outside:]
        examples = np.concatenate([kept_examples, outside_examples], axis=1)
        return np.random.default_rng(seed).permutation(examples, axis=1)

    @property
    def _example_count(self) -> int:
        """Number of all examples: sets of charges with their residuals."""
        return self.config.misfit_charge_count(self.features.charge_features.n_electrode)

    @property
    def _has_many_electrodes(self) -> bool:
        """Whether the sensor has more than `FEW_ELECTRODES` electrodes."""
        return self.features.charge_features.n_electrode > FEW_ELECTRODES

    @property
    def _has_positive_charges(self) -> bool:
        """Whether all charges are positive, so that the input features are logarithms."""
        return self.features.charge_features.mean is None  # only features of charges of both signs have a mean

    @property
    def _options(self) -> ExampleOptions:
        """Options for drawing examples: the number of starts of each search, and the limits of the charges.

        The limits are those of the input features. For positive charges, the default limits are used.
        """
        starts = MANY_SEARCH_STARTS if self._has_many_electrodes else SEARCH_STARTS
        if self._has_positive_charges:
            return ExampleOptions(starts=starts)
        charge_features = self.features.charge_features
        return ExampleOptions(starts=starts, limits=(charge_features.low_pC, charge_features.high_pC))

    def _noise(self) -> Noise:
        """Return the noise of presses without faults.

        For charges of both signs, the values of the noise are repeated for each channel.
        """
        noise = misfit_noise(self.config.noise_model)
        if self._has_positive_charges:
            return noise
        return ChannelNoise.alike(noise, self.features.charge_features.n_electrode)


def misfit_stage(network: InverseNetwork, examples: Array, config: TrainingConfig) -> TrainingStage:
    """Define the training of the misfit perceptron.

    The targets of the perceptron are the residuals with compressed lengths. Examples with misfits far above
    `FOCUS_MISFIT` have smaller weights than other examples.

    Args:
        network: Network whose misfit perceptron is trained.
        examples: Charges Q, pC, and their residuals (Q - Q(c)) / sigma, shape (2, n, n_electrode), where c is the
            nearest contact and sigma the standard deviation of the noise. The last examples are used for validation.
        config: Number of steps and batch size.
    """
    charges, residuals = examples
    inputs = network.inputs(as_tensor(charges))
    targets = compress_length(torch.tensor(residuals)).float()
    n_validation = max(1, round(VALIDATION_FRACTION * config.hold_out * len(inputs)))
    n_train = len(inputs) - n_validation
    focus = float(np.arcsinh(FOCUS_MISFIT / MISFIT_UNIT))  # compressed length of a residual of length `FOCUS_MISFIT`

    def distance(rows: Tensor | slice) -> Tensor:
        """Return the weighted mean of the squared distances between outputs and targets for selected examples."""
        return focused_squared_distance(network.misfit_vector(inputs[rows]), targets[rows], focus)

    def loss(_: int, random: torch.Generator) -> Tensor:  # the loss is the same in every step
        """Return the weighted mean of the squared distances for a random batch of the training examples."""
        batch_rows = torch.randint(n_train, (config.batch,), generator=random)
        return distance(batch_rows)

    def score() -> tuple[float, str]:
        """Return the weighted mean of the squared distances for the validation examples, and a text about this mean."""
        validation_loss = distance(slice(n_train, None)).item()
        return validation_loss, f"{validation_loss:.4f} on watched charges"

    steps = config.misfit_step_count(network.n_electrode)
    return TrainingStage("misfit", network.misfit_vector, loss, score, steps, rate_factor=MISFIT_RATE_FACTOR)
