"""`isocharge train distil`: a model to a small student for microcontrollers."""

from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import simulated_presses
from isocharge.cli.shared.options import ConfigOption, FreshOption, JsonOption, ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import shown_progress
from isocharge.cli.train.fit import ModelFolderOption, VersionOption, release_resumably
from isocharge.common.errors import InputError
from isocharge.serve import find_model, load_model
from isocharge.serve.model.model_folder import check_target
from isocharge.train import StudentCase, fit, load_config, release, student_config, student_data
from isocharge.train.training.fit import fit_identity


def distil_command(
    model: ModelArgument,
    output: ModelFolderOption,
    int8: Annotated[
        bool,
        typer.Option("--int8", help="Round the weights between hidden layers to 8 bits. (default: 32-bit floats)"),
    ] = False,
    config: ConfigOption = None,
    models: ModelsOption = None,
    version: VersionOption = 1,
    fresh: FreshOption = False,
    json: JsonOption = False,
) -> None:
    """Train a small network on the answers of MODEL, for microcontrollers: some 5,000 weights and biases.

    It has the inputs and outputs of MODEL: contact, standard deviations and misfit. Presses within MODEL's working area
    and forces are simulated first. `isocharge train export-c` turns the student into C.

    A run that was stopped or killed leaves models/NAME/VERSION.part; the same command goes on from there and makes the
    same student.

    Example: isocharge train distil four-25um-biaxial -o models/four-25um-biaxial-student
    """
    if config and int8:
        raise InputError('--int8: expected no --config beside it; write weights = "int8" under [network] in the file')
    folder = find_model(model, models)
    settings = load_config(config) if config else student_config("int8" if int8 else "float32")
    case = StudentCase.of(load_model(folder).metadata)
    target = check_target(output, version, case.sensor.electrode_names)
    with shown_progress():
        presses = simulated_presses(case.sensor, case.probes, case.domain.radius, case.domain.force_range)
    data = student_data(folder, presses)
    identity = fit_identity(data, settings)
    release_resumably(lambda run: fit(data, settings, run=run), identity, target, release, fresh=fresh, json=json)
