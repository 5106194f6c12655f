"""A session of presses from its port to its calibration: everything taken is on disk at once."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from msgspec.structs import replace

from isocharge.cli.shared.port_hints import doctor_is_named
from isocharge.cli.shared.terminal import say, show_json
from isocharge.cli.train.press_dialogue import Dialogue, PressEvents, Screen
from isocharge.common.errors import InputError, PressError, told_where
from isocharge.serve import ReadingStream, load_device, open_source
from isocharge.serve.live.steady_press import PressWatch, SteadyPress
from isocharge.serve.prediction.measured_presses import read_press_list
from isocharge.train import CalibrationProblem, CalibrationResult
from isocharge.train.calibration.folder import SESSION, error_table, save_session, session_presses
from isocharge.train.calibration.session import FEWEST_TO_SAY, PressSession


@dataclass(frozen=True)
class PressPort:
    """How a session gets its presses.

    Attributes:
        url: Port of the sensor.
        device: Device file.
        baud: Bits per second.
        yes: Whether presses are where they are proposed, without asking.
        press_list: File of the presses that a machine makes.
        until: Error left over that of noise at which it is enough.
        fresh: Whether to delete the presses of a stopped session.
        position_std_mm: How well places are known, mm.
        force_std: How well forces are known, share.
    """

    url: str
    device: Path | None
    baud: int
    yes: bool
    press_list: Path | None
    until: float
    fresh: bool
    position_std_mm: float
    force_std: float


def calibrate_at_port(
    port: PressPort, problem: CalibrationProblem, folder: Path, *, json_lines: bool
) -> CalibrationResult:
    """Take presses from a port until it is enough, and calibrate with them.

    Args:
        port: How the presses come.
        problem: The films.
        folder: Of the calibration, held by `calibration_folder`; the presses are in it from the first one on.
        json_lines: Whether to print a line of JSON for each press.

    Raises:
        PressError: If no film explains the presses; they are on disk.
        IsochargeError: Of port, device file or tare; what was taken is on disk.
    """
    contacts = None if port.press_list is None else read_press_list(port.press_list)
    session = _session(port, problem, folder)
    for number, contact in enumerate(() if contacts is None else contacts, start=1):
        with told_where(f"{port.press_list}, press {number}: ", PressError):
            session.check(contact)
    taken = partial(_print_press, machine=contacts is not None) if json_lines else lambda *_: None
    try:
        with _events(port, problem) as events:
            dialogue = Dialogue(session, events, Screen(problem.electrodes), taken)
            if contacts is None:
                dialogue.with_person(asks=not port.yes)
            else:
                dialogue.with_machine(contacts)
        if len(session) < FEWEST_TO_SAY:
            raise PressError(f"expected {FEWEST_TO_SAY} presses or more for a calibration, got {len(session)}")
        if session.result is None:
            raise PressError(session.refusal)
    except BaseException:
        if len(session):
            say(f"{len(session)} presses are in {folder / SESSION}; the same command goes on with them")
        raise
    return session.result


def _session(port: PressPort, problem: CalibrationProblem, folder: Path) -> PressSession:
    """A new session, or the one that was stopped."""
    std = {"position_std_mm": port.position_std_mm, "force_std": port.force_std}
    presses = session_presses(folder, problem, fresh=port.fresh, **std)
    if presses:
        say(f"going on with {len(presses)} presses of a stopped session, {folder / SESSION}; --fresh begins anew")
    return PressSession(problem, save=partial(save_session, folder), presses=presses, until=port.until, **std)


@contextmanager
def _events(port: PressPort, problem: CalibrationProblem) -> Iterator[PressEvents]:
    board, machine = load_device(port.device), port.press_list is not None
    if board.common_mode is not None:  # to follow warming needs a model that is right about the film
        say(f"{port.device}: [common_mode] is left out while calibrating: it needs the model that is being made")
        board = replace(board, common_mode=None)
    stream = ReadingStream(problem.electrodes, board, reader=f"sensor {problem.sensor.name}")
    keyboard = None if machine or port.yes else _keyboard()
    with (
        doctor_is_named(port.url, port.device),
        open_source(port.url, baud=port.baud, reconnect=not machine, request=board.request) as source,
        PressEvents(source, stream, PressWatch(problem.electrodes), keyboard) as events,
    ):
        yield events


def _keyboard() -> int:
    try:
        return sys.stdin.fileno()
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(
            "there is no input to answer questions from; give --yes for presses that are where they are proposed, or "
            "--press-list FILE for those of a machine"
        ) from error


def _print_press(session: PressSession, press: SteadyPress, *, machine: bool) -> None:
    """The last press, and what is known since, as a line of JSON."""
    presses, result = session.presses, session.result
    values = {
        "press": len(session),
        **dict(zip(("x_mm", "y_mm", "force_N"), presses.contact[-1].tolist(), strict=True)),
        "charge_pC": dict(zip(presses.electrodes, press.charge_pC.tolist(), strict=True)),
        "scatter_pC": dict(zip(presses.electrodes, press.scatter_pC.tolist(), strict=True)),
        "held_s": press.held_s,
        "frames": press.frames,
        "flags": list(press.flags),
        "error_left": error_table(result.error_left) if result else None,
        "left_out": list(result.bad_lines) if result else [],
        "problem": session.refusal or None,
        "enough": session.enough,
        "next": None if machine or session.enough else vars(session.proposed),
    }
    show_json(values)
