"""`isocharge serve doctor`: what is on a port, as text or as JSON."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.serve.options import ModelsOption
from isocharge.cli.shared.options import DeviceOption, JsonOption, board_of

if TYPE_CHECKING:
    from isocharge.serve import Examination


def doctor_command(
    port: Annotated[
        str, typer.Option("--port", metavar="URL", help="Port of the sensor: device path or pyserial URL.")
    ],
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
    baud: Annotated[
        int | None,
        typer.Option("--baud", min=1, help="Speed of the port, bits per second. (default: the usual ones in turn)"),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Listen on a port, and report which frames arrive, how good the charges are, and what is missing for a touch.

    Leave the film alone meanwhile: offset, noise and drift are those of a film at rest.

    Example: isocharge serve doctor --port /dev/ttyACM0
    """
    from json import dumps

    from isocharge.serve import Predictor, examine
    from isocharge.serve.examination.port_check import BAUDS

    electrodes = Predictor(model, models=models).metadata.electrodes if model else ()
    bauds, board = (baud,) if baud else BAUDS, board_of(device)
    examination = examine(port, bauds=bauds, seconds=seconds, device=board, electrodes=electrodes)
    print(dumps(asdict(examination)) if json else "\n".join(report_lines(examination)))


def report_lines(examination: "Examination") -> Iterator[str]:
    """An examination as text for people."""
    yield f"{examination.url} at {examination.baud} baud: {examination.format}"
    yield f"{examination.bytes_seen} bytes in {examination.seconds:.1f} s, {examination.rate_Hz:.1f} frames/s"
    yield f"{examination.good} good frames, {examination.bad} bad pieces"
    numbers = (
        "frames have no numbers"
        if examination.lost is None
        else f"{examination.lost} lost, {examination.repeated} repeated"
    )
    yield f"{numbers}; {'a' if examination.device_clock else 'no'} device clock"
    if examination.channels:
        yield "channel    offset pC   noise pC  drift pC/s  50 Hz pC  60 Hz pC"
    for channel in examination.channels:
        figures = (channel.offset_pC, channel.noise_pC, channel.drift_pC_per_s, *channel.hum_pC)
        columns = zip(figures, (12, 11, 12, 10, 10), (2, 3, 2, 2, 2), strict=True)
        yield f"{channel.name:8.8s}" + "".join(_column(*column) for column in columns)
    yield "missing to get a touch: nothing" if not examination.missing else "missing to get a touch:"
    yield from (f"- {sentence}" for sentence in examination.missing)


def _column(figure: float | None, width: int, digits: int) -> str:
    return f"{'?' if figure is None else f'{figure:.{digits}f}':>{width}s}"
