"""`isocharge serve plot`: draw a recording.

The picture shows the path on the film, and the position, force, charges and flags over time.
"""

import math
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
"""Colours that people with colour vision deficiency can distinguish (Okabe and Ito 2008)."""

MAX_GROUPS = 4000
"""Largest number of groups of neighbouring records that are drawn: two for each pixel of a wide picture."""

MAX_POINTS = 20_000
"""Largest number of contacts that are drawn on the film."""

MAX_ELLIPSES = 60
"""Largest number of contacts that are drawn with an ellipse of the standard deviations."""

MIN_GAP_S = 1.0
"""Shortest time without a record at which a line is interrupted, s."""

MIN_GAP_GROUPS = 5.0
"""Shortest time without a record at which a line is interrupted, relative to the usual length of a group."""

TIME_UNITS = ((7200.0, 3600.0, "h"), (600.0, 60.0, "min"), (0.0, 1.0, "s"))
"""Units of the time axis: shortest duration of a recording, s, length of the unit, s, and symbol."""

DOUBTFUL_FLAGS = (OUTSIDE, MISFIT, SATURATED, BLIND, INVALID)
"""Flags of contacts that may be wrong."""


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
    """Draw a recording: the path on the film (mm), and position, force (N), charges (pC) and flags over time.

    The picture shows the records as they were written. No contacts are computed again.

    Example: isocharge serve plot touch.rec -o touch.png
    """
    check_picture(output)
    recording = Recording(file)
    with shown_progress():
        traces = traces_of(recording.records(PlottedRecord), str(file))

    # Read the description of the film. What cannot be read is omitted from the picture.
    sensor = None
    working_area = None
    try:
        folder = find_model(model, models) if model else find_labelled_model(recording.model, models)
        metadata = load_model(folder).metadata
        working_area = np.array(metadata.working_area_mm)
        sensor = sensor_from_dict(metadata.sensor, metadata.label)
    except InputError as error:
        # If the working area is known, only the description of the electrodes was wrong.
        omitted = "the film, whose model is not available" if working_area is None else "electrodes"
        say(f"drawn without {omitted}: {error}")
    title = f"{file.name}, {recording.model}"
    picture = recording_picture(traces, sensor, working_area, title)
    save_picture(picture, output)
    say(f"drawn in {output}: {len(traces['timestamp'])} records")


NUMBERS = ("timestamp", "x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N")
"""Numbers of a record that are drawn."""

PlottedRecord = defstruct(
    "PlottedRecord",
    [(name, PredictionRecord.__annotations__[name]) for name in (*NUMBERS, "charge_pC", "charge_raw_pC", "flags")],
)
"""A record of a recording, reduced to the fields that are drawn. The types are those of `PredictionRecord`."""


def traces_of(records: Iterator[Any], where: str) -> dict[str, Array]:
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
    first = next(records, None)
    if first is None:
        raise RecordingError(f"{where}: expected at least one record, got none; replay or record it again")
    electrodes = tuple(first.charge_raw_pC or ())
    charge_names = [f"charge_pC.{electrode}" for electrode in electrodes]
    names = [*NUMBERS, *charge_names, *MEANINGS]  # MEANINGS contains all flags

    all_records = chain([first], records)
    row_type = np.dtype((float, len(names)))  # None in a row becomes NaN
    rows = np.fromiter((_record_values(record, electrodes) for record in all_records), row_type)  # shape (n, n_column)
    columns = dict(zip(names, rows.T, strict=True))
    unused_flags = [flag for flag in MEANINGS if not columns[flag].any()]
    return {name: column for name, column in columns.items() if name not in unused_flags}


def _record_values(record: Any, electrodes: tuple[str, ...]) -> tuple[Any, ...]:
    """Return the numbers of a record, the charge of each electrode, and whether each flag of `MEANINGS` is set.

    Missing values are None.

    Args:
        record: A `PlottedRecord`.
        electrodes: Names of the electrodes, in the order of the returned charges.
    """
    numbers = [getattr(record, name) for name in NUMBERS]
    charge_of_electrode = record.charge_pC or {}
    charge_pC = [charge_of_electrode.get(name) for name in electrodes]
    is_flag_set = [flag in record.flags for flag in MEANINGS]
    return (*numbers, *charge_pC, *is_flag_set)


