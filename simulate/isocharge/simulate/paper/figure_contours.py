"""Fig. 9 to 11: triangulation and contours."""

from itertools import combinations
from typing import Any

import numpy as np

from isocharge.arrays import Array
from isocharge.simulate.contours.field_contours import ContourField
from isocharge.simulate.contours.fix import Meeting
from isocharge.simulate.contours.graphical_method import DrawnContour, DrawnTriangulation
from isocharge.simulate.paper.choices import PAPER
from isocharge.simulate.paper.entry import Entry, Row
from isocharge.simulate.paper.solves import FORCE, Solves
from isocharge.simulate.paper.triangulation_errors import BEYOND, Accuracy
from isocharge.simulate.plots.curves import draw_contours
from isocharge.simulate.plots.figure import COLOURS, FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_electrodes, draw_probe, draw_working_area, frame_film

LEVELS, AREA = 8, 11.5e-3
"""Contours of each electrode in Fig. 11, and how far from the centre they are followed, m: to the electrodes' end."""


def fig_9(study: Solves, accuracy: Accuracy) -> Entry:
    """Contours from the field, under a triangle."""
    sensor = study.choices.sensor("three")
    film, at = study.film("triangle", sensor), study.choices.shown
    charge = film.forward(np.array([at[0]]), np.array([at[1]]), np.array([FORCE]))[0]
    field = ContourField.of(film, FORCE, BEYOND * study.choices.radius, study.choices.spacing)
    figure = new_figure(6.6, 7.0)
    axes = figure.subplots()
    for name, q, colour in zip(sensor.electrode_names, charge, COLOURS, strict=False):
        draw_contours(axes, field.contours(name, float(q)), colour, f"{name}, {1e12 * q:.0f} pC")
    draw_electrodes(axes, sensor)
    draw_probe(axes, study.choices.triangle, at, "probe")
    draw_working_area(axes, study.choices.radius, "working area")
    frame_film(
        axes, sensor, BEYOND * study.choices.radius, "Fig. 9: triangulation with a triangular probe, from the field"
    )
    figure.legend(fontsize=8, loc="outside lower center", ncols=5)
    errors = accuracy.field["three"]
    ours = f"median {errors.percentile(50):.1g} mm, 95 % {errors.percentile(95):.1g} mm"
    return Entry(
        "Fig. 9",
        f"Isocharge contours of a press at ({1e3 * at[0]:g}, {1e3 * at[1]:g}) mm, 1 N, from the field.",
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


def fig_10(study: Solves, accuracy: Accuracy) -> Entry:
    """The paper's own way, and how its 0.122 mm compares."""
    sensor, at = study.choices.sensor("three"), study.choices.shown
    contours = DrawnTriangulation(study.scheme("triangle", sensor), study.choices.degree)
    charge = study.film("triangle", sensor).forward(np.array([at[0]]), np.array([at[1]]), np.array([FORCE]))
    drawn, fix = [c for c in contours.contours(charge[0]) if c is not None], contours.locate(charge)
    figure = new_figure(16.5, 5.6)
    whole, near, share = figure.subplots(1, 3)
    for axes in (whole, near):
        for contour, colour in zip(drawn, COLOURS, strict=False):
            axes.plot(
                *1e3 * contour.points.T,
                color=colour,
                lw=1.3,
                label=f"{contour.electrode}, {1e12 * contour.charge:.0f} pC",
            )
            axes.plot(*1e3 * contour.knots.T, ".", color=colour, ms=5)
    draw_probe(whole, study.choices.triangle, at)
    draw_electrodes(whole, sensor)
    frame_film(whole, sensor, BEYOND * study.choices.radius, "Fig. 10: contours as the paper draws them")
    whole.legend(fontsize=8)
    error = 1e3 * float(np.hypot(fix.x[0] - at[0], fix.y[0] - at[1]))
    _zoom(near, drawn, at, (float(fix.x[0]), float(fix.y[0])))
    _distributions(share, accuracy, study.choices.degree)
    here = accuracy.drawn["three", study.choices.degree]
    others = ", ".join(
        f"degree {degree}: median {accuracy.drawn['three', degree].percentile(50):.2f} mm, 0.122 mm at "
        f"{accuracy.drawn['three', degree].share_below(PAPER.error_mm):.0f} %"
        for degree in sorted(
            {degree for layout, degree in accuracy.drawn if layout == "three"} - {study.choices.degree}
        )
    )
    return Entry(
        "Fig. 10",
        "Contours from a polynomial on each line and a spline through its roots; the crossings and their mean; the "
        "errors over the working area.",
        figure,
        [
            Row(
                "are the three contours concurrent?",
                "no",
                f"no: {1e3 * fix.spread[0]:.3f} mm from the mean" if fix.found[0] else "no",
                "error of polynomial and spline",
            ),
            Row(
                "the shown press, distance from the mean of the crossings",
                "0.122 mm (place not given)",
                f"{error:.3f} mm" if fix.found[0] else Meeting(int(fix.status[0])).words,
                "the place of the paper's press is not given",
            ),
            Row(
                "percentile of 0.122 mm over the working area",
                "0.122 mm",
                f"{here.share_below(PAPER.error_mm):.0f} %; median {here.percentile(50):.3f}, "
                f"95 % {here.percentile(95):.3f} mm; "
                f"contours met for {here.fix.found.sum()} of {len(here.at)} presses",
                f"polynomials of degree {study.choices.degree}, our choice; {others}",
            ),
        ],
        {
            "shown_error_mm": error,
            **{f"{layout}_degree_{degree}": e.numbers() for (layout, degree), e in accuracy.drawn.items()},
        },
    )


def _zoom(axes: Any, drawn: list[DrawnContour], at: tuple[float, float], mean: tuple[float, float]) -> None:
    crossings: list[Array] = []
    for one, other in combinations(drawn, 2):
        points = one.crossings(other)
        if len(points):
            crossings.append(points[np.argmin(np.linalg.norm(points - np.array(at), axis=1))])
    if crossings:
        axes.plot(*1e3 * np.array(crossings).T, "o", mfc="none", color=INK, ms=8, label="crossings")
    axes.plot(1e3 * mean[0], 1e3 * mean[1], "x", color=INK, ms=9, mew=2, label="their mean")
    axes.plot(1e3 * at[0], 1e3 * at[1], "+", color=FELT, ms=12, mew=2, label="the press")
    reach = 0.6
    axes.set(xlim=(1e3 * at[0] - reach, 1e3 * at[0] + reach), ylim=(1e3 * at[1] - reach, 1e3 * at[1] + reach))
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


def fig_11(study: Solves) -> Entry:
    """Contours of all four electrodes under a circle."""
    sensor = study.choices.sensor("four")
    film = study.film("circle", sensor)
    field = ContourField.of(film, FORCE, AREA, study.choices.spacing)
    figure = new_figure(12.6, 6.6)
    left, right = figure.subplots(1, 2)
    reached = {}
    for name, colour in zip(sensor.electrode_names, COLOURS, strict=False):
        levels = field.even_charges(name, LEVELS)
        pieces = [piece for q in levels for piece in field.contours(name, q)]
        draw_contours(left, pieces, colour, f"{name}, {1e12 * min(levels):.0f} to {1e12 * max(levels):.0f} pC", 0.9)
        reached[name] = [1e12 * q for q in field.reach(name)]
        if name == sensor.electrode_names[0]:
            _one_electrode(right, field, name, colour)
    for axes, title in ((left, "Fig. 11: all four electrodes, circle of 1 mm, 1 N"), (right, "electrode A alone, pC")):
        draw_electrodes(axes, sensor)
        draw_working_area(axes, study.choices.radius, "working area")
        draw_probe(axes, study.choices.circle, (0.0, 0.0), "probe")
        frame_film(axes, sensor, AREA, title)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncols=6)
    apart = _apart_from_triangle(study)
    return Entry(
        "Fig. 11",
        "Isocharge contours of all four electrodes; on the right those of A with their charges.",
        figure,
        [
            Row(
                "charges met in the central area",
                "in the figure",
                f"{reached['A'][0]:.0f} to {reached['A'][1]:.0f} pC on A, within {1e3 * AREA:g} mm",
                "E, d31, d32 are our choice; largest with the probe on the electrode",
            ),
            Row(
                "contours change with the probe's shape",
                "they may",
                f"triangle of 4 mm against circle of 1 mm: a charge changes by {100 * apart[0]:.1f} % at the median, "
                f"{100 * apart[1]:.0f} % at most",
                "shape matters beside an electrode only",
            ),
        ],
        {"reached_pC": reached, "triangle_against_circle_median": apart[0], "triangle_against_circle_worst": apart[1]},
    )


def _one_electrode(axes: Any, field: ContourField, name: str, colour: str) -> None:
    for q in field.even_charges(name, LEVELS):
        pieces = field.contours(name, q)
        draw_contours(axes, pieces, colour)
        for piece in pieces[:1]:
            end = piece.points[-1 if piece.points[-1, 1] > piece.points[0, 1] else 0]
            out = 9.0 * end / np.linalg.norm(end)
            label = {"xytext": tuple(out), "textcoords": "offset points", "fontsize": 7, "ha": "center", "va": "center"}
            axes.annotate(f"{1e12 * q:.0f}", 1e3 * end, **label)


def _apart_from_triangle(study: Solves) -> tuple[float, float]:
    """Relative change of a charge from the circle to the triangle over the working area: median and largest."""
    sensor, places = study.choices.sensor("four"), study.places
    circle, triangle = (study.charges(probe, sensor, places) for probe in ("circle", "triangle"))
    change = np.abs(triangle / circle - 1.0)
    return float(np.median(change)), float(change.max())
