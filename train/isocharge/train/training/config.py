"""Training configuration: a TOML file with two tables, or the defaults below."""

import tomllib
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from isocharge.errors import ConfigError

LIMITS = {
    "steps": (1, 10_000_000),
    "finish_steps": (0, 100_000),
    "misfit_steps": (1, 10_000_000),
    "misfit_charges": (1_000, 10_000_000),
    "batch": (1, 1_000_000),
    "patience": (1, 10_000_000),
    "seed": (0, 2**31 - 1),
    "threads": (1, 64),
}
"""Smallest and largest value of the whole numbers under [training]."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the two perceptrons.

    Attributes:
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the one that gives the misfit; as many layers.
        electrodes: How many electrodes the dataset has to have; 0 takes what it has.
    """

    hidden: tuple[int, ...] = (96, 96, 96)
    misfit_hidden: tuple[int, ...] = (64, 64, 64)
    electrodes: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "misfit_hidden"):
            widths = getattr(self, name)
            if not widths or not all(type(width) is int and 1 <= width <= 4096 for width in widths):
                raise ConfigError(f"network.{name}: expected widths from 1 to 4096, got {widths}")
        if len(self.hidden) != len(self.misfit_hidden):
            raise ConfigError(
                f"network.misfit_hidden: expected as many layers as network.hidden ({len(self.hidden)}; they run side "
                f"by side), got {self.misfit_hidden}"
            )
        if type(self.electrodes) is not int or not (self.electrodes == 0 or 3 <= self.electrodes <= 64):
            raise ConfigError(f"network.electrodes: expected 0 (as the dataset) or 3 to 64, got {self.electrodes!r}")


@dataclass(frozen=True)
class TrainingConfig:
    """How to train.

    Attributes:
        steps: Optimiser steps of the contact network.
        finish_steps: Levenberg-Marquardt steps after them; only without noise, and for some 1,500 weights at most.
        misfit_steps: Optimiser steps of the misfit network.
        misfit_charges: Charges that it learns from.
        batch: Samples per step.
        learning_rate: Largest rate of the schedule (Adam's; Muon's is a multiple).
        patience: Steps without a better network after which a stage ends early; the best one is kept.
        hold_out: Share of the positions kept for measuring errors; half as many are watched while it trains.
        noise: Level of the noise model that is added afresh in every step.
        seed: Of weights, batches, noise and split.
        threads: CPU threads; one is nearly as fast as two at this size and does not suffer when the cores are busy.
    """

    steps: int = 8_000
    finish_steps: int = 0
    misfit_steps: int = 6_000
    misfit_charges: int = 80_000
    batch: int = 1024
    learning_rate: float = 5e-3
    patience: int = 3_000
    hold_out: float = 0.1
    noise: str = "reference"
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
                raise ConfigError(f"training.{name}: expected a whole number from {low} to {high}, got {value!r}")
        if not 0.0 < self.learning_rate < 1.0:
            raise ConfigError(f"training.learning_rate: expected a number between 0 and 1, got {self.learning_rate!r}")
        if not 0.0 < self.hold_out < 0.6:
            raise ConfigError(f"training.hold_out: expected a share between 0 and 0.6, got {self.hold_out!r}")
        if self.finish_steps and self.noise != "clean":
            raise ConfigError(
                f"training.finish_steps: expected 0 with the noise {self.noise!r} (it would learn the noise by heart), "
                f'got {self.finish_steps}; training.noise = "clean" allows it'
            )


@dataclass(frozen=True)
class FitConfig:
    """Everything that fixes a training run, given a dataset."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)

    def to_dict(self) -> dict[str, Any]:
        """As the tables of the file, ready for JSON."""
        table = asdict(self)
        table["network"] |= {name: list(table["network"][name]) for name in ("hidden", "misfit_hidden")}
        return table


def load_config(path: Path) -> FitConfig:
    """Read a configuration; keys that are not given keep their defaults.

    Raises:
        ConfigError: If the file cannot be read, a key is unknown, or a value has the wrong type or range.
    """
    try:
        tables = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from error
    try:
        _check_keys(tables, {"network": NetworkConfig, "training": TrainingConfig}, "")
        network = _table(NetworkConfig, tables.get("network", {}), "network.")
        training = _table(TrainingConfig, tables.get("training", {}), "training.")
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return FitConfig(network, training)


def _check_keys(table: dict[str, Any], known: Any, prefix: str) -> None:
    for key in table:
        if key not in known:
            raise ConfigError(f"unknown key {prefix + key!r}; known are {', '.join(known)}")


def _table(kind: Any, table: Any, prefix: str) -> Any:
    if not isinstance(table, dict):
        raise ConfigError(f"{prefix.rstrip('.')}: expected a table, got {table!r}")
    defaults = {entry.name: entry for entry in fields(kind)}
    _check_keys(table, defaults, prefix)
    values = {key: _typed(value, getattr(kind(), key), prefix + key) for key, value in table.items()}
    return kind(**values)


def _typed(value: Any, default: Any, where: str) -> Any:
    """The value as the default's type."""
    if isinstance(default, tuple) and isinstance(value, list):
        return tuple(value)
    if isinstance(default, float) and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        raise ConfigError(f"{where}: expected {type(default).__name__}, got {value!r}")
    return value
