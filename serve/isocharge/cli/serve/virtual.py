"""`isocharge serve virtual`: a virtual sensor, which uses the forward map and the amplifier of the simulation."""

import threading
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from isocharge.cli.shared.forward_maps import ROUNDING_MARGIN, ProbeOption, solving_executor
from isocharge.cli.shared.options import MapRadiusOption, SecondsOption, SensorArgument
from isocharge.cli.shared.terminal import announce, say, shown_progress, until_stopped
from isocharge.cli.shared.virtual_sensor import film_charges, measure_function, random_script
from isocharge.common.defaults import DEFAULT_PLAYED_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError
from isocharge.common.files import check_new_output
from isocharge.serve import VirtualSensor, encode_frame, encode_text
from isocharge.serve.virtual_sensor.script import VirtualScript, load_script
from isocharge.simulate import (
    Circle,
    ForwardMap,
    load_amplifier,
    load_sensor,
    parse_probe,
    virtual_film,
)


def virtual_command(
    sensor: SensorArgument,
    seconds: SecondsOption = None,
    rate: Annotated[float, typer.Option(metavar="HZ", min=1.0, max=5000.0, help="Frames per second, Hz.")] = 200.0,
    force_max: Annotated[
        float, typer.Option(min=0.05, help="Largest force of a random press, N; the smallest is 0.05 N.")
    ] = DEFAULT_PLAYED_FORCE_RANGE[1],
    radius: MapRadiusOption = DEFAULT_RADIUS,
    rest: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=3600.0,
            help="Time before the first random press, s. A script states its own.",
        ),
    ] = 1.0,
    noise: Annotated[
        str, typer.Option(help="Amplifier: clean, reference, measured, bench, surgery, or a TOML file.")
    ] = "reference",
    probe: ProbeOption = "circle:1.0",
    film: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="SEED",
            help="Play a film drawn at random about SENSOR and --probe, as on a bench that nobody has measured: "
            "pretension, stiffness, thickness, coefficients, gains, place of the electrodes, radius of the probe. "
            "(default: SENSOR as described)",
        ),
    ] = None,
    link: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Symbolic link to make to the port. (default: none)"),
    ] = None,
    script: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What to play, TOML: presses, faults of the line. (default: random presses, no faults)",
        ),
    ] = None,
    frames: Annotated[Literal["binary", "csv", "json"], typer.Option(help="Format of the frames.")] = "binary",
) -> None:
    """Play a sensor: simulate presses that wander over the film, and send their charges as frames on a pseudo-terminal.

    Solves the film, prints the path of the port, then plays until Ctrl-C. A pause (--rest) and a minute of random
    presses alternate.

    Example: isocharge serve virtual three-25um-biaxial --link /tmp/film
    """
    if link is not None:
        check_new_output(link)
    settings = load_script(script) if script else VirtualScript()
    scripted_presses = settings.script(rate)
    played_sensor = load_sensor(sensor)
    footprint = parse_probe(probe)
    amplifier = load_amplifier(noise)
    if film is not None:
        if not isinstance(footprint, Circle):
            raise InputError(f"--film: expected a --probe like circle:1.0, whose radius is drawn, too, got {probe!r}")
        played_sensor, footprint = virtual_film(played_sensor, footprint, film)
    if scripted_presses is not None:  # the map must contain all presses of the script
        x_mm, y_mm, force_N = scripted_presses.contact.T
        distance_mm = np.hypot(x_mm, y_mm)
        radius = np.fmax.reduce(ROUNDING_MARGIN * distance_mm, initial=radius)  # ignores NaN between presses
        force_max = np.max(ROUNDING_MARGIN * force_N, initial=force_max)
    with shown_progress(), solving_executor(played_sensor.film) as executor:
        forward_map = ForwardMap.build(
            played_sensor,
            footprint,
            radius=radius,
            force_range=(DEFAULT_PLAYED_FORCE_RANGE[0], force_max),
            executor=executor,
        )
    player = VirtualSensor(
        film_charges(forward_map),
        scripted_presses or random_script(forward_map, rate, force_max, rest),
        noise=measure_function(amplifier, len(forward_map.electrodes), rate),
        encode=encode_frame if frames == "binary" else partial(encode_text, notation=frames),
        faults=settings.faults,
        link=link,
    )
    with until_stopped(), player:
        announce(player.port_path)
        played_name = sensor if film is None else f"film {film} of {sensor}"
        say(f"playing {played_name} at {rate:g} Hz; Ctrl-C stops")
        threading.Event().wait(seconds)  # sleeps until Ctrl-C if `seconds` is None
    say(
        f"{player.sent} frames sent, {player.withheld} withheld because no program read them, {player.lost} lost "
        f"and {player.corrupted} damaged on purpose"
    )
    if player.paused_s > 0.0:
        say(f"the sensor paused for {player.paused_s:.1f} s in all, because this computer was busy")
