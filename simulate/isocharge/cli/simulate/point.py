"""Command `isocharge simulate point`, which computes the charges and the deflection of one press."""

from dataclasses import replace
from functools import partial
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import ProbeOption
from isocharge.cli.shared.options import (
    ForceOption,
    JsonOption,
    SensorArgument,
    parse_pair,
)
from isocharge.cli.shared.terminal import say, show_result
from isocharge.common.errors import InputError
from isocharge.simulate import (
    SolveSettings,
    load_sensor,
    parse_probe,
    press,
    touch_charge,
)
from isocharge.simulate.forward.readout import stress_charge, thermal_charge
from isocharge.simulate.mechanics.theory import theory_by_name
from isocharge.simulate.mechanics.warming import warmed, warming_limits
from isocharge.simulate.sensor.film import check_range
from isocharge.simulate.solver.error_estimate import summary
from isocharge.simulate.solver.sensitivity import friction_force


def point_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
    at: Annotated[str, typer.Option(metavar="X,Y", help="Position of the probe, mm from the film's centre.")] = "0,0",
    force: ForceOption = 1.0,
    accuracy: Annotated[
        float,
        typer.Option(min=1e-6, max=1.0, help="Allowed relative error of the charges. It determines the mesh."),
    ] = 1e-3,
    theory: Annotated[
        str,
        typer.Option(
            help="'nonlinear membrane' omits the resistance of the film to bending.",
        ),
    ] = "nonlinear membrane + bending",
    temperature: Annotated[
        float,
        typer.Option(
            metavar="K",
            help="Temperature step of the film, K. Its charge is added. It changes the pretension if the sensor file "
            "has expansion coefficients.",
        ),
    ] = 0.0,
    side_force: Annotated[
        str, typer.Option(metavar="FX,FY", help="Force of the probe on the film along x and y, N.")
    ] = "0,0",
    friction: Annotated[
        float,
        typer.Option(
            metavar="MU", help="Coefficient of friction of a probe on a vertical stage, which gives the side force."
        ),
    ] = 0.0,
    json: JsonOption = False,
) -> None:
    """Compute the charge of every electrode (pC) and the deflection of the film (mm) under one press.

    Example: isocharge simulate point three-25um-biaxial --probe triangle:4.0@30 --at 3,-2 --force 1.0
    """
    # Check and read the options.
    unwarmed_sensor = load_sensor(sensor)
    temperature_meaning = "--temperature (give the change from the temperature at which the sensor file holds)"
    check_range(temperature_meaning, temperature, warming_limits(unwarmed_sensor.film), "K", InputError)
    film_sensor = warmed(unwarmed_sensor, temperature)
    footprint = parse_probe(probe)

    applied_side_force = parse_pair(side_force, "--side-force: expected two numbers in N like '0.1,0'")
    if any(applied_side_force) and friction:
        raise InputError("--side-force and --friction: expected one of them, because friction gives the side force")

    # Solve the press.
    settings = SolveSettings(accuracy=accuracy, theory=theory_by_name(theory))
    film = film_sensor.film
    position = parse_pair(at, "--at: expected two numbers in mm like '3,-2'")
    equilibrium = press(film, footprint, position, force, settings, side_force=applied_side_force)
    if friction:
        # The friction force follows from the slope of the film in the press without a side force.
        applied_side_force = friction_force(equilibrium, friction)
        equilibrium = press(film, footprint, position, force, settings, side_force=applied_side_force)

    # Charges are relative to the film before the contact and the warming. A static pressure also stretches this film.
    rest = equilibrium.rest
    if temperature and film.static_pressure:
        rest = press(unwarmed_sensor.film, footprint, position, force, settings).rest

    # Collect the results.
    warming_charge = thermal_charge(film_sensor, temperature)
    charge = touch_charge(film_sensor, replace(equilibrium, rest=rest)) + warming_charge
    charge_pC = dict(zip(film_sensor.electrode_names, charge.tolist(), strict=True))
    results = {"charge_pC": charge_pC, **summary(equilibrium, partial(stress_charge, film_sensor))}
    if any(applied_side_force):
        results["side_force_N"] = list(applied_side_force)

    # Add warnings about the options to the warnings about the press.
    warnings = results["warnings"]
    error = results["estimated_error"]
    if error is None:  # infinite
        warnings.append(f"a {theory} does not describe this film at all; omit --theory")
    elif error > accuracy:
        warnings.append(f"expected an error of the charges of at most {accuracy:.2g} (--accuracy), got {error:.2g}")
    if temperature and not warming_charge.any():
        warnings.append(
            "--temperature changes no charge, because the sensor file has neither pyro_uC_per_m2_K nor "
            "expansion_ppm_per_K"
        )
    if not json:
        del results["warnings"]  # the sentences below contain them
    show_result(results, json=json)
    for warning in warnings:
        say(f"caution: {warning}")
