"""`isocharge serve plot`: draw the charges, the position, the force and the flags of a recording over time."""

import math
from array import array
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure
from msgspec import defstruct

from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.arrays import Array
from isocharge.common.errors import RecordingError
from isocharge.serve import PredictionRecord, Recording
from isocharge.serve.flags import MEANINGS
from isocharge.simulate.plots.figure import INK, check_picture, new_figure, save_picture


def plot_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording of `isocharge serve stream --record`.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PICTURE", help="New picture to draw: .png, .svg or .pdf.")
    ],
) -> None:
    """Draw the charges (pC), the position (mm), the force (N) and the flags of a recording over time.

    The picture shows the records as they were written. No contacts are computed again.

    Example: isocharge serve plot touch.rec -o touch.png
    """
    check_picture(output)
    recording = Recording(file)
    with shown_progress():
        traces = traces_of(recording.records(PlottedRecord), str(file))
    save_picture(recording_picture(traces, f"{file.name}, {recording.model}"), output)
    say(f"drawn in {output}: {len(traces['timestamp'])} records")


NUMBERS = ("timestamp", "x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N")
"""Numbers of a record that are drawn."""

PlottedRecord = defstruct(
    "PlottedRecord",
    [(name, PredictionRecord.__annotations__[name]) for name in (*NUMBERS, "charge_pC", "charge_raw_pC", "flags")],
)
"""A record of a recording, reduced to the fields that are drawn. The types are those of `PredictionRecord`."""


def traces_of(records: Iterable[Any], where: str) -> dict[str, Array]:
    """Convert records to columns: one array for each number, each charge and each flag.

    The names of the electrodes are taken from the first record.

    Args:
        records: The n records.
        where: Name of the recording, for the error message.

    Returns:
        Columns by name, each of shape (n,), NaN for null: the numbers, the charges (pC) as `charge_pC.A`, and the flags
        (1 if the flag is set). Flags that no record has are left out.

    Raises:
        RecordingError: If there are no records.
    """
    columns: dict[str, array[float]] = {}
    for record in records:
        values = {name: getattr(record, name) for name in NUMBERS}
        charge_pC = record.charge_pC or {}
        values |= {f"charge_pC.{name}": charge_pC.get(name) for name in record.charge_raw_pC or ()}
        values |= {flag: flag in record.flags for flag in MEANINGS}
        columns = columns or {name: array("d") for name in values}
        for name, column in columns.items():
            value = values.get(name)
            column.append(math.nan if value is None else value)
    if not columns:
        raise RecordingError(f"{where}: expected at least one record, got none; replay or record it again")
    traces = {name: np.frombuffer(column) for name, column in columns.items()}
    return {name: trace for name, trace in traces.items() if name not in MEANINGS or trace.any()}


def recording_picture(traces: dict[str, Array], title: str) -> Figure:
    """Draw the picture of a recording. Each value is a point, so that a time without records remains empty.

    Args:
        traces: Columns of the records by name, as `traces_of` returns them.
        title: Names of the file and the model.
    """
    start_s = traces["timestamp"][0]
    time_s = traces["timestamp"] - start_s
    flags = [flag for flag in MEANINGS if flag in traces]
    flag_height = 0.1 * (1 + len(flags))  # grows with the number of rows of flags
    figure = new_figure(12.0, 8.6)
    figure.suptitle(f"{title}: {len(time_s)} records; faint points: ± 2 standard deviations")
    heights = (1.0, 1.0, 0.8, flag_height)
    *value_axes, flag_axes = figure.subplots(4, 1, sharex=True, height_ratios=heights)
    charge_axes, position_axes, force_axes = value_axes

    for name, charge_pC in traces.items():
        if name.startswith("charge_pC."):
            charge_axes.plot(time_s, charge_pC, ".", ms=2.0, label=name.removeprefix("charge_pC."))
    for quantity, unit, axes in (("x", "mm", position_axes), ("y", "mm", position_axes), ("force", "N", force_axes)):
        values = traces[f"{quantity}_{unit}"]
        two_std = 2.0 * traces[f"{quantity}_std_{unit}"]
        (points,) = axes.plot(time_s, values, ".", ms=2.0, label=quantity)
        for limit in (values - two_std, values + two_std):
            axes.plot(time_s, limit, ".", ms=1.0, alpha=0.3, color=points.get_color())
    for row, flag in enumerate(flags):
        flag_time_s = time_s[traces[flag] > 0.0]
        flag_axes.plot(flag_time_s, np.full(len(flag_time_s), row), "|", color=INK)

    flag_axes.set(yticks=range(len(flags)), yticklabels=flags, ylim=(-0.7, max(len(flags), 1) - 0.3))
    flag_axes.set_xlabel(f"time since {datetime.fromtimestamp(start_s, UTC):%Y-%m-%d %H:%M:%S} UTC, s")
    for axes, label in zip(value_axes, ("touch charge, pC", "position, mm", "force, N"), strict=True):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper right", fontsize=8, ncols=8, markerscale=4.0)
    return figure
