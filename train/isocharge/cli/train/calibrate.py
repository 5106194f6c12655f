"""`isocharge train calibrate`: from a few measured presses to a model that is right about one film."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from isocharge.cli.shared.measured_presses import ForceStdOption, PositionStdOption, read_presses_of
from isocharge.cli.shared.options import (
    DeviceOption,
    FreshOption,
    JsonOption,
    ModelsOption,
    StressLimitOption,
    refuse,
)
from isocharge.cli.shared.probe_option import ProbeOption
from isocharge.cli.shared.terminal import say, show, show_json, this_command
from isocharge.cli.train.press_session import PressPort, calibrate_at_port
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.serve.prediction.measured_presses import COLDEST_C, WARMEST_C
from isocharge.simulate import load_sensor, parse_probe
from isocharge.train import CalibrationProblem, ProposedPress, calibrate, next_presses
from isocharge.train.calibration.folder import (
    SESSION,
    calibration_folder,
    read_earlier,
    read_moved,
    result_table,
    write_calibration,
)


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
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    earlier: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FOLDER",
            help="Start from the calibration in this folder, allowing for drift since then. (default: the sensor file)",
        ),
    ] = None,
    temperature_C: Annotated[
        float | None,
        typer.Option(
            "--temperature",
            metavar="C",
            help="How warm the film's ring is, degrees Celsius: at presses without a column temperature_C; without "
            "presses the film of --from is written as it is at this temperature. (default: not known)",
        ),
    ] = None,
    models: ModelsOption = None,
    port: Annotated[
        str | None,
        typer.Option(
            "--port",
            metavar="URL",
            help="Take the presses one after the other from this port of the sensor: device path or "
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
    press_list: Annotated[
        Path | None,
        typer.Option(
            "--press-list",
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

    Three presses help much, eight are good; of each, the place, the force, or both are known. --next says where to
    press, also before the first press. What the presses cannot tell is said.

    With --port it proposes a press, takes it when it is steady, asks whether it was there, and says how well the film
    is known by now. Every press is on disk at once: the same command goes on with a session that was stopped.

    Check the wiring first: `isocharge serve doctor --check-electrodes` asks for a press near each electrode in turn,
    and finds electrodes that are swapped.

    Example: isocharge train calibrate presses.csv --sensor four-25um-biaxial -o my-film
    """
    moved_to_C = temperature_C if earlier is not None and file is None else None
    of_port = yes or press_list is not None or fresh or device is not None
    _check_usage(file, output, next_count, port, temperature_C, of_port=of_port, moved=moved_to_C is not None)
    problem = replace(CalibrationProblem.of(load_sensor(sensor), parse_probe(probe), models), stress_limit=stress_limit)
    result, presses = None, None
    with calibration_folder(output, problem) if output is not None else nullcontext():
        if file is not None:
            presses = read_presses_of(file, problem.electrodes, position_std_mm, force_std)
            if not presses.knows_temperature and temperature_C is not None:
                presses = replace(presses, temperature_C=np.full(len(presses), temperature_C))
        if earlier is not None and moved_to_C is not None:
            result = read_moved(earlier, problem, moved_to_C)
        elif earlier is not None:
            knows_temperature = presses is not None and presses.knows_temperature
            problem = replace(problem, earlier=read_earlier(earlier, problem, knows_temperature=knows_temperature))
        if port is not None and output is not None:
            where = PressPort(port, device, baud, yes, press_list, until, fresh, position_std_mm, force_std)
            result = calibrate_at_port(where, problem, output, json_lines=json)
        elif presses is not None:
            say(f"fitting the film to {len(presses)} presses")
            result = calibrate(presses, problem)
        for caution in result.cautions if result else ():
            say(f"caution: {caution}")
        if result is not None and output is not None:
            say("folding and measuring the model of this film")
            version = write_calibration(result, output, this_command())
            (output / SESSION).unlink(missing_ok=True)
            say(f"{version}: sensor.toml, calibration.json, card.md, model.onnx")
    known = result.posterior if result else None
    proposed: list[ProposedPress] = []
    if next_count:
        proposed = next_presses(problem, next_count, known, position_std_mm=position_std_mm, force_std=force_std)
    if json:
        table = result_table(result) if result else {}
        show_json(table | {"next": [vars(press) for press in proposed]})
        return
    for sentence in result.summary if result else ():
        show(sentence)
    for press in proposed:
        show(
            f"press {press.force_N:.2f} N at ({press.x_mm:.1f}, {press.y_mm:.1f}) mm: "
            f"leaves {press.position_mm:.3f} mm, {press.force_percent:.2f} %"
        )


def _check_usage(
    file: Path | None,
    output: Path | None,
    next_count: int,
    port: str | None,
    temperature_C: float | None,
    *,
    of_port: bool,
    moved: bool,
) -> None:
    """Refuse arguments that contradict each other."""
    nothing = port is None and file is None and not moved
    refuse(
        {
            f"--temperature: expected {COLDEST_C:g} to {WARMEST_C:g} degrees Celsius, got {temperature_C}": (
                temperature_C is not None and not COLDEST_C <= temperature_C <= WARMEST_C
            ),
            "--temperature: presses from --port are taken without it; leave one of them out": (
                port and temperature_C is not None
            ),
            "--port: presses come from the port and are proposed one by one; leave out PRESSES.csv, --next": (
                port and (file or next_count)
            ),
            "--port: expected --output FOLDER for the presses and the model, got none": port and output is None,
            "--yes, --press-list, --fresh and --device belong to --port; give the port of the sensor": (
                port is None and of_port
            ),
            "--temperature: expected PRESSES.csv that were made at it, or --from FOLDER for it, got neither": (
                nothing and temperature_C is not None
            ),
            "expected PRESSES.csv, or --next K for presses to begin with, or --port URL, or --from FOLDER with "
            "--temperature C, got none of them": nothing and not next_count,
            "--output: nothing is calibrated without PRESSES.csv; give presses, or leave --output out": (
                nothing and output
            ),
        }
    )
