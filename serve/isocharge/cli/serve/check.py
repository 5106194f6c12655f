"""`isocharge serve check`: comparison of a model with measured presses."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from isocharge.cli.shared.options import JsonOption, ModelArgument, ModelsOption
from isocharge.cli.shared.press_options import ForceStdOption, PositionStdOption, read_press_file
from isocharge.cli.shared.terminal import show, show_json
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.prediction.press_check import PressCheck, check_presses
from isocharge.serve.prediction.press_errors import ErrorSummary

MAX_ROWS = 40
"""Largest number of presses in the table. If there are more, the presses with the largest errors are listed."""


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
    check = check_presses(predictor, read_press_file(file, predictor.metadata.electrodes, position_std_mm, force_std))
    if json:
        show_json(check.to_dict())
    else:
        show("\n".join(_report_lines(check)))
    raise typer.Exit(0 if check.fits else 1)


def _report_lines(check: PressCheck) -> Iterator[str]:
    """Yield the lines of the report: presses, summary of the errors, statistical tests, verdict and notes.

    The summary contains the errors, and the parts of the errors that are explained by the noise of the charges and by
    the uncertainty of the rig. The column `beyond` is the part of the errors that neither the noise nor the rig
    explains.

    Args:
        check: Result of the comparison.
    """
    yield from _press_lines(check)
    yield ""
    yield f"{check.model}, {check.compared} of {check.presses} presses"
    yield f"{'error':14}{'rms':>9}{'median':>9}{'max':>9}{'noise':>9}{'rig':>9}{'beyond':>9}"
    yield from _summary_line("position, mm", check.position_mm)
    yield from _summary_line("force, %", check.force_percent)

    # Statistical tests of whether the noise and the rig explain the errors. Without measured positions or forces, there
    # are no errors.
    agreement = check.agreement
    if agreement.degrees > 0:
        reduced_chi_squared = agreement.chi_squared / agreement.degrees
        yield (
            f"chi-squared per degree of freedom {reduced_chi_squared:.3g} ({agreement.degrees}), "
            f"p value {agreement.p_value:.2g}"
        )
    if check.position_mm is not None:
        shift_x = agreement.shift_x
        shift_y = agreement.shift_y
        yield f"shift ({shift_x.mean:.3f} +- {shift_x.std:.3f}, {shift_y.mean:.3f} +- {shift_y.std:.3f}) mm"
    if check.force_percent is not None:
        relative_error = agreement.force  # common to all forces
        yield f"scale of the force {1.0 + relative_error.mean:.4f} +- {relative_error.std:.4f}"

    yield ""
    yield check.verdict
    if check.std_factor is not None:
        yield check.std_factor.statement
    yield from (f"- {note}" for note in check.notes)


def _press_lines(check: PressCheck) -> Iterator[str]:
    """Yield the lines of a table of the `MAX_ROWS` presses with the largest errors, in the order of the file."""
    squared_ratio = check.errors.squared_ratio  # squared errors of x, y and F over their variances, shape (n, 3)
    chi_squared = np.nansum(squared_ratio, axis=1)  # shape (n,); an unknown error is NaN and does not count
    worst_indices = np.argsort(-chi_squared, kind="stable")[:MAX_ROWS]
    if check.presses > MAX_ROWS:
        yield f"the {MAX_ROWS} worst of {check.presses} presses; --json has all"
    yield f"{check.errors.row_noun:>6}{'x, mm':>9}{'y, mm':>9}{'force, N':>10}{'off, mm':>9}{'off, %':>9}  flags"
    for press_index in sorted(worst_indices.tolist()):  # in the order of the file
        yield _press_line(check.errors.row(press_index))


def _press_line(row: dict[str, Any]) -> str:
    """Format the values of `PressErrors.row` as the line of one press.

    The line contains the place of the press in the file, the estimated x, y and force, their errors, the flags and, if
    the press is left out of the comparison, the reason.
    """
    numbers = [
        _number_cell(row["x_mm"], width=9, decimals=2),
        _number_cell(row["y_mm"], width=9, decimals=2),
        _number_cell(row["force_N"], width=10, decimals=3),
        _number_cell(row["position_error_mm"], width=9, decimals=3),
        _number_cell(row["force_error_percent"], width=9, decimals=2),
    ]
    notes = list(row["flags"])
    if row["left_out"]:  # the reason why the press is left out
        notes.append(row["left_out"])
    return f"{row['line']:>6}{''.join(numbers)}  {', '.join(notes)}".rstrip()


def _number_cell(value: float, width: int, decimals: int) -> str:
    """Format a number, aligned to the right in a cell of the given width. NaN is formatted as a dash."""
    text = "-" if math.isnan(value) else f"{value:.{decimals}f}"
    return text.rjust(width)


def _summary_line(name: str, errors: ErrorSummary | None) -> Iterator[str]:
    """Yield the line of the summary for one kind of error, or nothing if there are no errors of this kind."""
    if errors is not None:
        values = (errors.rms, errors.median, errors.max, errors.noise, errors.rig, errors.beyond)
        yield f"{name:14}" + "".join(f"{value:9.3g}" for value in values)
