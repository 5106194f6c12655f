"""`isocharge simulate ...`: one press, or a dataset of many."""

import json as json_module
from contextlib import AbstractContextManager
from dataclasses import asdict
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.terminal import progress_rows, say
from isocharge.errors import InputError

if TYPE_CHECKING:
    from isocharge.arrays import Array
    from isocharge.simulate import Equilibrium, Probe, Sensor
    from isocharge.simulate.execution.workers import Workers

simulate_app = typer.Typer(no_args_is_help=True, help="From a press to the charges of the electrodes.")

PROBE_HELP = "What presses, mm: circle:R, rectangle:WxH, triangle:SIDE, polygon:X,Y;X,Y;..., each turned by @DEGREES."

MOST_WORKERS = 64

SWEEP_ROWS = (("solving the film", "solves"), ("pressing", "presses"))
"""Titles and units of a sweep's progress."""

SensorArgument = Annotated[str, typer.Argument(metavar="SENSOR", help="Built-in sensor, or a TOML file.")]


class Orientation(StrEnum):
    """How probes are turned in a sweep."""

    fixed = "fixed"
    random = "random"


class Sampling(StrEnum):
    """How the presses of a sweep are spread."""

    sobol = "sobol"
    random = "random"
    grid = "grid"


@simulate_app.command("point")
def point_command(
    sensor: SensorArgument,
    probe: Annotated[str, typer.Option("--probe", help=PROBE_HELP)] = "circle:1.0",
    at: Annotated[str, typer.Option("--at", metavar="X,Y", help="Where, mm from the film's centre.")] = "0,0",
    force: Annotated[float, typer.Option("--force", help="How hard, N, positive pushes.")] = 1.0,
    accuracy: Annotated[
        float, typer.Option("--accuracy", help="Relative error of a charge that is wanted; chooses theory and mesh.")
    ] = 1e-3,
    theory: Annotated[
        str, typer.Option("--theory", help="auto, or 'nonlinear membrane + bending', 'linear plate', ...")
    ] = "auto",
    temperature: Annotated[
        float, typer.Option("--temperature", metavar="K", help="Add the charge of a uniform temperature step.")
    ] = 0.0,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of a table.")] = False,
) -> None:
    """Charges (pC) and deflection (mm) under one press.

    Example: isocharge simulate point three-25um-biaxial --probe triangle:4.0@30 --at 3,-2 --force 1.0
    """
    from isocharge.simulate import load_sensor, parse_probe, press, theory_for, thermal_charge, touch_charge
    from isocharge.simulate.mechanics.theory import named

    if not 1e-8 <= accuracy <= 1.0:
        raise InputError(f"--accuracy: expected a relative error from 1e-8 to 1, got {accuracy}")
    film_sensor, pressing = load_sensor(sensor), parse_probe(probe)
    terms = named(theory, film_sensor.film) if theory != "auto" else None
    terms = terms or theory_for(film_sensor, pressing, (force, force), accuracy)
    equilibrium = press(film_sensor.film, pressing, position(at), force, theory=terms, accuracy=accuracy)
    charge = touch_charge(film_sensor, equilibrium) + thermal_charge(film_sensor, temperature)
    report = _report(film_sensor, equilibrium, charge)
    typer.echo(json_module.dumps(report) if json else _table(report))
    for warning in [*_doubts(equilibrium, accuracy), *report["warnings"]]:
        say(f"caution: {warning}")


def _doubts(equilibrium: "Equilibrium", accuracy: float) -> list[str]:
    """What is to be said where the wanted accuracy is not reached."""
    error = equilibrium.estimated_error
    if not isfinite(error):
        return [f"a {equilibrium.theory.name} says nothing about this film; leave --theory away"]
    return [f"the charges may be off by {error:.2g}, {accuracy:.2g} was wanted"] if error > accuracy else []


def position(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) * 1e-3 for part in text.split(","))
    except ValueError as error:
        raise InputError(f"--at: expected two numbers in mm like '3,-2', got {text!r}") from error
    return x, y


def _report(sensor: "Sensor", equilibrium: "Equilibrium", charge: "Array") -> dict[str, Any]:
    """The object that `--json` prints."""
    import numpy as np

    return {
        "charge_pC": dict(zip(sensor.electrode_names, (charge * 1e12).tolist(), strict=True)),
        "deflection_mm": float(equilibrium.deflection(np.array([equilibrium.at]))[0] * 1e3),
        "theory": equilibrium.theory.name,
        "status": equilibrium.status,
        "iterations": equilibrium.iterations,
        "residual": equilibrium.residual,
        "seconds": equilibrium.seconds,
        "estimated_error": equilibrium.estimated_error if isfinite(equilibrium.estimated_error) else None,
        "groups": {**asdict(equilibrium.groups), "bending_length": equilibrium.bending_length},
        "warnings": list(equilibrium.warnings),
    }


