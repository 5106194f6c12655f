"""`isocharge serve check`: comparison of a model with measured presses."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from isocharge.cli.shared.options import ForceStdOption, JsonOption, ModelArgument, ModelsOption, PositionStdOption
from isocharge.cli.shared.terminal import say, show_result
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.prediction.press_check import check_presses
from isocharge.serve.presses.measured_presses import read_presses

MAX_ROWS = 40
"""Largest number of presses in the table. If there are more, the presses with the largest errors are listed."""

SHOWN = ("line", "x_mm", "y_mm", "force_N", "position_error_mm", "force_error_percent", "flags", "left_out")
"""Values of a press in the table."""


def check_command(
    model: ModelArgument,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="PRESSES.csv",
            help="CSV file of measured presses: x_mm, y_mm, force_N and the electrodes' names (pC) in the header; an "
            "empty cell is unknown. position_std_mm and force_std (share) may be columns, too.",
        ),
    ],
    position_std_mm: PositionStdOption = 0.1,
    force_std: ForceStdOption = 0.01,
    json: JsonOption = False,
    models: ModelsOption = None,
) -> None:
    """Compare a model with measured presses, and test whether noise explains the errors of the model.

    The exit code is 0 if the model fits the presses, 1 if the model does not fit or there are too few presses, and 2 if
    the input is wrong.

    Example: isocharge serve check three-25um-biaxial presses.csv --position-std 0.05
    """
    predictor = Predictor(model, models=models)
    presses = read_presses(file, predictor.metadata.electrodes, position_std_mm=position_std_mm, force_std=force_std)
    check = check_presses(predictor, presses)
    result = check.to_dict()
    if not json:
        # For people, print two tables before the other values: a short table of the presses ("each"), and a table of
        # the errors of the positions and of the forces ("errors").
        press_rows = result.pop("each")
        summaries = {name: result.pop(name) for name in ("position_mm", "force_percent")}
        known_summaries = {name: summary for name, summary in summaries.items() if summary is not None}
        # The short table contains the presses with the largest errors, in the order of the file. Its columns are SHOWN.
        worst_indices = np.argsort(-check.errors.chi_squared, kind="stable")[:MAX_ROWS]
        if check.presses > MAX_ROWS:
            say(f"the table has the {MAX_ROWS} worst of {check.presses} presses; --json has all")
        shown_rows = [{name: press_rows[index][name] for name in SHOWN} for index in sorted(worst_indices)]
        result = {"each": shown_rows, "errors": known_summaries} | result
        if check.std_factor is not None:
            result["std_factor"] = f"{check.std_factor.statement}, if they were not used for the model"
    show_result(result, json=json)
    raise typer.Exit(0 if check.fits else 1)
