"""`isocharge train calibrate`: calibrate a film with measured presses, and write a model of this film."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import ProbeOption, executor_for
from isocharge.cli.shared.options import (
    EarlierOption,
    ForceRangeOption,
    ForceStdOption,
    JsonOption,
    MapRadiusOption,
    PositionStdOption,
    SensorOption,
    StressLimitOption,
)
from isocharge.cli.shared.terminal import say, show, show_json, show_result, shown_progress, this_command
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS, DEFAULT_STRESS_LIMIT
from isocharge.common.errors import InputError
from isocharge.serve.model.model_folder import load_model
from isocharge.serve.presses.measured_presses import read_presses
from isocharge.serve.presses.std_factor import StdFactor
from isocharge.simulate import load_sensor, parse_probe
from isocharge.train import CalibrationProblem, calibrate, next_presses
from isocharge.train.calibration.calibrate import solve_even
from isocharge.train.calibration.folder import (
    check_calibration_folder,
    read_earlier,
    result_table,
    usable_held_out,
    write_calibration,
)


def calibrate_command(
    sensor: SensorOption,
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="PRESSES.csv",
            help="Measured presses: x_mm, y_mm, force_N and the electrodes' names (pC) in the header; an empty cell is "
            "unknown. (default: none, with --next)",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Folder for sensor.toml, calibration.json, card.md and the model; each calibration in it is a new "
            "version. (default: print only)",
        ),
    ] = None,
    probe: ProbeOption = "circle:1.0",
    radius: MapRadiusOption = DEFAULT_RADIUS,
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    charge_std_pC: Annotated[
        float,
        typer.Option(
            "--charge-std",
            metavar="PC",
            min=1e-3,
            help="Standard deviation of the charges of a frame at rest, pC; noise_pC of `isocharge serve doctor`.",
        ),
    ] = 1.0,
    next_count: Annotated[
        int,
        typer.Option(
            "--next", metavar="K", min=0, max=100, help="Propose the K presses that reduce the remaining error most."
        ),
    ] = 0,
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    earlier: EarlierOption = None,
    held_out: Annotated[
        Path | None,
        typer.Option(
            metavar="PRESSES.csv",
            help="22 or more presses that are not used for the calibration. The standard deviations of the model are "
            "multiplied by a factor with which its 95 % regions hold for such presses. (default: no factor)",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Calibrate a film: estimate its properties from measured presses, and write a model of this film.

    The film that explains the presses is solved, and a network is trained for it. Any sensor and any probe is possible.
    Three presses are useful, and eight are recommended. For each press, the position or the force must be known, or
    both. The option --next proposes presses, even before the first press. The command names the properties that the
    presses do not determine.

    The command `isocharge train press` records presses at a port, and writes PRESSES.csv.

    Example: isocharge train calibrate presses.csv --sensor four-25um-biaxial -o my-film
    """
    # Check the combination of the options.
    if held_out is not None and output is None:
        raise InputError("--held-out: expected --output FOLDER for the model whose standard deviations it changes")
    if file is None and not next_count:
        raise InputError(
            "expected PRESSES.csv, or --next K for presses to begin with, got neither; `isocharge train press` takes "
            "presses at a port"
        )
    if file is None and output is not None:
        raise InputError("--output: nothing is calibrated without PRESSES.csv; give presses, or leave --output out")
    noise = replace(CalibrationProblem.noise, white=charge_std_pC)
    problem = CalibrationProblem(
        load_sensor(sensor), parse_probe(probe), radius, force, stress_limit=stress_limit, noise=noise
    )
    if output is not None:
        check_calibration_folder(output, problem.electrodes)

    fields: dict[str, Any] = {}  # of the JSON object
    sentences: list[str] = []
    rows: list[dict[str, Any]] = []  # proposed presses, each with the errors that would remain after it
    with (
        shown_progress(),
        executor_for() as executor,
    ):
        # Read all files before anything is solved.
        read = partial(
            read_presses, electrodes=problem.electrodes, position_std_mm=position_std_mm, force_std=force_std
        )
        presses = read(file) if file else None
        held_out_presses = read(held_out) if held_out else None
        if earlier is not None:
            problem = replace(problem, earlier=read_earlier(earlier, problem, presses, held_out_presses))
        if presses is not None and held_out_presses is not None:
            held_out_presses = usable_held_out(held_out_presses, presses, problem, problem.domain)

        # Calibrate the film. Without presses, the next presses are chosen for the mean film.
        if presses is None:
            charges = solve_even(problem, executor)
            film = problem.film_before
        else:
            say(f"fitting the film to {len(presses)} presses")
            result = calibrate(presses, problem, executor=executor)
            for caution in result.cautions:
                say(f"caution: {caution}")
            charges = result.charges
            film = result.film
            fields |= result_table(result)
            sentences += result.summary
            if output is not None:
                say("training the network of this film")
                version = write_calibration(
                    result, output, this_command(), held_out=held_out_presses, executor=executor
                )
                say(f"{version}: sensor.toml, calibration.json, card.md, model.onnx")
                if held_out_presses is not None:
                    std_factor = StdFactor(**load_model(version).metadata.made_with["std_factor"])
                    fields["std_factor"] = std_factor.factor
                    sentences.append(f"Held-out presses: {std_factor.statement}.")
        if next_count:
            proposed = next_presses(
                problem, charges, next_count, film, position_std_mm=position_std_mm, force_std=force_std
            )
            rows += map(vars, proposed)

    if json:
        show_json(fields | {"next": rows})
        return
    if sentences:
        show("\n".join(sentences))
    if rows:
        show_result({"next": rows})
