"""`isocharge serve doctor`: examine what a port sends, and write the device file of the board."""

from dataclasses import asdict, replace
from pathlib import Path
from shlex import join
from typing import Annotated, Any

import typer

from isocharge.cli.shared.options import DeviceOption, JsonOption, ModelsOption, WaitOption
from isocharge.cli.shared.terminal import say, show, show_json, show_result
from isocharge.common.errors import InputError, printable
from isocharge.common.files import as_output_errors, check_new_output, write_whole
from isocharge.common.toml_text import to_toml
from isocharge.serve import Examination, Port, Predictor, device_from_table, examine, load_device
from isocharge.serve.examination.electrode_check import ElectrodeCheck, check_electrodes, corrected_table
from isocharge.serve.examination.listening import BAUDS
from isocharge.serve.examination.port_check import port_lines

HEAD = "Written by `isocharge serve doctor` from what came through a port; the keys are in serve/docs/device_file.md."
"""First line of a device file."""

SHOWN = ("name", "offset_pC", "noise_pC", "drift_pC_per_s", "hum_pC")
"""Values of a channel in the table."""


def doctor_command(
    port: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Port of the sensor: device path, tcp://HOST:PORT, udp://HOST:PORT, pyserial URL. (default: list the "
            "serial ports and what they seem to send)",
        ),
    ] = None,
    device: DeviceOption = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="Model that is to be used, name or path, or a sensor file: its electrodes are looked for. (default: "
            "none)",
        ),
    ] = None,
    models: ModelsOption = None,
    seconds: Annotated[float, typer.Option(min=0.5, max=3600.0, help="Time to listen, s.")] = 5.0,
    wait: WaitOption = 0.0,
    baud: Annotated[
        int | None,
        typer.Option(min=1, help="Speed of the port, bits per second. (default: the usual ones in turn)"),
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a device file for this board, TOML. (default: no)"),
    ] = None,
    pC_per_unit: Annotated[
        str | None,
        typer.Option(
            "--pc-per-unit",
            metavar="NUMBER|A=..,B=..",
            help="Charge of one unit that the board sends, pC; needed for the device file if the board does not "
            "send pC. (default: unknown)",
        ),
    ] = None,
    request: Annotated[
        str | None,
        typer.Option(
            metavar="BYTES",
            help="Request that the board answers with a frame, in hexadecimal, as in '3F 0A'. (default: none)",
        ),
    ] = None,
    check_wiring: Annotated[
        bool,
        typer.Option(
            "--check-electrodes",
            help="After listening, ask for a press near each electrode in turn, and report channels that are swapped "
            "or turned. --write then writes the order that was found. (default: no)",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Listen on a port, report its frames, the quality of its charges and missing settings, and write a device file.

    Do not touch the film meanwhile, because the offset, the noise and the drift of the charges are measured at rest. If
    the film is touched, no device file is written. The exit code is 1 if no frames are recognised or the film is
    touched.

    Example: isocharge serve doctor --port /dev/ttyACM0 --write board.toml
    """
    if port is None:
        show_result({"ports": [*port_lines()]}, json=json)
        return

    # Check the options before the port is opened.
    if write:
        check_new_output(write)
    electrodes = _electrodes_of(model, models)
    gain = None if pC_per_unit is None else {"pC_per_unit": _parse_gain(pC_per_unit)}
    if device and (gain or request):
        option, section = ("--pc-per-unit", "gain") if gain else ("--request", "frames")
        raise InputError(
            f"{option}: expected none beside --device, because the device file states it; leave the option out, "
            f"or write it into the section [{section}] of {device}"
        )
    if gain:
        device_from_table({"gain": gain}, "--pc-per-unit")  # raises an error for 0 or a number that is not finite

    # Listen on the port, and report what it sends.
    say(f"listening for {seconds:g} s; leave the film alone")
    examination = examine(
        port,
        bauds=(baud,) if baud else BAUDS,
        seconds=seconds,
        device=load_device(device),
        electrodes=electrodes,
        gain=gain,
        request=device_from_table({"frames": {"request": request}}, "--request").request,
        wait=wait,
    )
    if not json:
        show_result(brief_report(examination))

    obstacle = ""  # reason why no device file can be written
    if examination.touch:
        obstacle = "the film was touched: take the finger away, and try again"
    elif write is not None and device is None and examination.unit != "pC":
        obstacle = "the charge of one unit is missing: add the option that is named above"

    # Find out which channel belongs to each electrode, if the user has requested this.
    found_channels = None
    if check_wiring and examination.good and not obstacle:
        wiring = _check_wiring(examination)
        found_channels = wiring.found
        examination = replace(examination, device=corrected_table(examination.device, wiring))
        if not json:
            show("\n".join(wiring.sentences))
    if json:
        show_json(asdict(examination) | {"found_channels": found_channels})

    if obstacle:
        say(f"no device file can be written, because {obstacle}")
    if obstacle or not examination.good:
        raise typer.Exit(1)
    if write:
        shown_model = model if model and not model.endswith(".toml") else "MODEL"  # a placeholder without a model
        _write_device_file(write, examination, shown_model)


def _electrodes_of(model: str | None, models: Path | None) -> tuple[str, ...]:
    """Return the names of the electrodes for which the channels of a board are searched.

    Args:
        model: Value of `--model`: a model, a sensor file if the film has no model yet, or None. If the value is None or
            empty, the result is empty, and the board may use any names.
        models: Value of `--models`.
    """
    if not model:
        return ()
    if model.endswith(".toml"):
        from isocharge.simulate import load_sensor

        return load_sensor(model).electrode_names
    return Predictor(model, models=models).metadata.electrodes


def _check_wiring(examination: Examination) -> ElectrodeCheck:
    """Ask the user for a press near each electrode, and return which channel changes most under each press.

    Args:
        examination: Result of the port check, with the device file and the channels of the board.

    Raises:
        PressCheckError: If an expected press is not made, or the presses do not distinguish the channels.
    """
    table = dict(examination.device)
    if examination.unit != "pC":
        # The board sends another unit, whose charge in pC is unknown. The section `[gain]` would then contain only the
        # offsets, and such a section is refused. The check works without it, in the unit of the board.
        table.pop("gain", None)
    device = device_from_table(table, "board")
    # Without a section `[channels]`, each electrode has the channel that the port check has found by names or order.
    channels = device.channels or {channel.electrode: channel.name for channel in examination.channels}
    # Largest minus smallest charge of a channel at rest, in the unit of the board. An unknown span counts as 0.
    rest_span = max(channel.span_pC or 0.0 for channel in examination.channels)
    with Port(examination.url, baud=examination.baud, request=device.request) as port:
        return check_electrodes(port, device, channels, say, examination.unit, rest_span)


def _parse_gain(text: str) -> Any:
    """Parse `--pc-per-unit`, and return one number or a number for each electrode.

    Args:
        text: Value of the option, such as `0.1` or `A=0.1,B=-0.1`.

    Raises:
        InputError: If the text has neither of these forms.
    """
    try:
        if "=" not in text:
            return float(text)
        pairs = (part.partition("=") for part in text.split(","))
        return {electrode.strip(): float(number) for electrode, _equals_sign, number in pairs}
    except ValueError as error:
        raise InputError(
            f"--pc-per-unit: expected a number like 0.0457, or A=0.0457,B=-0.0457, got {text!r}"
        ) from error


def _write_device_file(path: Path, examination: Examination, model: str) -> None:
    """Write the device file, and print the command that uses it.

    Args:
        path: The file.
        examination: Result of the port check, which contains the content of the device file.
        model: Name of the model for the printed command.

    Raises:
        OutputError: If the file cannot be written.
    """
    with as_output_errors(path):
        write_whole(path, device_text(examination).encode())
    if examination.missing:
        say("mend what is missing above, or put the missing settings into the file")
    if "offset" in examination.device.get("gain", {}):  # the charges of the film at rest
        say("the offsets are right only if nothing lay on the film; a steady weight cannot be noticed")
    command = join(["isocharge", "serve", "stream", model, "--port", examination.url, "--device", str(path)])
    say(f"{path} written; use it with: {command}")


def device_text(examination: Examination) -> str:
    """Return the device file of a board as TOML text, which begins with comments that describe the board.

    Args:
        examination: Result of the port check, with the content of the device file.
    """
    comments = [HEAD, f"{examination.format}; {examination.rate_Hz:.4g} frames per second"]
    if examination.unused:
        comments.append(f"channels that no electrode uses: {printable(', '.join(examination.unused))}")
    return to_toml(examination.device, comments)


def brief_report(examination: Examination) -> dict[str, Any]:
    """Return the report on a port without the device file. The names of values contain the unit of the channels.

    Args:
        examination: Result of the port check.
    """
    report = asdict(examination)
    del report["device"]
    report["channels"] = [
        {name.replace("_pC", f"_{examination.unit}"): channel[name] for name in SHOWN} for channel in report["channels"]
    ]
    return {name: value for name, value in report.items() if value != ""}
