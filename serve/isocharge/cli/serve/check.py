"""`isocharge serve check`: how wrong a model is on measured presses."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from isocharge.cli.shared.measured_presses import ForceStdOption, PositionStdOption, read_presses_of
from isocharge.cli.shared.options import JsonOption, ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import show, show_json
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.press_check import PressCheck, check_presses
from isocharge.serve.prediction.press_errors import ErrorSummary

MOST_ROWS = 40
"""Presses in the table for people; of more, the worst are shown."""


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
    """Say how wrong a model is on measured presses, and whether noise explains it.

    Exit code: 0 if the model fits, 1 if it does not or there are too few presses to say, 2 if the input is wrong.

    Example: isocharge serve check three-25um-biaxial presses.csv --position-std 0.05
    """
    predictor = Predictor(model, models=models)
    check = check_presses(predictor, read_presses_of(file, predictor.metadata.electrodes, position_std_mm, force_std))
    if json:
        show_json(check.to_dict())
    else:
        show("\n".join(_text(check)))
    raise typer.Exit(0 if check.fits else 1)


def _text(check: PressCheck) -> Iterator[str]:
    """The lines for people: presses, summary, common part, verdict, notes."""
    yield from _press_lines(check)
    yield ""
    yield f"{check.model}, {check.counted} of {check.presses} presses"
    yield f"{'error':14}{'rms':>9}{'median':>9}{'max':>9}{'noise':>9}{'rig':>9}{'beyond':>9}"
    yield from _summary_line("position, mm", check.position_mm)
    yield from _summary_line("force, %", check.force_percent)
    both = check.agreement
    if both.degrees:
        yield (
            f"chi-squared per degree of freedom {both.chi_squared / both.degrees:.3g} ({both.degrees}), "
            f"p value {both.p_value:.2g}"
        )
    if check.position_mm:
        yield (
            f"shift ({both.shift_x.mean:.3f} +- {both.shift_x.std:.3f}, "
            f"{both.shift_y.mean:.3f} +- {both.shift_y.std:.3f}) mm"
        )
    if check.force_percent:
        yield f"scale of the force {1.0 + both.force.mean:.4f} +- {both.force.std:.4f}"
    yield ""
    yield check.verdict
    yield from (f"- {note}" for note in check.notes)


def _press_lines(check: PressCheck) -> Iterator[str]:
    """A table of the presses; if they are many, of those with the largest errors."""
    squares = np.nansum(check.errors.error**2 / check.errors.variance, axis=1)
    chosen = sorted(np.argsort(-squares, kind="stable")[:MOST_ROWS].tolist())
    if check.presses > MOST_ROWS:
        yield f"the {MOST_ROWS} worst of {check.presses} presses; --json has all"
    yield f"{check.errors.row_noun:>6}{'x, mm':>9}{'y, mm':>9}{'force, N':>10}{'off, mm':>9}{'off, %':>9}  flags"
    for press in chosen:
        row = check.errors.row(press)
        cells = [(row["x_mm"], 9, 2), (row["y_mm"], 9, 2), (row["force_N"], 10, 3)]
        cells += [(row["position_error_mm"], 9, 3), (row["force_error_percent"], 9, 2)]
        words = [*row["flags"], *([row["left_out"]] if row["left_out"] else [])]
        numbers = "".join(
            f"{'-' if value != value else f'{value:.{digits}f}':>{width}}" for value, width, digits in cells
        )
        yield f"{row['line']:>6}{numbers}  {', '.join(words)}".rstrip()


def _summary_line(name: str, errors: ErrorSummary | None) -> Iterator[str]:
    if errors:
        values = (errors.rms, errors.median, errors.max, errors.noise, errors.rig, errors.beyond)
        yield f"{name:14}" + "".join(f"{value:9.3g}" for value in values)
