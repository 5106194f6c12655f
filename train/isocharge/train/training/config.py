"""Training configuration: a TOML file with two tables, or the defaults below."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from isocharge.common.errors import ConfigError
from isocharge.common.tables import Table, is_whole, read_toml

T = TypeVar("T", "NetworkConfig", "TrainingConfig")

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

WEIGHTS = ("float32", "int8")
"""Forms of the weights between hidden layers."""

WIDEST = 4096
"""Largest width of a layer."""

MOST_ELECTRODES = 64
"""Largest number of electrodes that a configuration may ask for."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the two perceptrons.

    Attributes:
        hidden: Widths of the hidden layers of the contact network.
        misfit_hidden: Widths of the one that gives the misfit; as many layers.
        electrodes: How many electrodes the dataset has to have; 0 takes what it has.
        weights: "int8" rounds the weights between hidden layers to 8 bits and trains the others on; in C they then
            take a quarter of the memory.
    """

    hidden: tuple[int, ...] = (96, 96, 96)
    misfit_hidden: tuple[int, ...] = (64, 64, 64)
    electrodes: int = 0
    weights: str = "float32"

    def __post_init__(self) -> None:
        _check_network(Table(vars(self), "", ConfigError, "network"))


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
        patience: Steps without a better network after which a stage ends early with the best one.
        hold_out: Share of the positions held out for measuring errors; half as many are watched while it trains. Of
            measured presses a fifth is held out always, the same for every command.
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
        _check_training(Table(vars(self), "", ConfigError, "training"))


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
    tables = Table(read_toml(path, "a training configuration", ConfigError), str(path), ConfigError)
    tables.only("network", "training")
    network, training = tables.table("network", {}), tables.table("training", {})
    return FitConfig(
        _read(network, NetworkConfig(), _check_network), _read(training, TrainingConfig(), _check_training)
    )


def _read(table: Table, defaults: T, check: Callable[[Table], None]) -> T:
    """The table's values in place of the defaults, checked."""
    table.only(*(entry.name for entry in fields(defaults)))
    check(Table({**vars(defaults), **table.values}, table.where, ConfigError, table.path))
    lists = {key: tuple(value) for key, value in table.values.items() if isinstance(value, list)}
    values: dict[str, Any] = {**table.values, **lists}
    return replace(defaults, **values)


def _check_network(table: Table) -> None:
    hidden, misfit_hidden = (table.sequence(key, of="widths") for key in ("hidden", "misfit_hidden"))
    for key, widths in (("hidden", hidden), ("misfit_hidden", misfit_hidden)):
        if not widths or not all(is_whole(width) and 1 <= width <= WIDEST for width in widths):
            table.refuse(key, f"widths from 1 to {WIDEST}")
    if len(hidden) != len(misfit_hidden):
        table.refuse(
            "misfit_hidden", f"as many layers as network.hidden ({len(hidden)}; they run side by side)", misfit_hidden
        )
    electrodes = table.get("electrodes")
    if not is_whole(electrodes) or not (electrodes == 0 or 3 <= electrodes <= MOST_ELECTRODES):
        table.refuse("electrodes", f"0 (as the dataset) or 3 to {MOST_ELECTRODES}")
    if table.text("weights") not in WEIGHTS:
        table.refuse("weights", f"one of {', '.join(WEIGHTS)}")


def _check_training(table: Table) -> None:
    for key, (least, most) in LIMITS.items():
        table.whole(key, least=least, most=most)
    for key, below in (("learning_rate", 1.0), ("hold_out", 0.6)):
        if not 0.0 < table.number(key) < below:
            table.refuse(key, f"a number between 0 and {below:g}")
    noise = table.text("noise")
    if table.get("finish_steps") and noise != "clean":
        table.refuse(
            "finish_steps",
            f'0 with the noise {noise!r}, which it would learn by heart (training.noise = "clean" allows it)',
        )
