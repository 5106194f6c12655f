"""`isocharge serve virtual`: a sensor made of the simulator's forward map and amplifier."""

import threading
from dataclasses import replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from isocharge.cli.shared.forward_maps import SLACK
from isocharge.cli.shared.options import ProbeOption, SensorArgument
from isocharge.cli.shared.terminal import say, shown_progress, until_stopped
from isocharge.cli.shared.virtual_sensor import measuring, played
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError
from isocharge.common.files import refuse_existing
from isocharge.serve import Script, VirtualSensor, encode_frame, encode_text, load_device
from isocharge.serve.frames.frame_layout import FrameLayout
from isocharge.serve.virtual_sensor.script import VirtualScript, load_script
from isocharge.serve.virtual_sensor.sensor import Encode, posix_modules
from isocharge.simulate import (
    Circle,
    ForwardMap,
    Probe,
    Sensor,
    load_amplifier,
    load_sensor,
    parse_probe,
    virtual_film,
)


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
    rate: Annotated[
        float, typer.Option("--rate", metavar="HZ", min=1.0, max=5000.0, help="Frames per second, Hz.")
    ] = 200.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of presses, noise and offsets.")] = 0,
    force_max: Annotated[
        float, typer.Option("--force-max", min=0.05, help="Largest force, N; the smallest is 0.05 N.")
    ] = DEFAULT_FORCE_RANGE[1],
    radius: Annotated[
        float,
        typer.Option("--radius", metavar="MM", help="Largest distance of a random press from the centre, mm."),
    ] = DEFAULT_RADIUS,
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
            help="What to play, TOML: presses, faults of the line, warming, drift, the converter's limit. "
            "(default: random presses, no faults)",
        ),
    ] = None,
    frames: Annotated[FrameFormat, typer.Option("--frames", help="Format of the frames.")] = FrameFormat.binary,
    device: Annotated[
        Path | None,
        typer.Option(
            "--device", metavar="FILE", help="Device file whose described frames are sent, TOML. (default: --frames)"
        ),
    ] = None,
) -> None:
    """Play a sensor: simulate presses that wander over the film, and send their charges as frames on a pseudo-terminal.

    Prints the path of the port, solves the film, then plays until Ctrl-C. Until it is solved, and in the first second
    of random presses, nothing touches the film.

    Example: isocharge serve virtual three-25um-biaxial --link /tmp/film
    """
    posix_modules()  # no pseudo-terminal: an error before anything is computed
    if link is not None:
        refuse_existing(link)
    play = load_script(script) if script else VirtualScript()
    described, pressing = _played(sensor, probe, film)
    changes: dict[str, Any] = {"step": play.temperature_step_K, "bias": play.drift_pC_per_s, "limit": play.limit_pC}
    amplifier = replace(load_amplifier(noise), **{key: value for key, value in changes.items() if value is not None})
    encode, presses = _encoder(frames, device), play.script(rate)
    forces = (DEFAULT_FORCE_RANGE[0], force_max)
    nowhere, count = np.full(1, np.nan), len(described.electrodes)
    player = VirtualSensor(
        lambda _: np.zeros((0, count)),
        Script(nowhere, nowhere, np.zeros(1), rate),
        noise=measuring(amplifier, rate),
        seed=seed,
        encode=encode,
        faults=play.faults,
        link=link,
    )
    with until_stopped(), player:
        print(player.port_path, flush=True)
        say("solving the film, which is not touched until then")
        with shown_progress():
            forward_map = ForwardMap.build(described, pressing, radius=_farthest(radius, presses), force_range=forces)
        player.use(*played(forward_map, seed, rate, presses))
        say(f"playing {sensor if film is None else f'film {film} of {sensor}'} at {rate:g} Hz; Ctrl-C stops")
        threading.Event().wait(seconds)
    say(
        f"{player.sent} frames sent, {player.withheld} withheld because no program read them, {player.lost} lost and "
        f"{player.corrupted} damaged on purpose, {player.unplugged} times unplugged"
    )


def _played(sensor: str, probe: str, film: int | None) -> tuple[Sensor, Probe]:
    """What is played: sensor and probe as described, or those of a film that a seed draws about them."""
    described, pressing = load_sensor(sensor), parse_probe(probe)
    if film is None:
        return described, pressing
    if not isinstance(pressing, Circle):
        raise InputError(f"--film: expected a round --probe like circle:1.0, whose radius is drawn too, got {probe!r}")
    return virtual_film(described, pressing, film)


def _encoder(frames: FrameFormat, device: Path | None) -> Encode:
    """The function that turns a frame into bytes."""
    if device is None:
        return encode_frame if frames is FrameFormat.binary else partial(encode_text, notation=frames.value)
    layout = load_device(device).frames
    if not isinstance(layout, FrameLayout):
        raise InputError(f'--device {device}: expected a file with described frames: [frames] format = "described"')
    return layout.encode


def _farthest(radius: float, presses: Script | None) -> float:
    """Distance from the centre up to which charges are needed, mm."""
    if presses is None or not presses.touching.any():
        return radius
    return max(DEFAULT_RADIUS, SLACK * float(np.nanmax(np.hypot(presses.x_mm, presses.y_mm))))
