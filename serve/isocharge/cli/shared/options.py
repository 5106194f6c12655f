"""Arguments and options that several commands share, and functions that convert their values."""

from pathlib import Path
from typing import Annotated

import typer

from isocharge.common.errors import InputError

SensorArgument = Annotated[
    str, typer.Argument(metavar="SENSOR", help="Name of a built-in sensor, or a TOML file that describes one.")
]

ModelArgument = Annotated[str, typer.Argument(metavar="MODEL", help="Name of a model, or path of a model folder.")]

RecordingArgument = Annotated[
    Path, typer.Argument(metavar="FILE", help="Recording of `isocharge serve stream --record`.")
]

ForceOption = Annotated[float, typer.Option(metavar="N", help="Force of the press, N; positive pushes.")]

ForceRangeOption = Annotated[
    tuple[float, float], typer.Option(metavar="MIN MAX", help="Smallest and largest force, N.")
]

RadiusOption = Annotated[
    str,
    typer.Option(
        metavar="MM|auto",
        help="Largest distance of a press from the film's centre, mm; auto finds the working area, where the charges "
        "determine the position to 1 mm.",
    ),
]

StressLimitOption = Annotated[
    float,
    typer.Option(metavar="MPA", min=0.0, help="Largest stress of the film under the probe, MPa."),
]

WorkersOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=64,
        help="Number of processes, on which the results do not depend. (default: one per core)",
    ),
]

NoiseOption = Annotated[
    str,
    typer.Option(
        metavar="LEVEL|FILE.toml",
        help="Noise of the readings: reference (1 pC and 0.2 %, assumed), measured (1 pC and 1.5 %), bench, surgery, "
        "or a TOML file with white_pC and proportional. Only the white and the proportional noise count.",
    ),
]

NewFolderOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to make for the results; it must not exist yet.")
]

ModelsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder in which a model's name is looked up before the usual places. (default: none)",
    ),
]

DeviceOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Description of the board that sends the charges, TOML. (default: none)"),
]

PortOption = Annotated[
    str,
    typer.Option(
        metavar="URL",
        help="Port of the sensor: device path, tcp:// or udp://HOST:PORT; or a file of bytes; - reads stdin.",
    ),
]

SecondsOption = Annotated[
    float | None, typer.Option(min=1e-3, max=1e6, help="Time after which to stop, s. (default: at Ctrl-C)")
]

BaudOption = Annotated[int, typer.Option(min=1, help="Speed of the port, bits per second; USB ports ignore it.")]

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text. (default: text)")]

WaitOption = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=3600.0,
        help="Time to wait until the port can be opened, and until the first byte if this is more than 10 s, s.",
    ),
]

SensorOption = Annotated[
    str,
    typer.Option(metavar="SENSOR", help="Name of a built-in sensor, or a TOML file that describes it."),
]

MapRadiusOption = Annotated[
    float,
    typer.Option(metavar="MM", help="Radius of the working area, mm: the largest distance of a press."),
]

PositionStdOption = Annotated[
    float,
    typer.Option(
        "--position-std",
        metavar="MM",
        min=1e-6,
        help="Standard deviation of known x and y, mm, of presses for which the file states no position_std_mm.",
    ),
]

ForceStdOption = Annotated[
    float,
    typer.Option(
        metavar="SHARE",
        min=1e-6,
        max=1.0,
        help="Standard deviation of known forces, a share of the force, of presses for which the file states no "
        "force_std.",
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


def parse_pair(text: str, expected: str) -> tuple[float, float]:
    """Parse two numbers that are separated by a comma.

    Args:
        text: The two numbers, such as "3,-2".
        expected: Beginning of the error message, which describes the expected text.

    Raises:
        InputError: If the text is not two numbers separated by a comma.
    """
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{expected}, got {text!r}") from error
    return first, second
