"""`isocharge train calibrate`: from a few measured presses to a model that is right about one film."""

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.options import JsonOption, ProbeOption
from isocharge.cli.shared.terminal import say, this_command
from isocharge.cli.train.measured_presses import ForceStdOption, ModelsOption, PositionStdOption, read_presses_of
from isocharge.errors import InputError

if TYPE_CHECKING:
    from isocharge.serve import MeasuredPresses
    from isocharge.train import Calibration, ProposedPress, SensorFilms


def calibrate_command(
    sensor: Annotated[
        str,
        typer.Option("--sensor", metavar="SENSOR", help="Name of a built-in sensor, or a TOML file that describes it."),
    ],
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="PRESSES.csv",
            help="Measured presses: x_mm, y_mm, force_N and the electrodes' names (pC) in the header; an empty cell is "
            "unknown. (default: none, with --next)",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Folder for sensor.toml, calibration.json, card.md and the model; each calibration in it is a new "
            "version. (default: print only)",
        ),
    ] = None,
    probe: ProbeOption = "circle:1.0",
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    next_count: Annotated[
        int,
        typer.Option("--next", metavar="K", min=0, max=100, help="Propose this many presses that would tell most."),
    ] = 0,
    earlier: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FOLDER",
            help="Start from the calibration in this folder, allowing for drift since then. (default: the sensor file)",
        ),
    ] = None,
    models: ModelsOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate a film: find its parameters from measured presses, and write a model that is right about it.

    Three presses help much, ten are good; of each, the place, the force, or both are known. --next says where to press,
    also before the first press. What the presses cannot tell is said.

    Example: isocharge train calibrate presses.csv --sensor four-25um-biaxial -o my-film
    """
    if file is None and not next_count:
        raise InputError("expected PRESSES.csv, or --next K for presses to begin with, got neither")
    if file is None and output is not None:
        raise InputError("--output: nothing is calibrated without PRESSES.csv; give presses, or leave --output out")
    from isocharge.simulate import load_sensor, parse_probe
    from isocharge.train import films_for

    chosen = films_for(load_sensor(sensor), parse_probe(probe), models)
    calibration = None
    if file is not None:
        names = chosen.films.prior.sensor.electrode_names
        presses = read_presses_of(file, names, position_std_mm, force_std)
        calibration = _calibrated(presses, chosen, earlier)
        if output is not None:
            _write(output, calibration, chosen)
    proposed = _proposed(chosen, calibration, next_count, position_std_mm, force_std, earlier)
    if json:
        typer.echo(json_module.dumps(_table(calibration, proposed), allow_nan=False))
        return
    for sentence in calibration.words if calibration else ():
        typer.echo(sentence)
    for press in proposed:
        typer.echo(
            f"press {press.force_N:.2f} N at ({press.x_mm:.1f}, {press.y_mm:.1f}) mm: "
            f"leaves {press.position_mm:.3f} mm, {press.force_percent:.2f} %"
        )


def _calibrated(presses: "MeasuredPresses", chosen: "SensorFilms", earlier: Path | None) -> "Calibration":
    from isocharge.train import calibrate, read_earlier

    before = read_earlier(earlier, chosen.scene) if earlier else chosen.described
    return calibrate(presses, chosen.scene, before, warn=lambda message: say(f"caution: {message}"))


def _write(output: Path, calibration: "Calibration", chosen: "SensorFilms") -> None:
    from isocharge.train import write_calibration

    version = write_calibration(output, calibration, chosen.films, this_command())
    say(f"{version}: sensor.toml, calibration.json, card.md, model.onnx")


def _proposed(
    chosen: "SensorFilms",
    calibration: "Calibration | None",
    count: int,
    position_std_mm: float,
    force_std: float,
    earlier: Path | None,
) -> "list[ProposedPress]":
    from isocharge.train import next_presses, read_earlier

    if not count:
        return []
    scene = chosen.scene
    if calibration is not None:
        parameters, covariance = calibration.posterior.parameters, calibration.posterior.covariance
    else:
        before = read_earlier(earlier, scene) if earlier else chosen.described
        parameters, covariance = before.parameters, before.covariance
    return next_presses(
        scene.charges,
        scene.domain,
        scene.noise,
        count,
        parameters,
        covariance,
        position_std_mm=position_std_mm,
        force_std=force_std,
    )


def _table(calibration: "Calibration | None", proposed: "list[ProposedPress]") -> dict[str, object]:
    from isocharge.json_values import plain_values

    table: dict[str, object] = dict(calibration.to_dict()) if calibration else {}
    values = plain_values(table | {"next": [vars(press) for press in proposed]})
    assert isinstance(values, dict)
    return values
