"""Options of commands for files of measured presses."""

from pathlib import Path
from typing import Annotated

import typer

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

EarlierOption = Annotated[
    Path | None,
    typer.Option(
        "--from",
        metavar="FOLDER",
        help="Start from the film of the calibration in this folder, which may have drifted since. (default: the film "
        "of the sensor file)",
    ),
]
