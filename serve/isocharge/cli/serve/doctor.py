"""`isocharge serve doctor`: what is on a port, as text or as JSON, and the device file that fits it."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from serial.tools import list_ports

from isocharge.cli.serve.records import WaitOption
from isocharge.cli.shared.options import DeviceOption, JsonOption, ModelsOption
from isocharge.cli.shared.terminal import say, show, show_json
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.files import refuse_existing, write_whole
from isocharge.common.number_text import number_of
from isocharge.common.printable_text import printable
from isocharge.serve import Examination, Predictor, examine, load_device
from isocharge.serve.examination.listening import BAUDS
from isocharge.serve.examination.port_check import device_text
from isocharge.serve.model.model_folder import model_names, repositories
from isocharge.serve.port.serial_line import Request
from isocharge.serve.port.source import has_speed

GAIN_METAVAR = "NUMBER|A=..,B=.."


def doctor_command(
    port: Annotated[
        str | None,
        typer.Option(
            "--port",
            metavar="URL",
            help="Port of the sensor: device path, tcp://HOST:PORT, udp://HOST:PORT, pyserial URL. (default: list the "
            "serial ports and what they seem to send)",
        ),
    ] = None,
    device: DeviceOption = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Model that is to be used, name or path: its electrodes are looked for. (default: none)",
        ),
    ] = None,
    models: ModelsOption = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.5, max=3600.0, help="Time to listen, s.")] = 5.0,
    wait: WaitOption = 0.0,
    baud: Annotated[
        int | None,
        typer.Option("--baud", min=1, help="Speed of the port, bits per second. (default: the usual ones in turn)"),
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="FILE", help="Write a device file for this board, TOML. (default: no)"),
    ] = None,
    pC_per_unit: Annotated[
        str | None,
        typer.Option(
            "--pc-per-unit",
            metavar=GAIN_METAVAR,
            help="Charge of one unit that the board sends, pC; for the device file. (default: asked for)",
        ),
    ] = None,
    V_per_unit: Annotated[
        str | None,
        typer.Option(
            "--v-per-unit", metavar=GAIN_METAVAR, help="Voltage of one unit, V; with --feedback-pf. (default: none)"
        ),
    ] = None,
    feedback_pF: Annotated[
        str | None,
        typer.Option(
            "--feedback-pf", metavar=GAIN_METAVAR, help="Feedback capacitance of the amplifiers, pF. (default: none)"
        ),
    ] = None,
    request: Annotated[
        str | None,
        typer.Option(
            "--request",
            metavar="TEXT",
            help=r"What the board has to be asked, as in '?\n' or '\x01\x04'. (default: nothing)",
        ),
    ] = None,
    request_Hz: Annotated[
        float, typer.Option("--request-hz", min=0.1, max=1e5, help="Rate of the requests, at most, Hz.")
    ] = 100.0,
    json: JsonOption = False,
) -> None:
    """Listen on a port: what frames arrive, how good the charges are, what is missing for a touch, a device file.

    Leave the film alone meanwhile: offset, noise and drift are those of a film at rest. Exit code 1 if no frames are
    recognised.

    Example: isocharge serve doctor --port /dev/ttyACM0 --write board.toml
    """
    if port is None:
        show("\n".join(port_lines()) or "no serial ports; is the board plugged in?")
        return
    if write is not None:
        refuse_existing(write)
    electrodes = Predictor(model, models=models).metadata.electrodes if model else ()
    settings = {"pC_per_unit": pC_per_unit, "V_per_unit": V_per_unit, "feedback_pF": feedback_pF}
    say(f"listening for {seconds:g} s")
    examination = examine(
        port,
        bauds=(baud,) if baud else BAUDS,
        seconds=seconds,
        device=load_device(device),
        electrodes=electrodes,
        gain={key: _setting(key, text) for key, text in settings.items() if text is not None},
        request=_request(request, request_Hz),
        wait=wait,
    )
    if json:
        show_json(asdict(examination))
    else:
        show("\n".join(report_lines(examination)))
    alive = len(examination.channels)
    if examination.good and len(electrodes) > alive:
        say(f"models of {alive} electrodes: {', '.join(_models_of(alive, models)) or 'none'}; choose one with --model")
    if examination.good and write is not None:
        _write(write, examination)
    if not examination.good:
        raise typer.Exit(1)


def port_lines() -> Iterator[str]:
    """The serial ports of this machine, what the system says of each, and what came in a second."""
    for found in sorted(list_ports.comports()):
        try:
            heard = examine(found.device, seconds=1.0)
            sends = (
                f"{heard.format}, {heard.rate_Hz:.0f} frames/s at {heard.baud} baud" if heard.good else heard.missing[0]
            )
        except IsochargeError as error:
            sends = str(error)
        yield f"{found.device} ({found.description}): {sends}"


def _models_of(electrodes: int, models: Path | None) -> Iterator[str]:
    """Names of the models with as many electrodes; those that cannot be read are left out."""
    for name in dict.fromkeys(name for root in repositories(models) for name in model_names(root)):
        with suppress(IsochargeError):
            if len(Predictor(name, models=models).metadata.electrodes) == electrodes:
                yield name


def _setting(key: str, text: str) -> Any:
    """A number for all electrodes, or one for each: `A=0.1,B=-0.1`."""
    try:
        if "=" not in text:
            return number_of(text)
        pairs = (part.partition("=") for part in text.split(","))
        return {name.strip(): number_of(number.strip()) for name, _, number in pairs}
    except ValueError as error:
        option = f"--{key.replace('_', '-').lower()}"
        raise InputError(f"{option}: expected a number like 0.0457, or A=0.0457,B=-0.0457, got {text!r}") from error


def _request(text: str | None, rate_Hz: float) -> Request | None:
    if text is None:
        return None
    try:
        data = text.encode("latin-1", "backslashreplace").decode("unicode_escape").encode("latin-1")
    except (UnicodeDecodeError, UnicodeEncodeError) as error:
        raise InputError(rf"--request: expected a text like '?\n' or '\x01\x04', got {text!r}") from error
    if not data:
        raise InputError("--request: expected at least one byte, got an empty text")
    return Request(data, rate_Hz)


def _write(path: Path, examination: Examination) -> None:
    try:
        write_whole(path, device_text(examination).encode())
    except OSError as error:
        raise InputError(f"--write {path}: cannot be written ({error.strerror}); choose another path") from error
    use = f"use it with: isocharge serve stream MODEL --port {examination.url} --device {path}"
    say(f"{path} written; {use if examination.works else 'it gives no touches yet: put in what is missing above'}")


def report_lines(examination: Examination) -> Iterator[str]:
    """An examination as text for people."""
    speed = f" at {examination.baud} baud" if has_speed(examination.url) else ""
    yield f"{examination.url}{speed}: {examination.format}"
    yield f"{examination.bytes_seen} bytes in {examination.seconds:.1f} s, {examination.rate_Hz:.1f} frames/s"
    yield f"{examination.good} good frames, {examination.bad} bad pieces"
    numbers = (
        "frames have no numbers"
        if examination.lost is None
        else f"{examination.lost} lost, {examination.repeated} repeated"
    )
    yield f"{numbers}; {'a' if examination.device_clock else 'no'} device clock"
    if examination.unused:
        yield f"channels that no electrode uses: {printable(', '.join(examination.unused))}"
    if examination.unit != "pC":
        yield f"the channels are {'volts, it seems' if examination.unit == 'V' else examination.unit}, not pC"
    if examination.channels:
        yield _HEAD.replace("pC", {"counts": "ct", "V": " V"}.get(examination.unit, "pC"))
    for channel in examination.channels:
        figures = (channel.offset_pC, channel.noise_pC, channel.drift_pC_per_s, *channel.hum_pC)
        digits = (5, 6, 5, 5, 5) if examination.unit == "V" else (2, 3, 2, 2, 2)
        columns = zip(figures, (12, 11, 12, 10, 10), digits, strict=True)
        yield f"{printable(channel.name):8.8s}" + "".join(
            f"{'?' if figure is None else f'{figure:.{digits}f}':>{width}s}" for figure, width, digits in columns
        )
    if examination.held:
        yield examination.held
    yield "missing to get a touch: nothing" if not examination.missing else "missing to get a touch:"
    yield from (f"- {sentence}" for sentence in examination.missing)


_HEAD = "channel    offset pC   noise pC  drift pC/s  50 Hz pC  60 Hz pC"
