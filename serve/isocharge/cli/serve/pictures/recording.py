"""A recording as one picture: the path on the film, and position, force, charges and flags over time."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patches import Polygon as Patch

from isocharge.common.arrays import Array
from isocharge.serve.export.traces import Envelope, Point, Traces
from isocharge.simulate import Sensor
from isocharge.simulate.plots.figure import FELT, INK, new_figure, shades
from isocharge.simulate.plots.film import draw_electrodes

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours that eyes of every kind tell apart (Okabe and Ito 2008); with the first styles, lines differ twice."""

STYLES = ("-", "--", "-.", ":")

BAND = 2.0
"""Half width of the bands and half axes of the ellipses, standard deviations."""

BAND_OPACITY = 0.5
"""Opacity of the bands of long recordings, which lie on each other."""

MOST_ELLIPSES = 60

LONGEST_LINE = 4.0
"""Longest line between neighbours on the path, in steps at which they lie apart; and SHORT_MM in any case."""

SHORT_MM = 0.5

UNITS = ((7200.0, 3600.0, "h"), (600.0, 60.0, "min"), (0.0, 1.0, "s"))
"""From which length, s, a unit of time is used, and its seconds."""

BREAK_S = 1.0
"""Time without a record, s, across which no line is drawn, if it is also longer than BREAK_GROUPS groups."""

BREAK_GROUPS = 5.0


@dataclass(frozen=True)
class Scene:
    """What is known about the film of a recording; None for what is not.

    Attributes:
        sensor: The sensor.
        working_area_mm: Corners, shape (n, 2), mm.
    """

    sensor: Sensor | None = None
    working_area_mm: Array | None = None


def recording_picture(traces: Traces, scene: Scene, title: str) -> Figure:
    """The picture of a recording.

    Args:
        traces: The recording.
        scene: The film, as the model describes it.
        title: Name of file and model.
    """
    figure = new_figure(15.0, 8.6)
    film, times = cast(np.ndarray, figure.subfigures(1, 2, width_ratios=(1.0, 1.35)))
    seconds, unit = _unit(float(traces.end[-1]))
    _draw_film(film.subplots(), traces, scene, seconds, unit)
    rows = max(1, sum(bool(groups.any()) for groups in traces.flags.values()))
    heights = (1.0, 0.8, 1.0, 0.09 * rows + 0.05)
    position, force, charge, flags = times.subplots(4, 1, sharex=True, height_ratios=heights)
    clock = _Clock.of(traces, seconds)
    _draw_contact(position, traces, clock, ("x_mm", "y_mm"))
    position.set_ylabel("position, mm")
    _draw_contact(force, traces, clock, ("force_N",))
    force.set(ylabel="force, N")
    force.set_ylim(bottom=min(0.0, force.get_ylim()[0]))
    _draw_charges(charge, traces, clock)
    _draw_flags(flags, traces, clock)
    begin = datetime.fromtimestamp(traces.begin, UTC).strftime("%Y-%m-%d %H:%M:%S")
    flags.set_xlabel(f"time since {begin} UTC, {unit}")
    times.align_ylabels()
    figure.suptitle(f"{title}: {traces.records} records in {traces.end[-1] / seconds:.4g} {unit}")
    return figure


def _unit(length_s: float) -> tuple[float, str]:
    """The unit of time for a length: its seconds, its name."""
    return next((seconds, name) for least, seconds, name in UNITS if length_s >= least)


@dataclass(frozen=True)
class _Clock:
    """Where envelopes go: the middle of each group, the places of breaks, and whether a group is one record."""

    time: Array
    breaks: np.ndarray
    edges: tuple[Array, Array]
    single: bool

    @classmethod
    def of(cls, traces: Traces, seconds: float) -> "_Clock":
        middle = 0.5 * (traces.start + traces.end)
        pause = traces.start[1:] - traces.end[:-1]
        usual = float(np.median(np.diff(middle))) if len(middle) > 1 else 0.0
        breaks = np.flatnonzero(pause > max(BREAK_S, BREAK_GROUPS * usual)) + 1
        single = len(middle) == traces.records
        return cls(
            np.insert(middle / seconds, breaks, np.nan), breaks, (traces.start / seconds, traces.end / seconds), single
        )

    def broken(self, values: Array) -> Array:
        """Values of the groups with NaN at the breaks."""
        return np.insert(values, self.breaks, np.nan)

    def line(self, axes: Any, envelope: Envelope, **style: Any) -> None:
        """A line of single records, or a band from the smallest to the largest value of groups."""
        low, high = self.broken(envelope.low), self.broken(envelope.high)
        if self.single:
            axes.plot(self.time, low, **style)
            return
        axes.fill_between(self.time, low, high, color=style["color"], alpha=BAND_OPACITY, lw=0.3, label=style["label"])


def _draw_contact(axes: Any, traces: Traces, clock: _Clock, names: tuple[str, ...]) -> None:
    """Fields of the contact with bands of their standard deviations."""
    for name, colour, style in zip(names, COLOURS if len(names) > 1 else (INK,), STYLES, strict=False):
        middle = traces.values[name]
        low, high = traces.values[f"{name} - std"].low, traces.values[f"{name} + std"].high
        low, high = middle.low - BAND * (middle.low - low), middle.high + BAND * (high - middle.high)
        axes.fill_between(clock.time, clock.broken(low), clock.broken(high), color=colour, alpha=0.25, lw=0.0)
        clock.line(axes, middle, color=colour, ls=style, lw=1.1, label=name.partition("_")[0])
    axes.plot([], [], color=INK, alpha=0.25, lw=6.0, label=f"± {BAND:g} standard deviations")
    _legend(axes, 3)
    axes.grid(alpha=0.3)


