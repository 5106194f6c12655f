"""Fig. 9 to 11 of the paper: triangulation and isocharge contours."""

from itertools import combinations
from typing import Any

import numpy as np
from axes import draw_probe, finish_axes, new_axes
from choices import ERROR_MM, Choices
from drawing import DrawnContour, DrawnTriangulation
from matplotlib.figure import Figure
from page import Entry, Row
from solves import FORCE, Solves
from triangulation_errors import BEYOND, Accuracy

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeMap, ChargeSpline, Sensor
from isocharge.simulate.forward.charge_map import within
from isocharge.simulate.numerics.disk import INNER_RADIUS
from isocharge.simulate.plots.figure import COLOURS, FELT, INK
from isocharge.simulate.plots.film import draw_electrodes, draw_working_area, frame_film

LEVELS = 8
AREA = 11.5
"""Number of contours of each electrode in Fig. 11, and their largest distance from the centre, mm. This distance is
that of the far sides of the electrodes."""

AROUND = 0.6
"""Half of the side of the square that is shown around the press, mm."""


def fig_9(solves: Solves, accuracy: Accuracy) -> Entry:
    """Return the entry of Fig. 9: contours of a press by a triangle, computed from the charge map."""
    sensor = solves.choices.sensor("three")
    at = solves.choices.shown
    reach = BEYOND * solves.choices.radius
    charges = solves.charges("triangle", sensor, np.array([at]))[0]
    spline = within(ChargeSpline.of(solves.forward_map("triangle", sensor), solves.choices.spacing), reach)
    x, y, field = charge_field(spline)
    figure, axes = new_axes(6.6, 7.0)
    for name, charge, values, colour in zip(sensor.electrode_names, charges, field, COLOURS, strict=False):
        axes.contour(x, y, values, [charge], colors=colour, linewidths=1.2)
        axes.plot([], [], color=colour, label=f"{name}, {charge:.0f} pC")
    draw_electrodes(axes, sensor)
    draw_probe(axes, solves.choices.triangle, at, "probe")
    draw_working_area(axes, solves.choices.radius, "working area")
    frame_film(axes, sensor, reach, "Fig. 9: triangulation with a triangular probe, from the field")
    figure.legend(fontsize=8, loc="outside lower center", ncols=5)
    errors = accuracy.field["three"]
    row = Row(
        "distance from the press to the point nearest to the contours, from the field",
        "not done",
        f"median {errors.percentile(50):.1g} mm, 95 % {errors.percentile(95):.1g} mm; contours met for "
        f"{errors.fix.found.sum()} of {len(errors.at)} presses",
        "without the error of the drawing the contours meet",
    )
    caption = f"Isocharge contours of a press at ({at[0]:g}, {at[1]:g}) mm, 1 N, from the field."
    return Entry("Fig. 9", caption, figure, [row], errors.numbers())


