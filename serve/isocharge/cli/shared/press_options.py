"""Options of commands for files of measured presses, and the function that reads such a file."""

from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.terminal import say
from isocharge.serve.presses.measured_presses import MeasuredPresses, read_presses
from isocharge.serve.presses.number_table import ignored_columns_message

SensorOption = Annotated[
    str,
    typer.Option("--sensor", metavar="SENSOR", help="Name of a built-in sensor, or a TOML file that describes it."),
]

RadiusOption = Annotated[
    float,
    typer.Option("--radius", metavar="MM", help="Radius of the working area, mm: the largest distance of a press."),
]

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


def read_press_file(
    file: Path, electrodes: tuple[str, ...] | None, position_std_mm: float = 0.1, force_std: float = 0.01
) -> MeasuredPresses:
    """Read a file of measured presses, and print which of its columns are ignored.

    Args:
        file: CSV or Parquet file.
        electrodes: Names of the electrodes; None if all columns without another meaning are electrodes.
        position_std_mm: Standard deviation of x and y for presses without one in the file, mm.
        force_std: Standard deviation of the force for presses without one in the file, relative to the force.
    """
    presses = read_presses(file, electrodes, position_std_mm=position_std_mm, force_std=force_std)
    if presses.ignored:
        say(ignored_columns_message(str(file), presses.ignored))
    return presses
