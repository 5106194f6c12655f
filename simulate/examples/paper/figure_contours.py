"""Fig. 9 to 11: triangulation and contours."""

from itertools import combinations
from typing import Any

import numpy as np
from choices import PAPER, Choices
from entry import Entry, Row
from matplotlib.figure import Figure
from solves import FORCE, Solves
from triangulation_errors import BEYOND, Accuracy

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeSpline, Sensor
from isocharge.simulate.contours.field_contours import ContourField
from isocharge.simulate.contours.fix import Fix, Meeting
from isocharge.simulate.contours.graphical_method import DrawnContour, DrawnTriangulation
from isocharge.simulate.plots.contours import draw_contours
from isocharge.simulate.plots.figure import COLOURS, FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_electrodes, draw_probe, draw_working_area, frame_film

LEVELS, AREA = 8, 11.5
"""Number of contours of each electrode in Fig. 11, and their largest distance from the centre, mm: the far side of the
electrodes."""


def fig_9(solves: Solves, accuracy: Accuracy) -> Entry:
    """Contours from the field, under a triangle."""
    sensor = solves.choices.sensor("three")
    forward_map, at = solves.forward_map("triangle", sensor), solves.choices.shown
    charges = solves.charges("triangle", sensor, np.array([at]))[0]
    field = ContourField(ChargeSpline.of(forward_map, BEYOND * solves.choices.radius, solves.choices.spacing), FORCE)
    figure = new_figure(6.6, 7.0)
    axes = figure.subplots()
    for name, charge, colour in zip(sensor.electrode_names, charges, COLOURS, strict=False):
        draw_contours(axes, field.contours(name, float(charge)), colour, f"{name}, {charge:.0f} pC")
    draw_electrodes(axes, sensor)
    draw_probe(axes, solves.choices.triangle, at, "probe")
    draw_working_area(axes, solves.choices.radius, "working area")
    frame_film(
        axes, sensor, BEYOND * solves.choices.radius, "Fig. 9: triangulation with a triangular probe, from the field"
    )
    figure.legend(fontsize=8, loc="outside lower center", ncols=5)
    errors = accuracy.field["three"]
    ours = f"median {errors.percentile(50):.1g} mm, 95 % {errors.percentile(95):.1g} mm"
    return Entry(
        "Fig. 9",
        f"Isocharge contours of a press at ({at[0]:g}, {at[1]:g}) mm, 1 N, from the field.",
        figure,
        [
            Row(
                "distance from the press to the mean of the intersections, from the field",
                "not done",
                f"{ours}; contours met for {errors.fix.found.sum()} of {len(errors.at)} presses",
                "without the error of the drawing the contours meet; where two of them only touch, on the line between "
                "their electrodes, they may miss",
            )
        ],
        errors.numbers(),
    )


def fig_10(solves: Solves, accuracy: Accuracy) -> Entry:
    """The paper's graphical method, and how its 0.122 mm compares."""
    sensor, at = solves.choices.sensor("three"), solves.choices.shown
    triangulation = DrawnTriangulation(solves.scheme("triangle", sensor), solves.choices.degree)
    charge = solves.charges("triangle", sensor, np.array([at]))
    contours, fix = [c for c in triangulation.contours(charge[0]) if c is not None], triangulation.locate(charge)
    error_mm = float(np.hypot(*(fix.contact[0, :2] - at)))
    figure = new_figure(16.5, 5.6)
    whole, near, distribution = figure.subplots(1, 3)
    for axes in (whole, near):
        _draw_graphical_contours(axes, contours)
    draw_probe(whole, solves.choices.triangle, at)
    draw_electrodes(whole, sensor)
    frame_film(whole, sensor, BEYOND * solves.choices.radius, "Fig. 10: contours as the paper draws them")
    whole.legend(fontsize=8)
    _zoom(near, contours, at, (float(fix.contact[0, 0]), float(fix.contact[0, 1])))
    _distributions(distribution, accuracy, solves.choices.degree)
    return Entry(
        "Fig. 10",
        "Contours from a polynomial on each line and a spline through its roots; the crossings and their mean; the "
        "errors over the working area.",
        figure,
        [*_rows_of_shown_press(fix, error_mm), _row_of_percentile(accuracy, solves.choices.degree)],
        {
            "shown_error_mm": error_mm,
            **{f"{layout}_degree_{degree}": errors.numbers() for (layout, degree), errors in accuracy.drawn.items()},
        },
    )