def fig_10(solves: Solves, accuracy: Accuracy) -> Entry:
    """Return the entry of Fig. 10: the graphical method of the paper, and its error of 0.122 mm compared with ours."""
    sensor = solves.choices.sensor("three")
    at = solves.choices.shown
    triangulation = DrawnTriangulation(solves.scheme("triangle", sensor), solves.choices.degree)
    charge = solves.charges("triangle", sensor, np.array([at]))
    contours = [c for c in triangulation.contours(charge[0]) if c is not None]
    fix = triangulation.locate(charge)
    error_mm = float(np.hypot(*(fix.contact[0, :2] - at)))
    figure, (whole, near, distribution) = new_axes(16.5, 5.6, columns=3)
    for axes in (whole, near):
        for contour, colour in zip(contours, COLOURS, strict=False):
            axes.plot(*contour.points.T, color=colour, lw=1.3, label=f"{contour.electrode}, {contour.charge:.0f} pC")
            axes.plot(*contour.knots.T, ".", color=colour, ms=5)
    draw_probe(whole, solves.choices.triangle, at)
    draw_electrodes(whole, sensor)
    frame_film(whole, sensor, BEYOND * solves.choices.radius, "Fig. 10: contours as the paper draws them")
    whole.legend(fontsize=8)
    _zoom(near, contours, np.array(at), fix.contact[0, :2])
    _distributions(distribution, accuracy, solves.choices.degree)
    rows = [
        Row(
            "are the three contours concurrent?",
            "no",
            f"no: {fix.spread[0]:.3f} mm from the mean" if fix.found[0] else "no",
            "error of polynomial and spline",
        ),
        Row(
            "the shown press, distance from the mean of the crossings",
            "0.122 mm (place not given)",
            f"{error_mm:.3f} mm" if fix.found[0] else "the contours do not meet",
            "the place of the paper's press is not given",
        ),
        _row_of_percentile(accuracy, solves.choices.degree),
    ]
    return Entry(
        "Fig. 10",
        "Contours from a polynomial on each line and a spline through its roots; the crossings and their mean; the "
        "errors over the working area.",
        figure,
        rows,
        {
            "shown_error_mm": error_mm,
            **{f"{layout}_degree_{degree}": errors.numbers() for (layout, degree), errors in accuracy.drawn.items()},
        },
    )


def _row_of_percentile(accuracy: Accuracy, degree: int) -> Row:
    """Return the row with the percentile of the error of the paper among our errors over the working area.

    The percentile is stated for our degree of the polynomials and for other degrees.
    """
    errors = accuracy.drawn["three", degree]
    others = ", ".join(
        f"degree {other}: median {its.percentile(50):.2f} mm, 0.122 mm at {its.share_below(ERROR_MM):.0f} %"
        for (layout, other), its in accuracy.drawn.items()
        if layout == "three" and other != degree
    )
    return Row(
        "share of all presses over the working area with an error below 0.122 mm",
        "0.122 mm",
        f"{errors.share_below(ERROR_MM):.0f} %; median {errors.percentile(50):.3f}, "
        f"95 % {errors.percentile(95):.3f} mm; "
        f"contours met for {errors.fix.found.sum()} of {len(errors.at)} presses",
        f"polynomials of degree {degree}, our choice; {others}",
    )


def _zoom(axes: Any, drawn: list[DrawnContour], at: Array, mean: Array) -> None:
    """Draw the crossings of contours next to the press, and their mean.

    Args:
        axes: Axes of matplotlib.
        drawn: The contours.
        at: Position (x, y) of the press, shape (2,), mm.
        mean: Mean of the crossings, shape (2,), mm.
    """
    crossings = (one.crossings(other) for one, other in combinations(drawn, 2))
    nearest = [points[np.argmin(np.linalg.norm(points - at, axis=1))] for points in crossings if len(points)]
    axes.plot(*np.reshape(nearest, (-1, 2)).T, "o", mfc="none", color=INK, ms=8, label="crossings")
    axes.plot(*mean, "x", color=INK, ms=9, mew=2, label="their mean")
    axes.plot(*at, "+", color=FELT, ms=12, mew=2, label="the press")
    axes.set(
        xlim=(at[0] - AROUND, at[0] + AROUND),
        ylim=(at[1] - AROUND, at[1] + AROUND),
        aspect="equal",
        xlabel="x, mm",
        ylabel="y, mm",
        title="near the press",
    )
    axes.legend(fontsize=8)


def _distributions(axes: Any, accuracy: Accuracy, degree: int) -> None:
    """Draw the distributions of the position errors over the working area."""
    for errors, label, colour, style in (
        (accuracy.drawn["three", degree], "three, as the paper", COLOURS[0], "-"),
        (accuracy.drawn["four", degree], "four, as the paper", COLOURS[1], "-"),
        (accuracy.field["three"], "three, from the field", COLOURS[0], "--"),
        (accuracy.field["four"], "four, from the field", COLOURS[1], "--"),
    ):
        rising = np.maximum(errors.found_mm, 1e-6)
        share = 100.0 * (np.arange(rising.size) + 0.5) / rising.size
        axes.semilogx(rising, share, style, color=colour, label=label)
    axes.axvline(ERROR_MM, color=INK, lw=1.0, ls=":", label=f"the paper's {ERROR_MM:g} mm")
    share = "presses found with at most this error, %"
    finish_axes(axes, "distance from the press, mm", share, "over the working area")


