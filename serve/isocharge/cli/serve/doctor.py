"""`isocharge serve doctor`: what is on a port, in words or as JSON."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.serve.options import DeviceOption, ModelsOption, board_of

if TYPE_CHECKING:
    from isocharge.serve import Examination


def doctor_command(
    port: Annotated[str, typer.Option("--port", metavar="URL", help="Device path or pyserial URL of the sensor.")],
    device: DeviceOption = None,
    model: Annotated[
        str | None, typer.Option("--model", metavar="MODEL", help="The model that is meant for it. (default: any)")
    ] = None,
    models: ModelsOption = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.5, max=3600.0, help="How long to listen, s.")] = 5.0,
    baud: Annotated[
        int | None, typer.Option("--baud", min=1, help="Bits per second. (default: the usual ones are tried)")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of words.")] = False,
) -> None:
    """Say what is on a port, and what is missing to get a touch. Leave the film alone meanwhile.

    Example: isocharge serve doctor --port /dev/ttyACM0
    """
    from json import dumps

    from isocharge.serve import Predictor, examine
    from isocharge.serve.live.port_check import BAUDS

    electrodes = Predictor(model, models=models).metadata.electrodes if model else ()
    found = examine(
        port, bauds=(baud,) if baud else BAUDS, seconds=seconds, device=board_of(device), electrodes=electrodes
    )
    print(dumps(asdict(found)) if json else "\n".join(_in_words(found)))


def _in_words(found: "Examination") -> Iterator[str]:
    yield f"{found.url} at {found.baud} baud: {found.format}"
    yield f"{found.bytes_seen} bytes in {found.seconds:.1f} s, {found.rate_Hz:.1f} frames/s"
    yield f"{found.good} good frames, {found.bad} bad pieces"
    numbers = "frames have no numbers" if found.lost is None else f"{found.lost} lost, {found.repeated} repeated"
    yield f"{numbers}; {'a' if found.device_clock else 'no'} device clock"
    if found.channels:
        yield "channel    offset pC   noise pC  drift pC/s  50 Hz pC  60 Hz pC"
    for channel in found.channels:
        figures = (channel.offset_pC, channel.noise_pC, channel.drift_pC_per_s, *channel.hum_pC)
        columns = zip(figures, (12, 11, 12, 10, 10), (2, 3, 2, 2, 2), strict=True)
        yield f"{channel.name:8.8s}" + "".join(_column(*column) for column in columns)
    yield "missing to get a touch: nothing" if not found.missing else "missing to get a touch:"
    yield from (f"- {words}" for words in found.missing)


def _column(figure: float | None, width: int, digits: int) -> str:
    return f"{'?' if figure is None else f'{figure:.{digits}f}':>{width}s}"
