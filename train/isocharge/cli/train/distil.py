"""`isocharge train distil`: train a small network for microcontrollers on the answers of a model."""

from functools import partial
from typing import Annotated, Literal

import typer

from isocharge.cli.shared.forward_maps import simulated_presses
from isocharge.cli.shared.options import ConfigOption, JsonOption, ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import shown_progress
from isocharge.cli.train.train_and_release import (
    ModelFolderOption,
    VersionOption,
    train_and_release,
)
from isocharge.common.errors import InputError
from isocharge.serve import find_model, load_model
from isocharge.serve.model.model_folder import check_target
from isocharge.train import StudentCase, fit, load_config, student_config, student_data


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
    json: JsonOption = False,
) -> None:
    """Train a small network for microcontrollers, with about 5,000 weights and biases, on the answers of MODEL.

    The small network, called the student, has the inputs and outputs of MODEL: contact, standard deviations and misfit.
    The student is trained on simulated presses within the working area and the range of forces of MODEL. The command
    `isocharge train export-c` writes the student as C source.

    Example: isocharge train distil four-25um-biaxial -o models/four-25um-biaxial-student
    """
    if config is not None and int8:
        raise InputError(
            f'--int8: expected no --config beside it, got {config}; write weights = "int8" under [network] in this '
            "file instead"
        )
    model_folder = find_model(model, models)  # MODEL, which is the teacher of the student
    weights: Literal["int8", "float32"] = "int8" if int8 else "float32"
    fit_config = load_config(config) if config is not None else student_config(weights)

    case = StudentCase.of(load_model(model_folder).metadata)
    version_folder = check_target(output, version, case.sensor.electrode_names)  # raises before the long computation

    # The student is trained on simulated presses and the contacts that the teacher estimates for them.
    with shown_progress():
        presses = simulated_presses(case.sensor, case.probes, case.domain.radius, case.domain.force_range)
    data = student_data(model_folder, presses)
    train_and_release(partial(fit, data, fit_config), version_folder, json=json)