class _Groups(NamedTuple):
    """Groups of neighbouring records. Each group is drawn as a single point.

    Attributes:
        first_rows: Index of the first record of each group, shape (n_group,).
        start_time: Time of the first record of each group, in the unit of the time axis.
        end_time: Time of the last record of each group, in the unit of the time axis.
        after_gap: Indices of the groups that follow a gap. No line is drawn across a gap.
    """

    first_rows: Integers
    start_time: Array
    end_time: Array
    after_gap: Integers

    @classmethod
    def divide(cls, time_s: Array, unit_s: float) -> "_Groups":
        """Divide consecutive records into at most `MAX_GROUPS` groups of equal size, and find the gaps between them.

        The last group may be smaller. A gap is a pause between two groups that is longer than `MIN_GAP_S`, and longer
        than `MIN_GAP_GROUPS` times the median time between the starts of consecutive groups.

        Args:
            time_s: Times since the first record, shape (n,), s.
            unit_s: Length of the unit of the time axis, s.

        Returns:
            The groups, with times in the unit of the time axis.
        """
        group_size = math.ceil(len(time_s) / MAX_GROUPS)
        first_rows = np.arange(0, len(time_s), group_size)  # index of the first record of each group
        last_rows = np.append(first_rows[1:], len(time_s)) - 1  # index of the last record of each group
        start_s = time_s[first_rows]
        end_s = time_s[last_rows]

        usual_length_s = float(np.median(np.diff(start_s))) if len(first_rows) > 1 else 0.0
        min_gap_s = max(MIN_GAP_S, MIN_GAP_GROUPS * usual_length_s)
        pause_s = start_s[1:] - end_s[:-1]  # element 0 is the pause before group 1
        after_gap = np.flatnonzero(pause_s > min_gap_s) + 1
        return cls(first_rows, start_s / unit_s, end_s / unit_s, after_gap)

    def draw_band(self, axes: Any, lower: Array, upper: Array, **style: Any) -> None:
        """Draw the band between two columns, with one point for each group.

        Args:
            axes: Axes of matplotlib.
            lower: Lower edge of the band at each record, shape (n,). NaN stands for no value.
            upper: Upper edge of the band at each record, shape (n,). NaN stands for no value.
            style: Further arguments of `fill_between`.
        """
        # Smallest lower edge and largest upper edge of the records of each group; `fmin` and `fmax` ignore NaN.
        group_lower = np.fmin.reduceat(lower, self.first_rows)
        group_upper = np.fmax.reduceat(upper, self.first_rows)

        # A point of NaN before the first group after each gap interrupts the band.
        curves = (self.start_time, group_lower, group_upper)
        interrupted_curves = [np.insert(curve, self.after_gap, np.nan) for curve in curves]
        axes.fill_between(*interrupted_curves, **style)

    def draw_line(self, axes: Any, values: Array, **style: Any) -> None:
        """Draw a column as a line. At each group, the line covers the range of the values of the group."""
        self.draw_band(axes, values, values, lw=1.1, **style)


def recording_picture(
    traces: dict[str, Array], sensor: Sensor | None, working_area: Array | None, title: str
) -> Figure:
    """Draw the picture of a recording.

    Args:
        traces: Columns of the records by name, as `traces_of` returns them.
        sensor: The film; None if it is unknown.
        working_area: Corners of the working area, shape (n, 2), mm; None if it is unknown.
        title: Names of the file and the model.
    """
    start_s = traces["timestamp"][0]
    time_s = traces["timestamp"] - start_s
    duration_s = time_s[-1]
    unit_s, unit = _time_unit(duration_s)

    figure = new_figure(15.0, 8.6)
    film_figure, time_figure = cast(np.ndarray, figure.subfigures(1, 2, width_ratios=(1.0, 1.35)))
    figure.suptitle(f"{title}: {len(time_s)} records in {duration_s / unit_s:.4g} {unit}")

    # Right half: position, force, charges and flags over time
    time_label = f"time since {datetime.fromtimestamp(start_s, UTC):%Y-%m-%d %H:%M:%S} UTC, {unit}"
    _draw_over_time(time_figure, _Groups.divide(time_s, unit_s), traces, time_label)

    # Left half: the path of the contacts on the film
    film_axes = film_figure.subplots()
    if working_area is not None:
        film_axes.add_patch(Polygon(working_area, fill=False, ls=":", ec=INK, lw=1.2))
    if sensor is not None:
        draw_electrodes(film_axes, sensor)
    _draw_path(film_axes, traces, time_s / unit_s, f"time, {unit}")
    return figure


