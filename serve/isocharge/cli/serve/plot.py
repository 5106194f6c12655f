"""`isocharge serve plot`: a recording as one picture.

The path on the film, and position, force, charges and flags over time.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import numpy as np
import typer
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from msgspec import defstruct

from isocharge.cli.shared.options import ModelsOption
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import InputError, RecordingError
from isocharge.serve import PredictionRecord, Recording, find_labelled_model, find_model, load_model
from isocharge.serve.flags import BLIND, INVALID, MEANINGS, MISFIT, OUTSIDE, SATURATED
from isocharge.simulate import Sensor
from isocharge.simulate.plots.figure import FELT, INK, check_picture, new_figure, save_picture
from isocharge.simulate.plots.film import draw_electrodes
from isocharge.simulate.sensor.sensor_file import sensor_from_dict

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours that eyes of every kind tell apart (Okabe and Ito 2008)."""

MOST_GROUPS = 4000
"""Records, or groups of neighbours, that are drawn: two for each pixel of a wide picture."""

MOST_POINTS, MOST_ELLIPSES = 20_000, 60
"""Contacts that are drawn on the film, and those of them with an ellipse."""

LEAST_BREAK = 1.0
"""Time without a record, s, from which nothing is drawn across it, if it is also longer than five groups."""

UNITS = ((7200.0, 3600.0, "h"), (600.0, 60.0, "min"), (0.0, 1.0, "s"))
"""From which length, s, a unit of time is used, and its seconds."""

DOUBTS = (OUTSIDE, MISFIT, SATURATED, BLIND, INVALID)
"""Flags of a contact that is not to be taken as it stands."""


def plot_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Recording of `isocharge serve stream --record`.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PICTURE", help="New picture to draw: .png, .svg or .pdf.")
    ],
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Model that describes the film, name or path. (default: that of the recording)",
        ),
    ] = None,
    models: ModelsOption = None,
) -> None:
    """Draw a recording: the path on the film (mm), position, force (N) and charges (pC) over time, flags.

    It shows the records as they were written; no model computes anything.

    Example: isocharge serve plot touch.rec -o touch.png
    """
    check_picture(output)
    recording = Recording(file)
    with shown_progress():
        traces = traces_of(recording.records(PlottedRecord), str(file))
    sensor = working_area = None
    try:
        folder = find_model(model, models) if model else find_labelled_model(recording.model, models)
        metadata = load_model(folder).metadata
        working_area = np.array(metadata.working_area_mm)
        sensor = sensor_from_dict(metadata.sensor, metadata.label)
    except InputError as error:
        missing = "the film, whose model is not to be had" if working_area is None else "electrodes"
        say(f"drawn without {missing}: {error}")
    save_picture(recording_picture(traces, sensor, working_area, f"{file.name}, {recording.model}"), output)
    say(f"drawn in {output}: {len(traces['timestamp'])} records")


NUMBERS = ("timestamp", "x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N")
"""Numbers of a record that are drawn."""

PlottedRecord = defstruct(
    "PlottedRecord",
    [(name, PredictionRecord.__annotations__[name]) for name in (*NUMBERS, "charge_pC", "charge_raw_pC", "flags")],
)
"""A record that is read from a recording: only the fields that are drawn, with the types of the record."""


def traces_of(records: Iterator[Any], where: str) -> dict[str, Array]:
    """Columns of n records, each of shape (n,), NaN for null.

    Numbers and flags (1 where one is set) by their names in a record, charges (pC) as `charge_pC.A`; flags that are
    never set are left out.

    Raises:
        RecordingError: If there is no record.
    """
    first = next(records, None)
    if first is None:
        raise RecordingError(f"{where}: expected at least one record, got none; replay or record it again")
    electrodes = tuple(first.charge_raw_pC or ())

    def row(record: Any) -> tuple[Any, ...]:
        numbers = (getattr(record, name) for name in NUMBERS)
        charges = record.charge_pC or {}
        return *numbers, *(charges.get(name) for name in electrodes), *(word in record.flags for word in MEANINGS)

    names = [*NUMBERS, *(f"charge_pC.{name}" for name in electrodes), *MEANINGS]
    rows = np.fromiter(map(row, chain([first], records)), np.dtype((float, len(names))))
    return {name: column for name, column in zip(names, rows.T, strict=True) if name not in MEANINGS or column.any()}


