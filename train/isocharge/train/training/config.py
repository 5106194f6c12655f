"""Settings of a training.

A TOML file with the tables `network` and `training` can replace the default values of the settings.
"""

from typing import Annotated, Any, Literal, NamedTuple

from msgspec import Meta
from msgspec.structs import replace

from isocharge.common.defaults import FEW_ELECTRODES
from isocharge.common.errors import ConfigError
from isocharge.common.files import StrPath
from isocharge.common.structs import Settings, WrongKey, convert, plain_values, read_toml
from isocharge.simulate import NoiseModel, noise_model

Width = Annotated[int, Meta(ge=1, le=4096)]
Widths = Annotated[tuple[Width, ...], Meta(min_length=1, description="widths from 1 to 4096")]
Count = Annotated[int, Meta(ge=1, le=10_000_000)]


class Sizes(NamedTuple):
    """Sizes of the networks and of their training. The default sizes depend on the number of electrodes.

    Attributes:
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the hidden layers of the misfit network.
        steps: Number of optimiser steps of the contact network.
        misfit_steps: Number of optimiser steps of the misfit network.
        misfit_charges: Number of sets of charges from which the misfit network learns.
        rate_factor: Factor by which the learning rate of the contact network is multiplied. The factor is less than 1
            for many electrodes, because the loss sometimes increases with the full learning rate.
    """

    hidden: Widths
    misfit_hidden: Widths
    steps: int
    misfit_steps: int
    misfit_charges: int
    rate_factor: float

    @classmethod
    def for_electrodes(cls, n_electrode: int) -> "Sizes":
        """Return the default sizes for a number of electrodes."""
        return FEW_ELECTRODE_SIZES if n_electrode <= FEW_ELECTRODES else MANY_ELECTRODE_SIZES


FEW_ELECTRODE_SIZES = Sizes(
    (96,) * 3, (64,) * 3, steps=1_500, misfit_steps=1_500, misfit_charges=40_000, rate_factor=1.0
)
"""Default sizes for at most `FEW_ELECTRODES` electrodes."""

MANY_ELECTRODE_SIZES = Sizes(
    (128,) * 4, (96,) * 4, steps=6_000, misfit_steps=3_000, misfit_charges=80_000, rate_factor=0.5
)
"""Default sizes for more electrodes, whose working areas are larger and whose charges have more dimensions."""


class NetworkConfig(Settings, frozen=True):
    """Sizes and number format of the contact network and of the misfit network.

    Attributes:
        hidden: Widths of the hidden layers of the contact network; None for the default.
        misfit_hidden: Widths of the hidden layers of the misfit network, which must have as many hidden layers as the
            contact network; None for the default.
        activation: Activation of the hidden layers, which is always the hyperbolic tangent.
        weights: "float32", or "int8" to round the weights between hidden layers to 8 bits and then train the other
            weights further. In C, the rounded weights take a quarter of the memory.
    """

    hidden: Widths | None = None
    misfit_hidden: Widths | None = None
    activation: Literal["tanh"] = "tanh"
    weights: Literal["float32", "int8"] = "float32"

    def __post_init__(self) -> None:
        """Check the widths, and raise WrongKey for wrong widths.

        If the widths of both networks are given, both networks must have the same number of hidden layers, because they
        are folded into one perceptron.
        """
        if self.hidden and self.misfit_hidden and len(self.misfit_hidden) != len(self.hidden):
            expected = f"as many layers as network.hidden ({len(self.hidden)}; they run side by side)"
            raise WrongKey("misfit_hidden", expected, list(self.misfit_hidden))

    def widths(self, n_electrode: int) -> tuple[Widths, Widths]:
        """Return the widths of the hidden layers of the contact network and of the misfit network.

        Widths that are not given are defaults, which are equal for all layers of a network. If the widths of only one
        network are given, the other network has as many layers.

        Args:
            n_electrode: Number of electrodes, which determines the defaults.
        """
        default = Sizes.for_electrodes(n_electrode)
        layer_count = len(self.hidden or self.misfit_hidden or default.hidden)
        hidden = self.hidden or default.hidden[:1] * layer_count  # the tuple (first width,), repeated for each layer
        misfit_hidden = self.misfit_hidden or default.misfit_hidden[:1] * layer_count
        return hidden, misfit_hidden


