"""`isocharge train distil`: a model to a small student for microcontrollers."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.measured_presses import ModelsOption
from isocharge.cli.shared.options import ConfigOption, FreshOption, ModelArgument
from isocharge.cli.shared.simulated_presses import simulated_presses
from isocharge.cli.shared.training_run import train_and_say
from isocharge.common.errors import InputError
from isocharge.common.files import refuse_existing


def distil_command(
    model: ModelArgument,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="models/NAME", help="The student's folder; its name becomes its name."),
    ],
    int8: Annotated[
        bool,
        typer.Option("--int8", help="Round the weights between hidden layers to 8 bits. (default: 32-bit floats)"),
    ] = False,
    config: ConfigOption = None,
    models: ModelsOption = None,
    version: Annotated[int, typer.Option("--version", min=1, help="Version of the student: the folder in NAME.")] = 1,
    fresh: FreshOption = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the folder and the measured errors as one JSON object. (default: no)")
    ] = False,
) -> None:
    """Train a small network on the answers of MODEL, for microcontrollers: at most 6,000 weights and biases.

    It has the inputs and outputs of MODEL: contact, standard deviations and misfit. Presses within MODEL's working area
    and forces are simulated first. `isocharge train export-c` turns the student into C.

    A run that was stopped or killed leaves models/NAME/VERSION.part; the same command goes on from there and makes the
    same student.

    Example: isocharge train distil four-25um-biaxial -o models/four-25um-biaxial-student
    """
    from isocharge.serve import find_model, load_model
    from isocharge.train import TaughtScene, distil_model, load_config, student_config

    if config and int8:
        raise InputError('--int8: expected no --config beside it; write weights = "int8" under [network] in the file')
    folder = find_model(model, models)
    refuse_existing(output / str(version))
    settings = load_config(config) if config else student_config("int8" if int8 else "float32")
    scene = TaughtScene.of(load_model(folder).metadata)
    presses = simulated_presses(scene.sensor, scene.probes, 1e-3 * scene.domain.radius_mm, scene.domain.force_range_N)
    student = partial(distil_model, folder, presses, config=settings)
    train_and_say(student, output, version, fresh=fresh, json=json)