def _time_unit(duration_s: float) -> tuple[float, str]:
    """Return the length (s) and the symbol of the unit of time in which the duration of a recording is shown."""
    for min_duration_s, unit_s, unit in TIME_UNITS:  # from the longest unit to the shortest
        if duration_s >= min_duration_s:
            return unit_s, unit
    return 1.0, "s"  # the duration is negative, because the clock was set back during the recording


def _draw_over_time(figure: Any, groups: _Groups, traces: dict[str, Array], time_label: str) -> None:
    """Draw position, force, charges and flags over time, one above the other.

    Args:
        figure: The part of the figure of matplotlib for these axes.
        groups: Groups of records, each of which is drawn as a single point.
        traces: Columns of the records.
        time_label: Label of the common time axis.
    """
    flags = [flag for flag in MEANINGS if flag in traces]
    flag_height = 0.09 * max(1, len(flags)) + 0.05  # grows with the number of rows of flags
    heights = (1.0, 0.8, 1.0, flag_height)
    position_axes, force_axes, charge_axes, flag_axes = figure.subplots(4, 1, sharex=True, height_ratios=heights)

    _draw_with_std(position_axes, groups, traces, "x_mm", COLOURS[0])
    _draw_with_std(position_axes, groups, traces, "y_mm", COLOURS[1])
    _draw_with_std(force_axes, groups, traces, "force_N", INK)
    _draw_charges(charge_axes, groups, traces)
    _draw_flags(flag_axes, groups, traces, flags)

    _label_axes(position_axes, "position, mm; bands: 2 standard deviations")
    _label_axes(force_axes, "force, N")
    _label_axes(charge_axes, "touch charge, pC")
    flag_axes.set_xlabel(time_label)


def _draw_with_std(axes: Any, groups: _Groups, traces: dict[str, Array], name: str, colour: str) -> None:
    """Draw a quantity over time, with a band of two standard deviations on both sides.

    Args:
        axes: Axes of matplotlib.
        groups: Groups of records, each of which is drawn as a single point.
        traces: Columns of the records by name.
        name: Name of the column, such as "x_mm".
        colour: Colour of the line and of the band.
    """
    quantity, _underscore, unit = name.partition("_")
    values = traces[name]
    two_std = 2.0 * traces[f"{quantity}_std_{unit}"]
    groups.draw_band(axes, values - two_std, values + two_std, color=colour, alpha=0.25, lw=0.0)
    groups.draw_line(axes, values, color=colour, label=quantity)


def _draw_charges(axes: Any, groups: _Groups, traces: dict[str, Array]) -> None:
    """Draw the charges of all electrodes over time."""
    names = [name for name in traces if name.startswith("charge_pC.")]
    for number, name in enumerate(names):
        colour = COLOURS[number % len(COLOURS)]
        groups.draw_line(axes, traces[name], color=colour, label=name.removeprefix("charge_pC."))


def _draw_flags(axes: Any, groups: _Groups, traces: dict[str, Array], flags: list[str]) -> None:
    """Draw bars for the times at which flags are set, in one row for each flag.

    All bars have a minimum length, because the bar of a single record would be invisible.

    Args:
        axes: Axes of matplotlib.
        groups: Groups of records, each of which is drawn as one bar.
        traces: Columns of the records.
        flags: The flags, from the lowest row to the highest.
    """
    total_time = max(float(groups.end_time[-1]), 1e-9)  # above zero, even if there is only one record
    min_length = 2e-3 * total_time
    lengths = np.maximum(groups.end_time - groups.start_time, min_length)
    for row_index, flag in enumerate(flags):
        # The flag of a group is set if the flag is set in one of its records.
        is_set = np.maximum.reduceat(traces[flag], groups.first_rows) > 0.0
        starts_and_lengths = np.column_stack([groups.start_time[is_set], lengths[is_set]])
        bottom_and_height = (row_index - 0.35, 0.7)  # the bar is centred on the tick of the row
        axes.broken_barh(starts_and_lengths, bottom_and_height, color=INK)
    axes.set(yticks=range(len(flags)), yticklabels=flags)