def fig_11(solves: Solves) -> Entry:
    """Return the entry of Fig. 11: contours of all four electrodes under a circle."""
    sensor = solves.choices.sensor("four")
    spline = within(ChargeSpline.of(solves.forward_map("circle", sensor), solves.choices.spacing), AREA)
    x, y, field = charge_field(spline)
    reached_pC = {
        name: [float(values.min()), float(values.max())]
        for name, values in zip(sensor.electrode_names, field, strict=True)
    }
    circle, triangle = (solves.charges(probe, sensor, solves.places) for probe in ("circle", "triangle"))
    change = np.abs(triangle / circle - 1.0)
    rows = [
        Row(
            "charges met in the central area",
            "in the figure",
            f"{reached_pC['A'][0]:.0f} to {reached_pC['A'][1]:.0f} pC on A, within {AREA:g} mm",
            "E, d31, d32 are our choice; largest with the probe on the electrode",
        ),
        Row(
            "contours change with the probe's shape",
            "they may",
            f"triangle of 4 mm against circle of 1 mm: a charge changes by {100 * np.median(change):.1f} % at the "
            f"median, {100 * change.max():.0f} % at most",
            "shape matters beside an electrode only",
        ),
    ]
    numbers = {
        "reached_pC": reached_pC,
        "triangle_against_circle_median": np.median(change),
        "triangle_against_circle_worst": change.max(),
    }
    caption = "Isocharge contours of all four electrodes; on the right those of A with their charges."
    return Entry("Fig. 11", caption, _draw_fig_11(solves.choices, sensor, (x, y, field)), rows, numbers)


def _draw_fig_11(choices: Choices, sensor: Sensor, charge_field: tuple[Array, Array, Array]) -> Figure:
    """Draw the contours of all electrodes on the left, and those of the first electrode with their charges on the
    right."""
    x, y, field = charge_field
    figure, (left, right) = new_axes(12.6, 6.6, columns=2)
    for name, values, colour in zip(sensor.electrode_names, field, COLOURS, strict=False):
        levels = np.geomspace(values.min(), values.max(), LEVELS + 2)[1:-1]
        left.contour(x, y, values, levels, colors=colour, linewidths=0.9)
        left.plot([], [], color=colour, label=f"{name}, {levels[0]:.0f} to {levels[-1]:.0f} pC")
        if name == sensor.electrode_names[0]:
            lines = right.contour(x, y, values, levels, colors=colour, linewidths=1.2)
            right.clabel(lines, fmt="%.0f", fontsize=7, colors=INK)
    for axes, title in ((left, "Fig. 11: all four electrodes, circle of 1 mm, 1 N"), (right, "electrode A alone, pC")):
        draw_electrodes(axes, sensor)
        draw_working_area(axes, choices.radius, "working area")
        draw_probe(axes, choices.circle, (0.0, 0.0), "probe")
        frame_film(axes, sensor, AREA, title)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, loc="outside lower center", ncols=6)
    return figure


def charge_field(charge_map: ChargeMap) -> tuple[Array, Array, Array]:
    """Compute the charges of presses on rings.

    Args:
        charge_map: Map with a single force.

    Returns:
        Coordinates x and y, each of shape (n_ring, n_angle), mm, and charges, shape (n_electrode, n_ring, n_angle), pC.
    """
    distance = np.linspace(0.0, INNER_RADIUS * charge_map.domain.radius, 121)
    z = np.outer(distance, np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 361)))
    charge = charge_map.charges(np.column_stack([z.real.ravel(), z.imag.ravel(), np.full(z.size, FORCE)]))
    return z.real, z.imag, charge.T.reshape(-1, *z.shape)
