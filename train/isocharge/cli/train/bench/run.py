"""A session at the bench from its port to its calibration: everything taken is on disk at once."""

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from msgspec import structs

from isocharge.cli.shared.options import board_of
from isocharge.cli.shared.terminal import log_to_stderr, say
from isocharge.cli.train.bench.dialogue import Dialogue
from isocharge.cli.train.bench.events import BenchEvents
from isocharge.cli.train.bench.screen import Screen
from isocharge.common.errors import InputError, PressError

if TYPE_CHECKING:
    from isocharge.common.arrays import Array
    from isocharge.serve import Device, MeasuredPresses, SteadyPress
    from isocharge.train import BenchSession, Calibration, EarlierFilm, SensorFilms


@dataclass(frozen=True)
class BenchPort:
    """How a session gets its presses.

    Attributes:
        url: Port of the sensor.
        device: Device file.
        baud: Bits per second.
        yes: Whether presses are where they are proposed, without asking.
        press_list: File of the presses that a machine makes.
        until: Error left over that of noise at which it is enough.
        fresh: Whether to delete the presses of a stopped session.
    """

    url: str
    device: Path | None
    baud: int
    yes: bool
    press_list: Path | None
    until: float
    fresh: bool


def calibrate_at_port(
    bench: BenchPort,
    chosen: "SensorFilms",
    before: "EarlierFilm",
    folder: Path,
    std: tuple[float, float],
    *,
    json_lines: bool,
) -> "Calibration":
    """Take presses from a port until it is enough, and calibrate with them.

    Args:
        bench: How the presses come.
        chosen: The network for all films of this sensor.
        before: What is known of the film.
        folder: Of the calibration; the presses are in it from the first one on.
        std: How well places (mm) and forces (share) are known.
        json_lines: Whether to print a line of JSON for each press.

    Raises:
        PressError: If no film explains the presses; they are on disk.
        IsochargeError: Of port, device file or tare; what was taken is on disk.
    """
    from isocharge.serve.prediction.press_list import read_press_list
    from isocharge.train.calibration.folder import check_calibration_folder

    check_calibration_folder(folder)
    contacts = None if bench.press_list is None else read_press_list(bench.press_list)
    session = _session(bench, chosen, before, folder, std)
    if contacts is not None:
        _check_list(session, contacts, bench.press_list)
    with _presses_stay(session, folder), _events(bench, chosen) as events:
        screen = Screen(session.presses.electrodes)
        machine = contacts is not None
        dialogue = Dialogue(session, events, screen, partial(_print_press, machine=machine) if json_lines else _silent)
        try:
            if contacts is None:
                dialogue.with_person(asks=not bench.yes)
            else:
                dialogue.with_machine(contacts)
        finally:
            screen.rest()
    with _presses_stay(session, folder):
        return _result(session)


def _session(
    bench: BenchPort, chosen: "SensorFilms", before: "EarlierFilm", folder: Path, std: tuple[float, float]
) -> "BenchSession":
    from isocharge.train import BenchSession
    from isocharge.train.calibration.folder import save_session

    presses = _presses_of_stopped(bench, chosen, folder, std)
    return BenchSession(
        chosen.scene,
        before,
        save=partial(save_session, folder),
        presses=presses,
        position_std_mm=std[0],
        force_std=std[1],
        until=bench.until,
    )


def _presses_of_stopped(
    bench: BenchPort, chosen: "SensorFilms", folder: Path, std: tuple[float, float]
) -> "MeasuredPresses | None":
    from isocharge.serve import read_presses
    from isocharge.train.calibration.folder import SESSION

    path = folder / SESSION
    if bench.fresh:
        path.unlink(missing_ok=True)
    if not path.is_file():
        return None
    names = chosen.films.prior.sensor.electrode_names
    presses = read_presses(path, names, position_std_mm=std[0], force_std=std[1])
    say(f"going on with {len(presses)} presses of a stopped session, {path}; --fresh begins anew")
    return presses


def _check_list(session: "BenchSession", contacts: "Array", path: Path | None) -> None:
    """Refuse a list with a press that cannot be taken, before the first one is made."""
    for number, contact in enumerate(contacts, start=1):
        try:
            session.check(contact)
        except PressError as error:
            raise PressError(f"{path}, press {number}: {error}") from error


@contextmanager
def _events(bench: BenchPort, chosen: "SensorFilms") -> "Iterator[BenchEvents]":
    from isocharge.serve import PressWatch, ReadingStream, open_source

    sensor, machine = chosen.films.prior.sensor, bench.press_list is not None
    board = _board(bench.device)
    stream = ReadingStream(sensor.electrode_names, board, reader=f"sensor {sensor.name}")
    keyboard = None if machine or bench.yes else _keyboard()
    with ExitStack() as stack:
        stack.enter_context(log_to_stderr())
        request = board.request
        source = stack.enter_context(open_source(bench.url, baud=bench.baud, reconnect=not machine, request=request))
        yield stack.enter_context(BenchEvents(source, stream, PressWatch(sensor.electrode_names), keyboard))


def _board(device: Path | None) -> "Device":
    """The board, without following of warming: that needs a model which is right about the film."""
    board = board_of(device)
    if board.common_mode is not None:
        say(f"{device}: [common_mode] is left out while calibrating: it needs the model that is being made")
    return structs.replace(board, common_mode=None)


def _keyboard() -> int:
    try:
        return sys.stdin.fileno()
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(
            "there is no input to answer questions from; give --yes for presses that are where they are proposed, or "
            "--script FILE for those of a machine"
        ) from error


@contextmanager
def _presses_stay(session: "BenchSession", folder: Path) -> Iterator[None]:
    """Say where the presses are if the session does not end well."""
    from isocharge.train.calibration.folder import SESSION

    saved = f"{{}} presses are in {folder / SESSION}; the same command goes on with them"
    try:
        yield
    except KeyboardInterrupt:
        say("stopped: " + (saved.format(len(session)) if len(session) else "no press was taken"))
        raise typer.Exit(1) from None
    except Exception:
        if len(session):
            say(saved.format(len(session)))
        raise


def _result(session: "BenchSession") -> "Calibration":
    from isocharge.train.calibration.session import FEWEST_TO_SAY

    if len(session) < FEWEST_TO_SAY:
        raise PressError(f"expected {FEWEST_TO_SAY} presses or more for a calibration, got {len(session)}")
    if session.calibration is None:
        raise PressError(session.problem)
    return session.calibration


def _print_press(session: "BenchSession", press: "SteadyPress", *, machine: bool) -> None:
    """The last press, and what is known since, as a line of JSON."""
    from isocharge.common.json_values import plain_values

    presses, calibration = session.presses, session.calibration
    values = {
        "press": len(session),
        **dict(zip(("x_mm", "y_mm", "force_N"), presses.contact[-1].tolist(), strict=True)),
        "charge_pC": dict(zip(presses.electrodes, press.charge_pC.tolist(), strict=True)),
        "scatter_pC": dict(zip(presses.electrodes, press.scatter_pC.tolist(), strict=True)),
        "held_s": press.held_s,
        "frames": press.frames,
        "flags": list(press.flags),
        "error_left": calibration.to_dict()["error_left"] if calibration else None,
        "left_out": list(calibration.bad_lines) if calibration else [],
        "problem": session.problem or None,
        "enough": session.enough,
        "next": None if machine or session.enough else vars(session.proposed),
    }
    print(json.dumps(plain_values(values), allow_nan=False), flush=True)


def _silent(session: "BenchSession", press: "SteadyPress") -> None:  # noqa: ARG001
    return