def _label_axes(axes: Any, label: str) -> None:
    """Add a label and a grid to axes. Add a legend if a line or a band of the axes has a label.

    Args:
        axes: Axes of matplotlib.
        label: Label of the vertical axis.
    """
    axes.set_ylabel(label, fontsize=9)
    axes.grid(alpha=0.3)
    handles, _labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8, ncols=8)


def _draw_path(axes: Any, traces: dict[str, Array], time: Array, time_label: str) -> None:
    """Draw the path of the contacts on the film, true to scale.

    Each press is a line, with dots at the positions of its records. The colour of the dots shows the time, and their
    area shows the force. If there are too many records, only every n-th record is drawn.

    Args:
        axes: Axes of matplotlib.
        traces: Columns of the records.
        time: Time of each record, shape (n,), in the unit of the label.
        time_label: Label of the scale of colours.
    """
    position_mm = np.column_stack([traces["x_mm"], traces["y_mm"]])  # NaN for records without contact
    has_position = ~np.isnan(position_mm[:, 0])
    dot_rows = _every_nth(np.flatnonzero(has_position), MAX_POINTS)  # rows of the records that are drawn as dots
    if len(dot_rows) > 0:
        line_x, line_y = _every_nth(position_mm, MAX_POINTS).T
        axes.plot(line_x, line_y, color=INK, lw=0.5, alpha=0.5)  # NaN separates the presses
        _draw_contacts(axes, traces, position_mm, dot_rows, time, time_label)
    else:
        axes.text(0.5, 0.5, "nothing touched the film", transform=axes.transAxes, ha="center", color=INK)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes.margins(0.08)
    axes.autoscale_view()
    axes.set_title("path; ring: ± 2 standard deviations, cross: in doubt (see flags)", fontsize=9)
    axes.grid(alpha=0.2)


def _draw_contacts(
    axes: Any, traces: dict[str, Array], position_mm: Array, rows: Integers, time: Array, time_label: str
) -> None:
    """Draw contacts as dots, ellipses of two standard deviations around some of them, and crosses on doubtful contacts.

    Args:
        axes: Axes of matplotlib.
        traces: Columns of the records.
        position_mm: Position of each record, shape (n, 2), mm.
        rows: Rows of the drawn records in the columns, shape (m,).
        time: Time of each record, shape (n,), in the unit of the label.
        time_label: Label of the scale of colours.
    """
    # The area of a dot increases with the force. A negative force counts as 0.
    force_N = np.clip(traces["force_N"][rows], 0.0, None)
    largest_force_N = max(float(force_N.max()), 1e-9)  # avoids a division by 0
    dot_area = 3.0 + 30.0 * (force_N / largest_force_N)
    dots = axes.scatter(*position_mm[rows].T, c=time[rows], s=dot_area, lw=0.0, alpha=0.8, zorder=4)
    axes.figure.colorbar(dots, ax=axes, shrink=0.6, label=time_label, location="bottom", pad=0.02)

    # An ellipse extends two standard deviations to each side, and is therefore four standard deviations wide.
    ellipse_rows = _every_nth(rows, MAX_ELLIPSES)
    width_mm = 4.0 * traces["x_std_mm"][ellipse_rows]
    height_mm = 4.0 * traces["y_std_mm"][ellipse_rows]
    axes.add_collection(
        EllipseCollection(
            width_mm,
            height_mm,
            angles=np.zeros(len(ellipse_rows)),
            units="xy",
            offsets=position_mm[ellipse_rows],
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors=INK,
            lw=0.6,
            alpha=0.6,
            zorder=6,
        )
    )

    # Crosses mark the contacts with at least one of the flags. A flag that no record has is not in `traces`.
    is_doubtful = np.zeros(len(rows), dtype=bool)
    for flag in DOUBTFUL_FLAGS:
        if flag in traces:
            is_doubtful |= traces[flag][rows] > 0.0
    axes.scatter(*position_mm[rows[is_doubtful]].T, c=FELT, marker="x", s=24, lw=0.9, zorder=5)


def _every_nth(values: Any, max_count: int) -> Any:
    """Return every n-th row of an array, where n is the smallest number for which at most `max_count` rows remain."""
    n = max(1, math.ceil(len(values) / max_count))
    return values[::n]
