"""CSV files of measured presses in commands: options, reading, and the network for all films of their sensor."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.terminal import say

if TYPE_CHECKING:
    from isocharge.serve import MeasuredPresses
    from isocharge.train import SensorFilms

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

ModelsOption = Annotated[
    Path | None,
    typer.Option("--models", metavar="DIR", help="Folder of models to search first. (default: the usual folders)"),
]


def read_presses_of(
    file: Path, electrodes: tuple[str, ...], position_std_mm: float = 0.1, force_std: float = 0.01
) -> "MeasuredPresses":
    """The presses of a file; columns that nobody reads are named."""
    from isocharge.serve import read_presses
    from isocharge.serve.prediction.csv_numbers import ignored_words

    presses = read_presses(file, electrodes, position_std_mm=position_std_mm, force_std=force_std)
    if presses.ignored:
        say(ignored_words(str(file), presses.ignored))
    return presses


def films_or_none(sensor: str, probe: str, models: Path | None) -> "SensorFilms | None":
    """The network for all films of a sensor; None, and said, if there is none."""
    from isocharge.common.errors import ModelError, SceneError
    from isocharge.simulate import load_sensor, parse_probe
    from isocharge.train import films_for

    try:
        return films_for(load_sensor(sensor), parse_probe(probe), models)
    except (ModelError, SceneError) as error:
        say(f"caution: the film is not calibrated, the presses correct the sensor as described: {error}")
        return None
