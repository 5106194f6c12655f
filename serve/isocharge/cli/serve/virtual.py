"""`isocharge serve virtual`: a sensor made of the simulator's forward map and amplifier."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from functools import partial
from math import hypot, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import SLACK
from isocharge.cli.shared.options import ProbeOption, SensorArgument
from isocharge.cli.shared.stopping import until_stopped
from isocharge.cli.shared.terminal import progress, say
from isocharge.cli.shared.virtual_sensor import check_pseudo_terminals, virtual_sensor
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError, OutputExists
from isocharge.common.files import bounded_lines

if TYPE_CHECKING:
    from isocharge.serve import Script
    from isocharge.serve.virtual_sensor.sensor import Encode
    from isocharge.simulate import Probe, Sensor


class FrameFormat(StrEnum):
    """Format of the frames; a device file describes others."""

    binary = "binary"
    csv = "csv"
    pairs = "pairs"
    teleplot = "teleplot"
    json = "json"


def virtual_command(
    sensor: SensorArgument,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0.0, max=1e6, help="Time after which to stop, s. (default: at Ctrl-C)"),
    ] = None,
    rate_Hz: Annotated[float, typer.Option("--rate-Hz", min=1.0, max=5000.0, help="Frames per second, Hz.")] = 200.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of presses, noise and offsets.")] = 0,
    force_max: Annotated[
        float, typer.Option("--force-max", min=0.05, help="Largest force, N; the smallest is 0.05 N.")
    ] = DEFAULT_FORCE_RANGE[1],
    radius: Annotated[
        float,
        typer.Option("--radius", metavar="MM", help="Largest distance of a random press from the centre, mm."),
    ] = 1e3 * DEFAULT_RADIUS,
    noise: Annotated[
        str, typer.Option("--noise", help="Amplifier: clean, reference, bench, surgery, or a TOML file.")
    ] = "reference",
    probe: ProbeOption = "circle:1.0",
    film: Annotated[
        int | None,
        typer.Option(
            "--film",
            min=0,
            metavar="SEED",
            help="Play a film drawn at random about SENSOR and --probe, as on a bench that nobody has measured: "
            "pretension, stiffness, thickness, coefficients, gains, place of the electrodes, radius of the probe. "
            "(default: SENSOR as described)",
        ),
    ] = None,
    link: Annotated[
        Path | None,
        typer.Option("--link", metavar="PATH", help="Symbolic link to make to the port. (default: none)"),
    ] = None,
    script: Annotated[
        Path | None,
        typer.Option(
            "--script",
            metavar="FILE",
            help="Presses to play, CSV with seconds, x_mm, y_mm, force_N. (default: random presses)",
        ),
    ] = None,
    frames: Annotated[FrameFormat, typer.Option("--frames", help="Format of the frames.")] = FrameFormat.binary,
    device: Annotated[
        Path | None,
        typer.Option(
            "--device", metavar="FILE", help="Device file whose described frames are sent, TOML. (default: --frames)"
        ),
    ] = None,
    lose: Annotated[
        float, typer.Option("--lose", min=0.0, max=1.0, help="Fault: share of the frames that are lost, 0 to 1.")
    ] = 0.0,
    corrupt: Annotated[
        float,
        typer.Option(
            "--corrupt", min=0.0, max=1.0, help="Fault: share of the bytes that are flipped, dropped or added, 0 to 1."
        ),
    ] = 0.0,
    gap_every: Annotated[
        float, typer.Option("--gap-every", min=0.0, help="Fault: time between silences of 0.1 s, s; 0 for none.")
    ] = 0.0,
    unplug_every: Annotated[
        float,
        typer.Option("--unplug-every", min=0.0, help="Fault: time between disappearances of 0.5 s, s; 0 for none."),
    ] = 0.0,
    clock_ppm: Annotated[
        float, typer.Option("--clock-ppm", help="Fault: error of the board's clock, ppm; positive runs fast.")
    ] = 0.0,
    temperature_step_K: Annotated[
        float | None,
        typer.Option("--temperature-step-K", help="Temperature step of the film after 10 s, K. (default: by --noise)"),
    ] = None,
    drift_pC_per_s: Annotated[
        float | None,
        typer.Option("--drift-pC-per-s", min=0.0, help="Drift from the bias current, pC/s. (default: by --noise)"),
    ] = None,
    limit_pC: Annotated[
        float | None,
        typer.Option("--limit-pC", min=1.0, help="Largest charge that the converter reads, pC. (default: by --noise)"),
    ] = None,
) -> None:
    """Play a sensor: simulate presses that wander over the film, and send their charges as frames on a pseudo-terminal.

    Prints the path of the port, then plays until Ctrl-C. The first second of random presses is without touch, for the
    tare.

    Example: isocharge serve virtual three-25um-biaxial --link /tmp/film
    """
    check_pseudo_terminals()
    from isocharge.serve import Faults
    from isocharge.simulate import ForwardMap, load_amplifier

    scene, amplifier = _scene(sensor, probe, film), load_amplifier(noise)
    changes: dict[str, Any] = {"step": temperature_step_K, "bias": _pico(drift_pC_per_s), "limit": _pico(limit_pC)}
    amplifier = replace(amplifier, **{name: value for name, value in changes.items() if value is not None})
    faults = Faults(
        lose_share=lose,
        corrupt_share=corrupt,
        gap_every_s=gap_every,
        unplug_every_s=unplug_every,
        clock_ppm=clock_ppm,
    )
    encode, presses = _encoder(frames, device), _presses(script, rate_Hz)
    farthest, force_range = 1e-3 * _farthest_mm(radius, presses), (DEFAULT_FORCE_RANGE[0], force_max)
    with progress("solving the film") as advance:
        forward_map = ForwardMap.build(*scene, radius=farthest, force_range=force_range, progress=advance)
    _refuse_taken(link)
    player = virtual_sensor(
        forward_map, amplifier, seed, rate_Hz, script=presses, encode=encode, faults=faults, link=link
    )
    with until_stopped(), _link_errors(link), player:
        print(player.port_path, flush=True)
        say(f"playing {sensor if film is None else f'film {film} of {sensor}'} at {rate_Hz:g} Hz; Ctrl-C stops")
        threading.Event().wait(seconds)
    say(
        f"{player.sent} frames sent, {player.withheld} withheld because no program read them, {player.lost} lost and "
        f"{player.corrupted} damaged on purpose, {player.unplugged} times unplugged"
    )


def _scene(sensor: str, probe: str, film: int | None) -> "tuple[Sensor, Probe]":
    """What is played: sensor and probe as described, or those of a film that a seed draws about them."""
    from isocharge.simulate import Circle, load_sensor, parse_probe, virtual_film

    described, pressing = load_sensor(sensor), parse_probe(probe)
    if film is None:
        return described, pressing
    if not isinstance(pressing, Circle):
        raise InputError(f"--film: expected a round --probe like circle:1.0, whose radius is drawn too, got {probe!r}")
    return virtual_film(described, pressing, film)


def _pico(value: float | None) -> float | None:
    """pC or pC/s in C or C/s."""
    return None if value is None else value * 1e-12


def _encoder(frames: FrameFormat, device: Path | None) -> "Encode":
    """The function that turns a frame into bytes."""
    from isocharge.serve import encode_frame, encode_text, load_device

    if device is None:
        return encode_frame if frames is FrameFormat.binary else partial(encode_text, notation=frames.value)
    layout = load_device(device).layout
    if layout is None:
        raise InputError(f'--device {device}: expected a file with described frames: [frames] format = "described"')
    return layout.encode


def _presses(script: Path | None, rate_Hz: float) -> "Script | None":
    from isocharge.serve import read_script

    if script is None:
        return None
    try:
        with script.open(encoding="utf-8") as lines:
            return read_script(bounded_lines(lines), rate_Hz, str(script))
    except OSError as error:
        raise InputError(f"--script {script}: cannot be read ({error.strerror})") from error


def _farthest_mm(radius: float, presses: "Script | None") -> float:
    """Distance from the centre up to which charges are needed, mm."""
    if presses is None or not presses.touching.any():
        return radius
    distances = [hypot(x, y) for x, y in zip(presses.x_mm, presses.y_mm, strict=True) if isfinite(x)]
    return max(1e3 * DEFAULT_RADIUS, SLACK * max(distances))


def _refuse_taken(link: Path | None) -> None:
    if link is not None and (link.exists() or link.is_symlink()):
        raise OutputExists(f"--link {link}: the path exists already; remove it or choose another path")


@contextmanager
def _link_errors(link: Path | None) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if link is None or error.filename2 != str(link):
            raise
        raise InputError(f"--link {link}: the link cannot be made ({error.strerror}); choose another path") from error