def _draw_graphical_contours(axes: Any, contours: list[DrawnContour]) -> None:
    """Splines, and the roots on the lines that they join."""
    for contour, colour in zip(contours, COLOURS, strict=False):
        label = f"{contour.electrode}, {contour.charge:.0f} pC"
        axes.plot(*contour.points.T, color=colour, lw=1.3, label=label)
        axes.plot(*contour.knots.T, ".", color=colour, ms=5)


def _rows_of_shown_press(fix: Fix, error_mm: float) -> list[Row]:
    """Whether the contours of the shown press meet in one point, and how far from it."""
    return [
        Row(
            "are the three contours concurrent?",
            "no",
            f"no: {fix.spread[0]:.3f} mm from the mean" if fix.found[0] else "no",
            "error of polynomial and spline",
        ),
        Row(
            "the shown press, distance from the mean of the crossings",
            "0.122 mm (place not given)",
            f"{error_mm:.3f} mm" if fix.found[0] else Meeting(int(fix.status[0])).summary,
            "the place of the paper's press is not given",
        ),
    ]


def _row_of_percentile(accuracy: Accuracy, degree: int) -> Row:
    """Where the paper's error lies among those over the working area, for our degree and for others."""
    errors = accuracy.drawn["three", degree]
    others = ", ".join(
        f"degree {other}: median {accuracy.drawn['three', other].percentile(50):.2f} mm, 0.122 mm at "
        f"{accuracy.drawn['three', other].share_below(PAPER.error_mm):.0f} %"
        for other in sorted({other for layout, other in accuracy.drawn if layout == "three"} - {degree})
    )
    return Row(
        "percentile of 0.122 mm over the working area",
        "0.122 mm",
        f"{errors.share_below(PAPER.error_mm):.0f} %; median {errors.percentile(50):.3f}, "
        f"95 % {errors.percentile(95):.3f} mm; "
        f"contours met for {errors.fix.found.sum()} of {len(errors.at)} presses",
        f"polynomials of degree {degree}, our choice; {others}",
    )


def _zoom(axes: Any, drawn: list[DrawnContour], at: tuple[float, float], mean: tuple[float, float]) -> None:
    crossings: list[Array] = []
    for one, other in combinations(drawn, 2):
        points = one.crossings(other)
        if len(points):
            crossings.append(points[np.argmin(np.linalg.norm(points - np.array(at), axis=1))])
    if crossings:
        axes.plot(*np.array(crossings).T, "o", mfc="none", color=INK, ms=8, label="crossings")
    axes.plot(mean[0], mean[1], "x", color=INK, ms=9, mew=2, label="their mean")
    axes.plot(at[0], at[1], "+", color=FELT, ms=12, mew=2, label="the press")
    reach = 0.6
    axes.set(xlim=(at[0] - reach, at[0] + reach), ylim=(at[1] - reach, at[1] + reach))
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title="near the press")
    axes.legend(fontsize=8)


