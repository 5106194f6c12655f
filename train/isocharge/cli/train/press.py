"""`isocharge train press`: record presses at a port, and write the file of measured presses."""

import shlex
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from pty import STDIN_FILENO
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import ProbeOption, executor_for
from isocharge.cli.shared.options import (
    BaudOption,
    DeviceOption,
    EarlierOption,
    ForceRangeOption,
    ForceStdOption,
    MapRadiusOption,
    PortOption,
    PositionStdOption,
    SensorOption,
    StressLimitOption,
)
from isocharge.cli.shared.port_hints import no_frames_hint
from isocharge.cli.shared.terminal import say
from isocharge.cli.train.press_dialogue import Dialogue, PressEvents
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS, DEFAULT_STRESS_LIMIT
from isocharge.common.errors import NoFramesError, OutputError, PressError, error_context
from isocharge.common.files import as_output_errors, check_new_output
from isocharge.serve import ReadingStream, load_device, open_source
from isocharge.serve.live.steady_press import PressWatch
from isocharge.serve.presses.measured_presses import MeasuredPresses, read_press_list, read_presses, write_presses
from isocharge.serve.signal_chain.thermal import ThermalRule
from isocharge.simulate import load_sensor, parse_probe
from isocharge.train import CalibrationProblem, read_earlier
from isocharge.train.calibration.session import PressSession


def press_command(
    port: PortOption,
    sensor: SensorOption,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="PRESSES.csv",
            help="File to write. If it already exists, the session continues with its presses.",
        ),
    ],
    probe: ProbeOption = "circle:1.0",
    radius: MapRadiusOption = DEFAULT_RADIUS,
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    device: DeviceOption = None,
    baud: BaudOption = 115200,
    press_list: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Presses that a machine makes, in their order: CSV with x_mm, y_mm, force_N. Nothing is asked. "
            "(default: proposed presses)",
        ),
    ] = None,
    until: Annotated[
        float,
        typer.Option(
            metavar="SHARE",
            min=0.0,
            help="Position error left by the film at which the session ends, as a share of the error by noise alone; "
            "0 for never.",
        ),
    ] = 0.5,
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    earlier: EarlierOption = None,
) -> None:
    """Record presses on a film at a port, and write them to a file of measured presses.

    The command proposes a press, records the press when the charges are steady, and asks whether it was made at the
    proposed place. After each press, the command reports how accurately the film is known. The session ends when the
    film is known accurately enough, or when you type q.

    The file is complete after each press. If the session is interrupted, the same command continues it.

    Check the wiring first: `isocharge serve doctor --check-electrodes` asks for a press near each electrode in turn,
    and finds electrodes that are swapped.

    Example: isocharge train press --port /dev/ttyACM0 --sensor four-25um-biaxial -o presses.csv
    """
    problem = CalibrationProblem(load_sensor(sensor), parse_probe(probe), radius, force, stress_limit=stress_limit)

    # A machine makes the presses of a list. Without a list, a person makes the presses, and is asked about each press.
    contacts = None if press_list is None else read_press_list(press_list)
    keyboard = STDIN_FILENO if contacts is None else None
    board = load_device(device)
    if board.rule(ThermalRule) is not None:
        say(f"{device}: [common_mode] is not used for these presses, because it needs a model of the film")

    stds = {"position_std_mm": position_std_mm, "force_std": force_std}
    presses = _read_earlier_session(output, problem.electrodes, stds)
    if earlier:
        problem = replace(problem, earlier=read_earlier(earlier, problem, presses))
    with executor_for() as executor:
        # Begin or continue the session, and check the list of the machine.
        say("solving the film of the sensor file")
        session = PressSession(
            problem, save=partial(_save, output), presses=presses, until=until, executor=executor, **stds
        )
        for number, contact in enumerate([] if contacts is None else contacts, 1):
            with error_context(PressError, f"{press_list}, press {number}: "):
                session.check(contact)

        # Record the presses.
        piezo = problem.sensor.piezo
        stream = ReadingStream(
            problem.electrodes,
            board,
            reader=f"sensor {problem.sensor.name}",
            # If all charges were expected to be positive, the release of a negative press would be taken for a press.
            has_any_sign=min(piezo.d31, piezo.d32) <= 0.0,
        )
        try:
            with (
                # First, because it changes the errors of the next two.
                error_context(NoFramesError, after=f"; {no_frames_hint(port, device)}"),
                # A machine goes on while the port is lost, so its session must end.
                open_source(port, baud=baud, reconnect=contacts is None, request=board.request) as source,
                closing(PressEvents(source, stream, PressWatch(problem.electrodes), keyboard)) as events,
            ):
                dialogue = Dialogue(session, events)
                if contacts is None:
                    dialogue.guide_person()
                else:
                    dialogue.follow_machine(contacts)
        finally:
            if len(session):
                say(f"presses in {output}: {len(session)}; the same command continues the session")

    if not len(session):
        raise PressError(f"no press was taken, so {output} is not written")
    if session.refusal:  # the reason why the presses cannot be used for a calibration
        raise PressError(f"{output}: {session.refusal}")

    # State the command that calibrates with the presses.
    options = ["--sensor", sensor, "--probe", probe, "--radius", f"{radius:g}"]
    if force != DEFAULT_FORCE_RANGE:
        options += ["--force", *map(str, force)]
    if earlier:
        options += ["--from", str(earlier)]
    if stress_limit != DEFAULT_STRESS_LIMIT:
        options += ["--stress-limit", f"{stress_limit:g}"]
    say(f"To make a model: isocharge train calibrate {shlex.join([str(output), *options])} -o my-film")


def _read_earlier_session(path: Path, electrodes: tuple[str, ...], stds: dict[str, float]) -> MeasuredPresses | None:
    """Read the file of an earlier session, or check that a new file can be written.

    Args:
        path: The file.
        electrodes: Names of the electrodes.
        stds: Standard deviations of positions and forces that the file does not state, by the names of the options.

    Returns:
        The presses of the earlier session; None if there is no file.

    Raises:
        PressError: If the file is not the file of a session.
        OutputError: If a file cannot be written.
    """
    if path.is_file():
        presses = read_presses(path, electrodes, **stds)
        if presses.ignored:  # names of columns that were not read
            raise PressError(
                f"{path}: expected a file of `isocharge train press`, got further columns: "
                f"{', '.join(presses.ignored)}; they would be lost, so choose another output"
            )
        say(f"{path} has {len(presses)} presses; the session continues with them. Delete the file to begin again")
        return presses
    if path.exists() or not path.parent.is_dir():
        raise OutputError(f"{path}: expected a file in an existing folder; choose another output")
    check_new_output(path)
    return None


def _save(path: Path, presses: MeasuredPresses) -> None:
    """Replace the file of a session. If there are no presses, delete the file."""
    if len(presses):
        write_presses(path, presses)
        return
    with as_output_errors(path):
        path.unlink(missing_ok=True)
