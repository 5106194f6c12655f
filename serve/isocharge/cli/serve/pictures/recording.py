"""A recording as one picture: the path on the film, and position, force, charges and flags over time."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast

import numpy as np
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Patch
from msgspec import Struct

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import RecordingError
from isocharge.simulate import Sensor
from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_electrodes

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours that eyes of every kind tell apart (Okabe and Ito 2008)."""

MOST_GROUPS = 4000
"""Records, or groups of neighbours, that are drawn: two for each pixel of a wide picture."""

MOST_POINTS, MOST_ELLIPSES = 20_000, 60
"""Contacts that are drawn on the film, and those of them with an ellipse."""

LEAST_BREAK = 1.0
"""Time without a record, s, from which no line is drawn across it, if it is also longer than five groups."""

UNITS = ((7200.0, 3600.0, "h"), (600.0, 60.0, "min"), (0.0, 1.0, "s"))
"""From which length, s, a unit of time is used, and its seconds."""

DOUBTS = ("outside", "misfit", "saturated", "blind", "invalid")
"""Flags of a contact that is not to be taken as it stands."""


class RecordFields(Struct):
    """What is drawn of a record."""

    timestamp: float
    x_mm: float | None
    y_mm: float | None
    force_N: float | None
    x_std_mm: float | None
    y_std_mm: float | None
    force_std_N: float | None
    charge_pC: dict[str, float | None] | None
    flags: tuple[str, ...]


VALUES = RecordFields.__struct_fields__[:7]


@dataclass(frozen=True)
class Traces:
    """A recording as columns, each of shape (n,), NaN for null.

    Attributes:
        values: Time (unix s), contact and standard deviations by their fields in a record.
        charge_pC: By electrode.
        flags: By word, where it is set.
    """

    values: dict[str, Array]
    charge_pC: dict[str, Array]
    flags: dict[str, Booleans]

    @classmethod
    def of(cls, records: Iterable[RecordFields], where: str) -> "Traces":
        """Of records in their order.

        Raises:
            RecordingError: If there is none.
        """
        columns: dict[str, array[float]] = {name: array("d") for name in VALUES}
        charges: dict[str, array[float]] = {}
        flags: dict[str, list[int]] = {}
        count = 0
        for count, record in enumerate(records, start=1):
            for name, column in columns.items():
                column.append(_number(getattr(record, name)))
            for name, charge in (record.charge_pC or {}).items():
                column = charges.setdefault(name, array("d"))
                column.extend([np.nan] * (count - 1 - len(column)))
                column.append(_number(charge))
            for word in record.flags:
                flags.setdefault(word, []).append(count - 1)
        if not count:
            raise RecordingError(f"{where}: expected at least one record, got none; replay or record it again")
        return cls(
            {name: np.array(column) for name, column in columns.items()},
            {name: np.array([*column, *[np.nan] * (count - len(column))]) for name, column in charges.items()},
            {word: np.isin(np.arange(count), numbers) for word, numbers in sorted(flags.items())},
        )

    def __len__(self) -> int:
        return len(self.values["timestamp"])


def _number(value: float | None) -> float:
    return np.nan if value is None else value