def _distributions(axes: Any, accuracy: Accuracy, degree: int) -> None:
    shown = [
        (accuracy.drawn["three", degree], "three, as the paper", COLOURS[0], "-"),
        (accuracy.drawn["four", degree], "four, as the paper", COLOURS[1], "-"),
        (accuracy.field["three"], "three, from the field", COLOURS[0], "--"),
        (accuracy.field["four"], "four, from the field", COLOURS[1], "--"),
    ]
    for errors, label, colour, style in shown:
        rising = errors.found_mm
        axes.semilogx(
            np.maximum(rising, 1e-6),
            100.0 * (np.arange(rising.size) + 0.5) / rising.size,
            style,
            color=colour,
            label=label,
        )
    axes.axvline(PAPER.error_mm, color=INK, lw=1.0, ls=":", label=f"the paper's {PAPER.error_mm:g} mm")
    axes.set(
        xlabel="distance from the press, mm",
        ylabel="presses found with at most this error, %",
        title="over the working area",
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def fig_11(solves: Solves) -> Entry:
    """Contours of all four electrodes under a circle."""
    sensor = solves.choices.sensor("four")
    field = ContourField(ChargeSpline.of(solves.forward_map("circle", sensor), AREA, solves.choices.spacing), FORCE)
    reached_pC = {name: list(field.reach(name)) for name in sensor.electrode_names}
    median, worst = _change_from_circle_to_triangle(solves)
    return Entry(
        "Fig. 11",
        "Isocharge contours of all four electrodes; on the right those of A with their charges.",
        _draw_fig_11(solves.choices, sensor, field),
        [
            Row(
                "charges met in the central area",
                "in the figure",
                f"{reached_pC['A'][0]:.0f} to {reached_pC['A'][1]:.0f} pC on A, within {AREA:g} mm",
                "E, d31, d32 are our choice; largest with the probe on the electrode",
            ),
            Row(
                "contours change with the probe's shape",
                "they may",
                f"triangle of 4 mm against circle of 1 mm: a charge changes by {100 * median:.1f} % at the median, "
                f"{100 * worst:.0f} % at most",
                "shape matters beside an electrode only",
            ),
        ],
        {"reached_pC": reached_pC, "triangle_against_circle_median": median, "triangle_against_circle_worst": worst},
    )


def _draw_fig_11(choices: Choices, sensor: Sensor, field: ContourField) -> Figure:
    """On the left the contours of all electrodes, on the right those of the first with their charges."""
    figure = new_figure(12.6, 6.6)
    left, right = figure.subplots(1, 2)
    for name, colour in zip(sensor.electrode_names, COLOURS, strict=False):
        levels = field.even_charges(name, LEVELS)
        pieces = [piece for charge in levels for piece in field.contours(name, charge)]
        draw_contours(left, pieces, colour, f"{name}, {min(levels):.0f} to {max(levels):.0f} pC", 0.9)
    _one_electrode(right, field, sensor.electrode_names[0], COLOURS[0])
    for axes, title in ((left, "Fig. 11: all four electrodes, circle of 1 mm, 1 N"), (right, "electrode A alone, pC")):
        draw_electrodes(axes, sensor)
        draw_working_area(axes, choices.radius, "working area")
        draw_probe(axes, choices.circle, (0.0, 0.0), "probe")
        frame_film(axes, sensor, AREA, title)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncols=6)
    return figure


def _one_electrode(axes: Any, field: ContourField, name: str, colour: str) -> None:
    for charge in field.even_charges(name, LEVELS):
        pieces = field.contours(name, charge)
        draw_contours(axes, pieces, colour)
        for piece in pieces[:1]:
            end = piece.points[-1 if piece.points[-1, 1] > piece.points[0, 1] else 0]
            outward = 9.0 * end / np.linalg.norm(end)
            label = {
                "xytext": tuple(outward),
                "textcoords": "offset points",
                "fontsize": 7,
                "ha": "center",
                "va": "center",
            }
            axes.annotate(f"{charge:.0f}", end, **label)


def _change_from_circle_to_triangle(solves: Solves) -> tuple[float, float]:
    """Relative change of a charge from the circle to the triangle over the working area: median and largest."""
    sensor, places = solves.choices.sensor("four"), solves.places
    circle, triangle = (solves.charges(probe, sensor, places) for probe in ("circle", "triangle"))
    change = np.abs(triangle / circle - 1.0)
    return float(np.median(change)), float(change.max())