class _Groups(NamedTuple):
    """Neighbouring records that are drawn as one: their `start`, `first` and `last` times, and where to `break_`."""

    start: Integers
    first: Array
    last: Array
    break_: Integers

    @classmethod
    def of(cls, time: Array, seconds: float) -> "_Groups":
        start = np.arange(0, len(time), -(-len(time) // MOST_GROUPS))
        first, last = time[start], time[np.append(start[1:], len(time)) - 1]
        usual = float(np.median(np.diff(first))) if len(first) > 1 else 0.0
        break_ = np.flatnonzero(first[1:] - last[:-1] > max(LEAST_BREAK, 5.0 * usual)) + 1
        return cls(start, first / seconds, last / seconds, break_)

    def draw(self, axes: Any, low: Array, high: Array, **style: Any) -> None:
        """The band between two columns, from the smallest to the largest of each group: a line where they are one."""
        low, high = np.fmin.reduceat(low, self.start), np.fmax.reduceat(high, self.start)
        axes.fill_between(*(np.insert(values, self.break_, np.nan) for values in (self.first, low, high)), **style)


def recording_picture(
    traces: dict[str, Array], sensor: Sensor | None, working_area: Array | None, title: str
) -> Figure:
    """The picture of a recording.

    Args:
        traces: Its columns, see `traces_of`.
        sensor: The film; None if it is not known.
        working_area: Corners, shape (n, 2), mm.
        title: Name of file and model.
    """
    begin, time = traces["timestamp"][0], traces["timestamp"] - traces["timestamp"][0]
    seconds, unit = next((seconds, name) for least, seconds, name in UNITS if time[-1] >= least)
    groups, figure = _Groups.of(time, seconds), new_figure(15.0, 8.6)
    words = [word for word in MEANINGS if word in traces]
    film, times = cast(np.ndarray, figure.subfigures(1, 2, width_ratios=(1.0, 1.35)))
    heights = (1.0, 0.8, 1.0, 0.09 * max(1, len(words)) + 0.05)
    position, force, charge, flags = times.subplots(4, 1, sharex=True, height_ratios=heights)
    for axes, name, colour in ((position, "x_mm", COLOURS[0]), (position, "y_mm", COLOURS[1]), (force, "force_N", INK)):
        values, spread = traces[name], 2.0 * traces[name.replace("_", "_std_")]
        groups.draw(axes, values - spread, values + spread, color=colour, alpha=0.25, lw=0.0)
        groups.draw(axes, values, values, color=colour, lw=1.1, label=name.partition("_")[0])
    for number, name in enumerate(name for name in traces if name.startswith("charge_pC.")):
        colour = COLOURS[number % len(COLOURS)]
        groups.draw(charge, traces[name], traces[name], color=colour, lw=1.1, label=name.partition(".")[2])
    least = 2e-3 * max(float(groups.last[-1]), 1e-9)  # a single frame still is a visible mark
    for height, word in enumerate(words):
        inside = np.maximum.reduceat(traces[word], groups.start) > 0.0
        lengths = np.maximum(groups.last - groups.first, least)[inside]
        flags.broken_barh(np.column_stack([groups.first[inside], lengths]), (height - 0.35, 0.7), color=INK)
    flags.set(yticks=range(len(words)), yticklabels=words)
    labels = ("position, mm; bands: 2 standard deviations", "force, N", "touch charge, pC")
    for axes, label in zip((position, force, charge), labels, strict=True):
        axes.set_ylabel(label, fontsize=9)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8, ncols=8)
    flags.set_xlabel(f"time since {datetime.fromtimestamp(begin, UTC):%Y-%m-%d %H:%M:%S} UTC, {unit}")
    figure.suptitle(f"{title}: {len(time)} records in {time[-1] / seconds:.4g} {unit}")
    axes = film.subplots()
    if working_area is not None:
        axes.add_patch(Polygon(working_area, fill=False, ls=":", ec=INK, lw=1.2))
    if sensor is not None:
        draw_electrodes(axes, sensor)
    _draw_path(axes, traces, time / seconds, f"time, {unit}")
    return figure


def _draw_path(axes: Any, traces: dict[str, Array], time: Array, label: str) -> None:
    """The path on the film, to scale: a line for each press, colour the time, dots that grow with the force."""
    place = np.column_stack([traces["x_mm"], traces["y_mm"]])
    at = np.flatnonzero(~np.isnan(place[:, 0]))
    at = at[:: -(-len(at) // MOST_POINTS) or 1]
    if len(at):
        axes.plot(*place[:: -(-len(place) // MOST_POINTS)].T, color=INK, lw=0.5, alpha=0.5)  # NaN parts the presses
        force = np.clip(traces["force_N"][at], 0.0, None)
        size = 3.0 + 30.0 * force / max(float(force.max()), 1e-9)
        marks = axes.scatter(*place[at].T, c=time[at], s=size, lw=0.0, alpha=0.8, zorder=4)
        few = at[:: -(-len(at) // MOST_ELLIPSES)]
        axes.add_collection(
            EllipseCollection(
                4.0 * traces["x_std_mm"][few], 4.0 * traces["y_std_mm"][few], np.zeros(len(few)), units="xy",
                offsets=place[few], offset_transform=axes.transData, facecolors="none", edgecolors=INK, lw=0.6,
                alpha=0.6, zorder=6,
            )
        )  # fmt: skip
        doubtful = at[sum((traces[word][at] for word in DOUBTS if word in traces), np.zeros(len(at))) > 0.0]
        axes.scatter(*place[doubtful].T, c=FELT, marker="x", s=24, lw=0.9, zorder=5)
        axes.figure.colorbar(marks, ax=axes, shrink=0.6, label=label, location="bottom", pad=0.02)
    else:
        axes.text(0.5, 0.5, "nothing touched the film", transform=axes.transAxes, ha="center", color=INK)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes.margins(0.08)
    axes.autoscale_view()
    axes.set_title("path; ring: ± 2 standard deviations, cross: in doubt (see flags)", fontsize=9)
    axes.grid(alpha=0.2)
