"""Training configuration: a TOML file with two tables, or the defaults below."""

from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, json

from isocharge.common.activations import ACTIVATIONS, TANH
from isocharge.common.errors import ConfigError
from isocharge.common.structs import Settings, WrongKey, convert, read_toml
from isocharge.simulate import NoiseModel, noise_model

Width = Annotated[int, Meta(ge=1, le=4096)]
Widths = Annotated[tuple[Width, ...], Meta(min_length=1, description="widths from 1 to 4096")]
Count = Annotated[int, Meta(ge=1, le=10_000_000)]

MOST_ELECTRODES = 64
"""Largest number of electrodes that a configuration may ask for."""


class NetworkConfig(Settings, frozen=True):
    """Sizes of the two perceptrons.

    Attributes:
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the one that gives the misfit; as many layers.
        electrodes: How many electrodes the dataset has to have; 0 takes what it has.
        activation: Name of the activation of the hidden layers (`isocharge.common.activations`).
        weights: "int8" rounds the weights between hidden layers to 8 bits and trains the others on; in C they then
            take a quarter of the memory.
    """

    hidden: Widths = (96, 96, 96)
    misfit_hidden: Widths = (64, 64, 64)
    electrodes: int = 0
    activation: str = TANH.name
    weights: Literal["float32", "int8"] = "float32"

    def __post_init__(self) -> None:
        if len(self.hidden) != len(self.misfit_hidden):
            layers = f"as many layers as network.hidden ({len(self.hidden)}; they run side by side)"
            raise WrongKey("misfit_hidden", layers, list(self.misfit_hidden))
        if self.activation not in ACTIVATIONS:
            raise WrongKey("activation", f"one of {', '.join(ACTIVATIONS)}", self.activation)
        if not (self.electrodes == 0 or 3 <= self.electrodes <= MOST_ELECTRODES):
            raise WrongKey("electrodes", f"0 (as the dataset) or 3 to {MOST_ELECTRODES}", self.electrodes)


class TrainingConfig(Settings, frozen=True):
    """How to train.

    Attributes:
        steps: Optimiser steps of the contact network.
        misfit_steps: Optimiser steps of the misfit network.
        misfit_charges: Charges that it learns from.
        batch: Samples per step.
        learning_rate: Largest rate of the schedule (Adam's; Muon's is a multiple).
        patience: Steps without a better network after which a stage ends early with the best one.
        hold_out: Share of the positions held out for measuring errors; half as many are watched while it trains. Of
            measured presses a fifth is held out always, the same for every command.
        noise: Added afresh in every step: a `NoiseModel`, or what `noise_model` takes.
        seed: Of weights, batches, noise and split.
        threads: CPU threads; one is nearly as fast as two at this size and does not suffer when the cores are busy.
    """

    steps: Count = 8_000
    misfit_steps: Count = 6_000
    misfit_charges: Annotated[int, Meta(ge=1_000, le=10_000_000)] = 80_000
    batch: Annotated[int, Meta(ge=1, le=1_000_000)] = 1024
    learning_rate: Annotated[float, Meta(gt=0.0, lt=1.0, description="a number between 0 and 1")] = 5e-3
    patience: Count = 3_000
    hold_out: Annotated[float, Meta(gt=0.0, lt=0.6, description="a number between 0 and 0.6")] = 0.1
    noise: Annotated[str | NoiseModel, Meta(description="a text")] = "reference"
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    threads: Annotated[int, Meta(ge=1, le=64)] = 1

    @property
    def noise_model(self) -> NoiseModel:
        """The noise itself.

        Raises:
            InputError: If the level is unknown.
        """
        return noise_model(self.noise) if isinstance(self.noise, str) else self.noise


class FitConfig(Settings, frozen=True):
    """Everything that fixes a fit, given what it is fitted to."""

    network: NetworkConfig = NetworkConfig()
    training: TrainingConfig = TrainingConfig()

    def to_dict(self) -> dict[str, Any]:
        """As the tables of the file, ready for JSON."""
        return json.decode(json.encode(self), type=dict[str, Any])

    def checked(self) -> "FitConfig":
        """The same, once every value is found to be in its range, as it is when a file is read.

        Raises:
            ConfigError: If one is not.
        """
        return convert(self.to_dict(), FitConfig, "", ConfigError)


def load_config(path: Path) -> FitConfig:
    """Read a configuration; keys that are not given keep their defaults.

    Raises:
        ConfigError: If the file cannot be read, a key is unknown, or a value has the wrong type or range.
    """
    return read_toml(path, "a training configuration", ConfigError, FitConfig)