class TrainingConfig(Settings, frozen=True):
    """Settings of the optimisation.

    Attributes:
        steps: Number of optimiser steps of the contact network; None for the default.
        misfit_steps: Number of optimiser steps of the misfit network; None for the default.
        misfit_charges: Number of sets of charges from which the misfit network learns; None for the default.
        batch: Number of presses in a batch.
        learning_rate: Largest learning rate of the optimiser SOAP.
        hold_out: Fraction of the positions that are used for testing.
        noise: Noise that is drawn again in every step, as a `NoiseModel` or as a name that `noise_model` accepts.
        seed: Seed of the initial weights, the batches and the noise.
        threads: Number of CPU threads. For networks of these sizes, one thread is nearly as fast as two threads, and
            programs on the second core do not delay the training.
    """

    steps: Count | None = None
    misfit_steps: Count | None = None
    misfit_charges: Annotated[int, Meta(ge=1_000, le=10_000_000)] | None = None
    batch: Annotated[int, Meta(ge=1, le=1_000_000)] = 512
    learning_rate: Annotated[float, Meta(gt=0.0, lt=1.0, description="a number between 0 and 1")] = 2e-2
    hold_out: Annotated[float, Meta(ge=0.01, lt=0.6, description="a number from 0.01 to 0.6")] = 0.1
    noise: Annotated[str | NoiseModel, Meta(description="a text")] = "reference"
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    threads: Annotated[int, Meta(ge=1, le=64)] = 1

    def sizes(self, n_electrode: int) -> Sizes:
        """Return the default sizes for a number of electrodes, in which the given settings replace the defaults."""
        default = Sizes.for_electrodes(n_electrode)
        return default._replace(
            steps=self.steps or default.steps,
            misfit_steps=self.misfit_steps or default.misfit_steps,
            misfit_charges=self.misfit_charges or default.misfit_charges,
        )

    @property
    def noise_model(self) -> NoiseModel:
        """Noise model that the setting `noise` contains or names.

        Raises:
            InputError: If the name is unknown, or if the noise has no part that is independent of the charge. Misfits
                are measured in standard deviations of the noise, so the noise of a zero charge must not be zero.
        """
        noise = noise_model(self.noise) if isinstance(self.noise, str) else self.noise
        if noise.gain > 0.0:
            noise.check_white()
        return noise


class FitConfig(Settings, frozen=True):
    """All settings of a training."""

    network: NetworkConfig = NetworkConfig()
    training: TrainingConfig = TrainingConfig()

    def for_electrodes(self, n_electrode: int) -> "FitConfig":
        """Return a copy of the settings, in which missing sizes are the defaults for the given number of electrodes.

        The sizes are the widths of the hidden layers, the numbers of steps, and the number of examples of misfits.
        """
        hidden, misfit_hidden = self.network.widths(n_electrode)
        network = replace(self.network, hidden=hidden, misfit_hidden=misfit_hidden)
        sizes = self.training.sizes(n_electrode)
        training = replace(
            self.training, steps=sizes.steps, misfit_steps=sizes.misfit_steps, misfit_charges=sizes.misfit_charges
        )
        return FitConfig(network, training)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as nested dictionaries that can be written to JSON."""
        return dict(plain_values(self))

    def checked(self) -> "FitConfig":
        """Check the ranges of all settings, and return a copy of the settings.

        Raises:
            ConfigError: If a setting is out of its range.
        """
        return convert(self.to_dict(), FitConfig, "", ConfigError)


def load_config(path: StrPath) -> FitConfig:
    """Read the settings of a training from a TOML file. Missing keys have their default values.

    Raises:
        ConfigError: If the file cannot be read, a key is unknown, or a value has the wrong type or range.
    """
    return read_toml(path, "a training configuration", ConfigError, FitConfig)
