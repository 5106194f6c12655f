"""`isocharge train calibrate`: from a few measured presses to a model that is right about one film."""

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.measured_presses import ForceStdOption, ModelsOption, PositionStdOption, read_presses_of
from isocharge.cli.shared.options import DeviceOption, FreshOption, JsonOption, ProbeOption
from isocharge.cli.shared.terminal import say, this_command
from isocharge.cli.train.bench.run import BenchPort, calibrate_at_port
from isocharge.common.errors import InputError

if TYPE_CHECKING:
    from isocharge.serve import MeasuredPresses
    from isocharge.train import Calibration, EarlierFilm, ProposedPress, SensorFilms


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
    port: Annotated[
        str | None,
        typer.Option(
            "--port",
            metavar="URL",
            help="Take the presses at the bench, one after the other, from this port of the sensor: device path or "
            "pyserial URL. (default: from PRESSES.csv)",
        ),
    ] = None,
    device: DeviceOption = None,
    baud: Annotated[
        int, typer.Option("--baud", min=1, help="Speed of the port, bits per second; USB ports ignore it.")
    ] = 115200,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="With --port: presses are where they are proposed; ask nothing. (default: ask)"),
    ] = False,
    script: Annotated[
        Path | None,
        typer.Option(
            "--script",
            metavar="FILE",
            help="With --port: presses that a machine makes, in their order, CSV with x_mm, y_mm, force_N; nothing is "
            "asked. (default: proposed presses)",
        ),
    ] = None,
    until: Annotated[
        float,
        typer.Option(
            "--until",
            metavar="SHARE",
            min=0.0,
            help="With --port: position error left by the film at which it is enough, a share of what noise alone "
            "leaves; 0 for never.",
        ),
    ] = 0.5,
    fresh: FreshOption = False,
    json: JsonOption = False,
) -> None:
    """Calibrate a film: find its parameters from measured presses, and write a model that is right about it.

    Three presses help much, ten are good; of each, the place, the force, or both are known. --next says where to press,
    also before the first press. What the presses cannot tell is said.

    With --port it proposes a press, takes it when it is steady, asks whether it was there, and says how well the film
    is known by now. Every press is on disk at once: the same command goes on with a session that was stopped.

    Example: isocharge train calibrate presses.csv --sensor four-25um-biaxial -o my-film
    """
    _check_usage(file, output, next_count, port, at_bench=yes or script is not None or fresh or device is not None)
    from isocharge.simulate import load_sensor, parse_probe
    from isocharge.train import films_for

    chosen = films_for(load_sensor(sensor), parse_probe(probe), models)
    calibration = None
    if port is not None and output is not None:
        bench = BenchPort(port, device, baud, yes, script, until, fresh)
        std = position_std_mm, force_std
        calibration = calibrate_at_port(bench, chosen, _before(chosen, earlier), output, std, json_lines=json)
    elif file is not None:
        names = chosen.films.prior.sensor.electrode_names
        calibration = _calibrated(read_presses_of(file, names, position_std_mm, force_std), chosen, earlier)
    if calibration is not None and output is not None:
        _write(output, calibration, chosen, ends_session=port is not None)
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


def _check_usage(file: Path | None, output: Path | None, next_count: int, port: str | None, *, at_bench: bool) -> None:
    """Refuse arguments that contradict each other, before anything is loaded."""
    if port is not None and (file is not None or next_count):
        raise InputError(
            "--port: presses come from the port and are proposed one by one; leave out PRESSES.csv, --next"
        )
    if port is not None and output is None:
        raise InputError("--port: expected --output FOLDER for the presses and the model, got none")
    if port is None and at_bench:
        raise InputError("--yes, --script, --fresh and --device belong to --port; give the port of the sensor")
    if port is None and file is None and not next_count:
        raise InputError("expected PRESSES.csv, or --next K for presses to begin with, or --port URL, got none of them")
    if port is None and file is None and output is not None:
        raise InputError("--output: nothing is calibrated without PRESSES.csv; give presses, or leave --output out")


def _before(chosen: "SensorFilms", earlier: Path | None) -> "EarlierFilm":
    """What is known of the film before the presses."""
    from isocharge.train import read_earlier

    return read_earlier(earlier, chosen.scene) if earlier else chosen.described


def _calibrated(presses: "MeasuredPresses", chosen: "SensorFilms", earlier: Path | None) -> "Calibration":
    from isocharge.train import calibrate

    return calibrate(presses, chosen.scene, _before(chosen, earlier), warn=lambda message: say(f"caution: {message}"))


def _write(output: Path, calibration: "Calibration", chosen: "SensorFilms", *, ends_session: bool) -> None:
    from isocharge.train import write_calibration
    from isocharge.train.calibration.folder import end_session

    version = write_calibration(output, calibration, chosen.films, this_command())
    if ends_session:
        end_session(output)
    say(f"{version}: sensor.toml, calibration.json, card.md, model.onnx")


def _proposed(
    chosen: "SensorFilms",
    calibration: "Calibration | None",
    count: int,
    position_std_mm: float,
    force_std: float,
    earlier: Path | None,
) -> "list[ProposedPress]":
    from isocharge.train import next_presses

    if not count:
        return []
    scene = chosen.scene
    if calibration is not None:
        parameters, covariance = calibration.posterior.parameters, calibration.posterior.covariance
    else:
        before = _before(chosen, earlier)
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
    from isocharge.common.json_values import plain_values

    table: dict[str, object] = dict(calibration.to_dict()) if calibration else {}
    values = plain_values(table | {"next": [vars(press) for press in proposed]})
    assert isinstance(values, dict)
    return values