def _table(report: dict[str, Any]) -> str:
    charges = [f"charge {name:<10} {charge:10.2f} pC" for name, charge in report["charge_pC"].items()]
    return "\n".join(
        [
            *charges,
            f"deflection        {report['deflection_mm']:10.4f} mm",
            f"theory            {report['theory']}, estimated error {_percent(report['estimated_error'])}",
            f"solver            {report['status']} in {report['iterations']} steps, residual "
            f"{report['residual']:.1e}, {report['seconds'] * 1e3:.0f} ms CPU",
        ]
    )


def _percent(error: float | None) -> str:
    return "unknown" if error is None else f"{error:.2%}"


@simulate_app.command("sweep")
def sweep_command(
    sensor: SensorArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Dataset folder to make.")],
    probe: Annotated[
        list[str] | None, typer.Option("--probe", help="What presses; may be given again. (default: circle:1.0)")
    ] = None,
    radius: Annotated[
        str,
        typer.Option(
            "--radius", metavar="MM|auto", help="Largest distance from the centre, mm, or auto: the working area's."
        ),
    ] = "8.0",
    force: Annotated[
        tuple[float, float], typer.Option("--force", metavar="MIN MAX", help="Smallest and largest force, N.")
    ] = (0.05, 2.0),
    samples: Annotated[int, typer.Option("--samples", help="How many presses.")] = 20_000,
    orientation: Annotated[
        Orientation, typer.Option("--orientation", help="Turn the probe further in each press.")
    ] = Orientation.fixed,
    sampling: Annotated[
        Sampling, typer.Option("--sampling", help="How the presses are spread; a grid takes at most --samples.")
    ] = Sampling.sobol,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the presses.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, max=MOST_WORKERS, help="Processes; the data do not depend on them. (default: cores)"
        ),
    ] = None,
    cluster: Annotated[
        str | None, typer.Option("--cluster", metavar="ADDR", help="Dask cluster instead, as tcp://10.0.0.1:8786.")
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Throw away what a stopped run left.")] = False,
) -> None:
    """Simulate many presses, spread over the working area and the forces, and write them as a dataset.

    A run that was stopped or killed leaves DIR.part; the same command goes on from there and writes the same bytes.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    from isocharge.resumable_run import refuse_finished
    from isocharge.simulate import Sweep, load_sensor, parse_probe, run_sweep

    if workers and cluster:
        raise InputError("expected either --workers or --cluster, got both")
    film_sensor, probes = load_sensor(sensor), [parse_probe(text) for text in probe or ["circle:1.0"]]
    refuse_finished(output)
    reach = auto_radius(film_sensor, probes, force) if radius == "auto" else 1e-3 * number_mm(radius)
    sweep = Sweep(reach, force, samples, seed, orientation.value, sampling.value)
    try:
        with _crew(workers, cluster) as crew, progress_rows(*SWEEP_ROWS) as (solving, sampled):
            run_sweep(
                output,
                film_sensor,
                probes,
                sweep,
                executor=crew.executor,
                ahead=crew.ahead,
                fresh=fresh,
                progress=solving,
                sampled=sampled,
                warn=say,
            )
    except KeyboardInterrupt:
        if (part := output.with_name(f"{output.name}.part")).exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on")
        raise
    say(f"{json_module.loads((output / 'manifest.json').read_text())['samples']} presses in {output}")


def number_mm(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--radius: expected a number of mm or 'auto', got {text!r}") from error


def auto_radius(sensor: "Sensor", probes: "list[Probe]", force: tuple[float, float]) -> float:
    """Radius of the disk that is in the working area of every probe under `reference` noise, m."""
    from isocharge.simulate import noise_model, working_area
    from isocharge.simulate.identifiability.identification import map_to_search

    areas = []
    for probe in probes:
        with progress_rows((f"finding the working area of {probe.notation}", "solves")) as (advance,):
            made = map_to_search(sensor, probe, force, advance)
        areas.append(working_area(made, noise_model("reference")))
        say(f"{probe.notation}: {areas[-1].words}")
    radius = min(area.radius for area in areas)
    if radius == 0.0:
        raise InputError(
            "--radius auto: nowhere do the charges tell the contact well enough; see 'isocharge simulate identify', or "
            "give a radius"
        )
    return radius


def _crew(workers: int | None, cluster: str | None) -> AbstractContextManager["Workers"]:
    from isocharge.simulate.execution.workers import cores, dask_workers, local_workers

    return dask_workers(cluster) if cluster else local_workers(workers or min(cores(), MOST_WORKERS))
