"""`isocharge simulate point`: the charges of one press."""

import json as json_module
from dataclasses import asdict
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.options import PROBE_HELP, SensorArgument, position
from isocharge.cli.shared.terminal import say
from isocharge.errors import InputError

if TYPE_CHECKING:
    from isocharge.arrays import Array
    from isocharge.simulate import Equilibrium, Sensor


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
    from isocharge.simulate import (
        SolveSettings,
        load_sensor,
        parse_probe,
        press,
        theory_for,
        thermal_charge,
        touch_charge,
    )
    from isocharge.simulate.mechanics.theory import theory_by_name

    if not 1e-8 <= accuracy <= 1.0:
        raise InputError(f"--accuracy: expected a relative error from 1e-8 to 1, got {accuracy}")
    film_sensor, pressing = load_sensor(sensor), parse_probe(probe)
    terms = theory_by_name(theory, film_sensor.film) if theory != "auto" else None
    terms = terms or theory_for(film_sensor, pressing, (force, force), accuracy)
    equilibrium = press(film_sensor.film, pressing, position(at), force, SolveSettings(accuracy=accuracy, theory=terms))
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