def _legend(axes: Any, columns: int) -> None:
    """Above the axes, where it hides nothing."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, frameon=False, fontsize=8, ncols=columns
    )


def _draw_charges(axes: Any, traces: Traces, clock: _Clock) -> None:
    count = len(traces.charge_pC)
    colours = COLOURS if count <= len(COLOURS) else [tuple(shade) for shade in shades(count)]
    for number, (name, envelope) in enumerate(traces.charge_pC.items()):
        style = STYLES[number % len(STYLES)]
        clock.line(axes, envelope, color=colours[number], ls=style, lw=1.1, label=name)
    axes.set_ylabel("touch charge, pC")
    if 0 < count <= len(COLOURS):
        _legend(axes, count)
    axes.grid(alpha=0.3)


def _draw_flags(axes: Any, traces: Traces, clock: _Clock) -> None:
    """A row for each flag that occurs, dark where it does; a single frame still is a visible mark."""
    words = sorted(word for word, groups in traces.flags.items() if groups.any())
    start, end = clock.edges
    least = 2e-3 * max(float(end[-1]), 1e-9)
    for row, word in enumerate(words):
        spans = [(a, max(b - a, least)) for a, b in _spans(traces.flags[word], start, end)]
        axes.broken_barh(spans, (row - 0.35, 0.7), color=FELT if word in ("misfit", "outside", "invalid") else INK)
    axes.set(yticks=range(len(words)), yticklabels=words, ylim=(-0.6, max(len(words), 1) - 0.4))
    axes.tick_params(axis="y", labelsize=8)
    axes.grid(alpha=0.3, axis="x")
    if not words:
        axes.text(0.5, 0.5, "no flags", transform=axes.transAxes, ha="center", va="center", color=INK)


def _spans(groups: np.ndarray, start: Array, end: Array) -> list[tuple[float, float]]:
    """Beginnings and ends of the runs of groups that have a flag."""
    padded = np.concatenate([[False], groups, [False]]).astype(int)
    first, last = np.flatnonzero(np.diff(padded) > 0), np.flatnonzero(np.diff(padded) < 0) - 1
    return list(zip(start[first].tolist(), end[last].tolist(), strict=True))


def _draw_film(axes: Any, traces: Traces, scene: Scene, seconds: float, unit: str) -> None:
    """The path on the film to scale, its colour the time."""
    reach = _draw_scene(axes, scene)
    if traces.path:
        marks = _draw_path(axes, traces.path, traces.step_mm, seconds)
        doubts = np.array([(point.x_mm, point.y_mm) for point in traces.doubts]).reshape(-1, 2)
        axes.scatter(*doubts.T, c=FELT, marker="x", s=24, lw=0.9, zorder=5)
        axes.figure.colorbar(marks, ax=axes, shrink=0.6, label=f"time, {unit}", location="bottom", pad=0.02)
        places = np.array([(point.x_mm, point.y_mm) for point in traces.path])
        reach = max(reach, 1.1 * float(np.abs(places).max()))
    else:
        axes.text(0.5, 0.5, "nothing touched the film", transform=axes.transAxes, ha="center", color=INK)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes.set_title("path; ring: ± 2 standard deviations, cross: in doubt (see flags)", fontsize=9)
    axes.grid(alpha=0.2)


def _draw_scene(axes: Any, scene: Scene) -> float:
    """Electrodes and working area; the distance from the centre that holds both, mm."""
    reach = 1.0
    if scene.working_area_mm is not None:
        axes.add_patch(Patch(scene.working_area_mm, fill=False, ls=":", ec=INK, lw=1.2))
        reach = max(reach, 1.1 * float(np.abs(scene.working_area_mm).max()))
    if scene.sensor is not None:
        draw_electrodes(axes, scene.sensor)
        corners = np.concatenate([scene.sensor.calibration.place(np.array(e.corners)) for e in scene.sensor.electrodes])
        reach = max(reach, 1.1e3 * float(np.abs(corners).max()))
    return reach


def _draw_path(axes: Any, path: tuple[Point, ...], step_mm: float, seconds: float) -> Any:
    """Lines between neighbours of one press, dots that grow with the force, rings of deviations."""
    time = np.array([point.time for point in path]) / seconds
    places = np.array([(point.x_mm, point.y_mm) for point in path])
    press = np.array([point.press for point in path])
    force = np.array([point.force_N for point in path])
    longest = max(SHORT_MM, LONGEST_LINE * step_mm)
    same = (press[1:] == press[:-1]) & (np.hypot(*(places[1:] - places[:-1]).T) <= longest)
    lines = LineCollection(np.stack([places[:-1], places[1:]], axis=1)[same], cmap="viridis", lw=0.8, alpha=0.7)
    lines.set_array(time[1:][same])
    lines.set_clim(0.0, max(float(time[-1]), 1e-9))
    axes.add_collection(lines)
    size = 3.0 + 30.0 * np.clip(force, 0.0, None) / max(float(force.max()), 1e-9)
    limits: dict[str, Any] = {"cmap": "viridis", "vmin": 0.0, "vmax": max(float(time[-1]), 1e-9)}
    marks = axes.scatter(*places.T, c=time, s=size, lw=0.0, alpha=0.8, zorder=4, **limits)
    for number in np.unique(np.linspace(0, len(path) - 1, MOST_ELLIPSES).astype(int)).tolist():
        point = path[number]
        axes.add_patch(
            Ellipse(
                (point.x_mm, point.y_mm), 2.0 * BAND * point.x_std_mm, 2.0 * BAND * point.y_std_mm,
                fill=False, ec=INK, lw=0.6, alpha=0.6, zorder=6,
            )
        )  # fmt: skip
    return marks
