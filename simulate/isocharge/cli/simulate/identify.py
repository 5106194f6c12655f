"""Command `isocharge simulate identify`, which computes error limits, folds and the working area of a sensor."""

import json as json_module
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import ProbeOption, executor_for
from isocharge.cli.shared.options import ForceRangeOption, JsonOption, NoiseOption, SensorArgument, WorkersOption
from isocharge.cli.shared.terminal import say, show_result, shown_progress
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.files import check_new_output, new_folder
from isocharge.simulate import identify, load_sensor, noise_model, parse_probe
from isocharge.simulate.plots.error_maps import identification_picture, mirror_picture
from isocharge.simulate.plots.figure import save_picture


def identify_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    noise: NoiseOption = "reference",
    error: Annotated[
        float,
        typer.Option(metavar="MM", min=1e-6, max=1e6, help="Largest position error in the working area, mm, rms."),
    ] = 1.0,
    radius: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Distance from the centre up to which presses are searched, mm. (default: distance of the outermost "
            "corner of an electrode)",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="New folder for pictures and numbers. (default: none)"),
    ] = None,
    workers: WorkersOption = None,
    json: JsonOption = False,
) -> None:
    """Compute how well the charges determine a press: error limits over the film, ambiguities and working area.

    The errors are Cramer-Rao limits, in mm for the position and in percent for the force. No unbiased method has
    smaller errors. The command also computes the mirror region, which lies outside the working area. A press in the
    mirror region has the same charges as another press inside the working area and is therefore mistaken for it.

    Example: isocharge simulate identify three-25um-biaxial --probe circle:1.0 --error 0.5 -o limits
    """
    if output is not None:
        check_new_output(output)
    described_sensor = load_sensor(sensor)
    parsed_probe = parse_probe(probe)
    noise_level = noise_model(noise)
    with shown_progress(), executor_for(workers) as pool:
        identification = identify(
            described_sensor, parsed_probe, noise_level, force_range=force, radius=radius, error=error, executor=pool
        )
    results = identification.to_dict()

    # Write the pictures and the results.
    if output is not None:
        with new_folder(output) as folder:
            save_picture(identification_picture(identification), folder / "identify.png")
            if identification.mirror is not None:
                save_picture(mirror_picture(described_sensor, identification.mirror), folder / "mirror.png")
            (folder / "identify.json").write_text(json_module.dumps(results, indent=1))

    # Print all results as JSON, or the main results as text. Print sentences about the working area on stderr.
    main_results = {"limits_in_working_area": results["limits_in_working_area"]}
    show_result(results if json else main_results, json=json)
    say(identification.area.summary)
    if identification.mirror is not None:
        say(identification.mirror.summary)
