"""CSV files of measured presses in commands: options and reading."""

from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.terminal import say
from isocharge.serve.prediction.measured_presses import MeasuredPresses, read_presses
from isocharge.serve.prediction.tables.number_table import ignored_words

PositionStdOption = Annotated[
    float,
    typer.Option(
        "--position-std", metavar="MM", help="Standard deviation of known x and y, mm, where the file has none."
    ),
]

ForceStdOption = Annotated[
    float,
    typer.Option(
        "--force-std",
        metavar="SHARE",
        help="Standard deviation of known forces, a share of the force in N, where the file has none.",
    ),
]


def read_presses_of(
    file: Path, electrodes: tuple[str, ...] | None, position_std_mm: float = 0.1, force_std: float = 0.01
) -> MeasuredPresses:
    """The presses of a file, of all columns without another meaning if `electrodes` are None; others are named."""
    presses = read_presses(file, electrodes, position_std_mm=position_std_mm, force_std=force_std)
    if presses.ignored:
        say(ignored_words(str(file), presses.ignored))
    return presses