@dataclass(frozen=True)
class _Axis:
    """Time in groups of records: `start` of each group, their `first` and `last` times, and where lines break."""

    start: Integers
    first: Array
    last: Array
    breaks: Integers

    @classmethod
    def of(cls, time: Array, seconds: float) -> "_Axis":
        start = np.arange(0, len(time), -(-len(time) // MOST_GROUPS))
        first, last = time[start], time[np.append(start[1:], len(time)) - 1]
        usual = float(np.median(np.diff(first))) if len(first) > 1 else 0.0
        breaks = np.flatnonzero(first[1:] - last[:-1] > max(LEAST_BREAK, 5.0 * usual)) + 1
        return cls(start, first / seconds, last / seconds, breaks)

    def draw(self, axes: Any, low: Array, high: Array, **style: Any) -> None:
        """A band between two columns, and its line where groups are single records."""
        low, high = np.fmin.reduceat(low, self.start), np.fmax.reduceat(high, self.start)
        time, low, high = (np.insert(values, self.breaks, np.nan) for values in (self.first, low, high))
        axes.fill_between(time, low, high, lw=0.3, **style)

    def line(self, axes: Any, values: Array, colour: str, label: str) -> None:
        """A column, or the band that its groups fill."""
        if len(self.start) == len(values):
            time, values = (np.insert(column, self.breaks, np.nan) for column in (self.first, values))
            axes.plot(time, values, color=colour, lw=1.1, label=label)
        else:
            self.draw(axes, values, values, color=colour, alpha=0.5, label=label)


def recording_picture(traces: Traces, sensor: Sensor | None, working_area: Array | None, title: str) -> Figure:
    """The picture of a recording.

    Args:
        traces: The recording.
        sensor: The film; None if it is not known.
        working_area: Corners, shape (n, 2), mm.
        title: Name of file and model.
    """
    time = traces.values["timestamp"] - traces.values["timestamp"][0]
    seconds, unit = next((seconds, name) for least, seconds, name in UNITS if time[-1] >= least)
    axis, figure = _Axis.of(time, seconds), new_figure(15.0, 8.6)
    film, times = cast(np.ndarray, figure.subfigures(1, 2, width_ratios=(1.0, 1.35)))
    _draw_film(film.subplots(), traces, time / seconds, sensor, working_area, unit)
    heights = (1.0, 0.8, 1.0, 0.09 * max(1, len(traces.flags)) + 0.05)
    position, force, charge, flags = times.subplots(4, 1, sharex=True, height_ratios=heights)
    for axes, name, colour in ((position, "x_mm", COLOURS[0]), (position, "y_mm", COLOURS[1]), (force, "force_N", INK)):
        values, spread = traces.values[name], 2.0 * traces.values[name.replace("_", "_std_")]
        axis.draw(axes, values - spread, values + spread, color=colour, alpha=0.25)
        axis.line(axes, values, colour, name.partition("_")[0])
    for number, (name, values) in enumerate(traces.charge_pC.items()):
        axis.line(charge, values, COLOURS[number % len(COLOURS)], name)
    for row, flagged in enumerate(traces.flags.values()):
        inside = np.logical_or.reduceat(flagged, axis.start)
        least = 2e-3 * max(float(axis.last[-1]), 1e-9)  # a single frame still is a visible mark
        spans = [(a, max(b - a, least)) for a, b in zip(axis.first[inside], axis.last[inside], strict=True)]
        flags.broken_barh(spans, (row - 0.35, 0.7), color=INK)
    labels = ("position, mm; bands: 2 standard deviations", "force, N", "touch charge, pC")
    for axes, label in zip((position, force, charge), labels, strict=True):
        axes.set_ylabel(label, fontsize=9)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8, ncols=8)
        axes.grid(alpha=0.3)
    flags.set(yticks=range(len(traces.flags)), yticklabels=list(traces.flags))
    begin = datetime.fromtimestamp(traces.values["timestamp"][0], UTC).strftime("%Y-%m-%d %H:%M:%S")
    flags.set_xlabel(f"time since {begin} UTC, {unit}")
    figure.suptitle(f"{title}: {len(traces)} records in {time[-1] / seconds:.4g} {unit}")
    return figure


def _draw_film(
    axes: Any, traces: Traces, time: Array, sensor: Sensor | None, working_area: Array | None, unit: str
) -> None:
    """The path on the film to scale: lines within a press, colour the time, dots that grow with the force."""
    if working_area is not None:
        axes.add_patch(Patch(working_area, fill=False, ls=":", ec=INK, lw=1.2))
    if sensor is not None:
        draw_electrodes(axes, sensor)
    place = np.column_stack([traces.values["x_mm"], traces.values["y_mm"]])
    touching = ~np.isnan(place[:, 0])
    press = np.cumsum(np.diff(touching, prepend=False) & touching)
    at = np.flatnonzero(touching)
    at = at[:: -(-len(at) // MOST_POINTS) or 1]
    if len(at):
        same = press[at[1:]] == press[at[:-1]]
        lines = LineCollection(np.stack([place[at[:-1]], place[at[1:]]], axis=1)[same], lw=0.8, alpha=0.7)
        lines.set_array(time[at[1:]][same])
        axes.add_collection(lines)
        force = np.clip(traces.values["force_N"][at], 0.0, None)
        size = 3.0 + 30.0 * force / max(float(force.max()), 1e-9)
        marks = axes.scatter(*place[at].T, c=time[at], s=size, lw=0.0, alpha=0.8, zorder=4)
        few = at[np.unique(np.linspace(0, len(at) - 1, MOST_ELLIPSES).astype(int))]
        width, height = (4.0 * traces.values[name][few] for name in ("x_std_mm", "y_std_mm"))
        axes.add_collection(
            EllipseCollection(
                width, height, np.zeros(len(few)), units="xy", offsets=place[few], offset_transform=axes.transData,
                facecolors="none", edgecolors=INK, lw=0.6, alpha=0.6, zorder=6,
            )
        )  # fmt: skip
        doubts = touching & np.any(
            [traces.flags[word] for word in DOUBTS if word in traces.flags] or [~touching], axis=0
        )
        doubtful = np.flatnonzero(doubts)[:: max(1, int(doubts.sum()) // MOST_POINTS)]
        axes.scatter(*place[doubtful].T, c=FELT, marker="x", s=24, lw=0.9, zorder=5)
        axes.figure.colorbar(marks, ax=axes, shrink=0.6, label=f"time, {unit}", location="bottom", pad=0.02)
    else:
        axes.text(0.5, 0.5, "nothing touched the film", transform=axes.transAxes, ha="center", color=INK)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes.margins(0.08)
    axes.autoscale_view()
    axes.set_title("path; ring: ± 2 standard deviations, cross: in doubt (see flags)", fontsize=9)
    axes.grid(alpha=0.2)
