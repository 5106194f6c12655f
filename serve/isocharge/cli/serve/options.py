"""Options that the live commands share."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from isocharge.serve import Device

ModelsOption = Annotated[
    Path | None,
    typer.Option(
        "--models", metavar="DIR", help="Folder of models in which a name is looked up first. (default: none)"
    ),
]

DeviceOption = Annotated[
    Path | None,
    typer.Option("--device", metavar="FILE", help="What is known about the board, TOML. (default: nothing)"),
]


class Output(StrEnum):
    """What goes to stdout."""

    json = "json"
    csv = "csv"
    none = "none"


class PolicyName(StrEnum):
    """Which frames get a record."""

    every = "every"
    latest = "latest"


OutputOption = Annotated[
    Output, typer.Option("--output", help="On stdout: lines of JSON, CSV with a header, or nothing.")
]


def board_of(path: Path | None) -> "Device":
    from isocharge.serve import load_device
    from isocharge.serve.live.device import ANY_BOARD

    return load_device(path) if path else ANY_BOARD
