"""Fig. 6, 8 and 12 of the paper: the charge as a function of the distance."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from axes import finish_axes, new_axes, shades
from choices import CONTOUR_PC, FIG_8_DEG
from drawing import draw_contour
from mapping import Curves, Mapping
from matplotlib.figure import Figure
from page import Entry, Row
from solves import FORCE, Solves

from isocharge.common.arrays import Array
from isocharge.simulate import Piezo, Sensor
from isocharge.simulate.plots.figure import COLOURS, PRESSED

FROM_A_DEG = {"three": (35.0, 90.0), "four": (110.0, 250.0)}
"""First and last line from A, by layout."""

FINE = 97
"""Number of presses on a line that is drawn as a smooth curve."""

RATIOS = np.linspace(0.0, 2.0, 41)
"""Ratios d32 over d31 that are tried for the order of Fig. 8, dimensionless."""

Extreme = Callable[..., Any]
"""`np.argmax` or `np.argmin`."""


def curves_of(
    solves: Solves, probe: str, sensor: Sensor, name: str, degrees: tuple[float, float], length: float | None = None
) -> tuple[Curves, Curves]:
    """Return the charges at the presses of a mapping scheme, and at many presses along the same lines.

    Args:
        solves: Results of the solves.
        probe: Name of the probe; see `Solves.forward_map`.
        sensor: The sensor.
        name: Name of the electrode at which the lines start.
        degrees: First and last angle of the lines, degrees.
        length: Length of the lines, mm; None for our choice.
    """
    mapping = Mapping.lines(sensor, name, length or solves.choices.length, degrees)
    forward_map = solves.forward_map(probe, sensor)
    return Curves.of(forward_map, mapping, FORCE), Curves.of(forward_map, mapping.finer(FINE), FORCE)


def curve_numbers(curves: Curves) -> dict[str, object]:
    """Return curves as numbers for JSON."""
    return {
        "angle_deg": np.rad2deg(curves.mapping.angle).tolist(),
        "distance_mm": curves.mapping.distance.tolist(),
        "charge_pC": curves.charge.tolist(),
    }


def fig_6(solves: Solves) -> Entry:
    """Return the entry of Fig. 6: a triangle on a biaxial film, on lines from A, with three and four electrodes."""
    figure, pair = new_axes(12.6, 5.2, columns=2)
    sensors = {layout: solves.choices.sensor(layout) for layout in FROM_A_DEG}
    both = {name: curves_of(solves, "triangle", sensors[name], "A", degrees) for name, degrees in FROM_A_DEG.items()}
    for axes, (layout, (curves, line)) in zip(pair, both.items(), strict=True):
        draw_curves(axes, curves, line)
        axes.axhline(CONTOUR_PC, color="k", lw=0.8, ls=":")
        axes.annotate(f"{CONTOUR_PC:g} pC", (4, CONTOUR_PC), fontsize=8, va="bottom")
        axes.set_title(f"Fig. 6: triangular probe, biaxial film, {layout} electrodes, 1 N")
    at, smooth = both["three"]
    whole = solves.choices.sensor("three", readout="area")
    area, _ = curves_of(solves, "triangle", whole, "A", FROM_A_DEG["three"])
    example, distance = _example(solves, at, smooth)
    apart = 100.0 * _spread(at)
    change = 100.0 * np.abs(at.charge / area.charge - 1.0).max(axis=0)
    rows = [
        example,
        Row(
            "how far the lines lie apart",
            "in the figure",
            _at_distances(at, apart),
            "round film, biaxial coefficients: the angle hardly matters, but for the triangle's corners near by",
        ),
        Row(
            "edge against area readout on these lines",
            "edges are precise",
            _at_distances(at, change),
            "the stress is not linear across an electrode near the probe",
        ),
    ]
    numbers = {
        **curve_numbers(at),
        "four_electrodes": curve_numbers(both["four"][0]),
        "distance_of_650_pC_mm": distance,
        "spread_of_lines": 0.01 * apart,
    }
    caption = f"Charge of A under a triangle; the dotted line is the paper's example of {CONTOUR_PC:g} pC."
    return Entry("Fig. 6", caption, figure, rows, numbers)


def _example(solves: Solves, at: Curves, smooth: Curves) -> tuple[Row, Array]:
    """Return the row about the contour of 650 pC, and the distances (mm) at which the lines have this charge."""
    contour = draw_contour(at, CONTOUR_PC, solves.choices.degree)
    knots = np.empty((0, 2)) if contour is None else contour.knots
    distance = np.linalg.norm(knots - at.mapping.origin, axis=1)
    exact = np.array([np.interp(-CONTOUR_PC, -q, smooth.mapping.distance) for q in smooth.charge])
    row = Row(
        f"{CONTOUR_PC:g} pC, distance from A on lines of 35° to 90°",
        "x1 to x7, in the figure",
        f"{len(knots)} lines, {distance.min():.2f} to {distance.max():.2f} mm" if len(knots) else "not reached",
        f"by the field {exact.min():.2f} to {exact.max():.2f} mm; E, d31 and the probe's size are our choice",
    )
    return row, distance


def _at_distances(curves: Curves, percent: Array) -> str:
    return ", ".join(f"{p:.1f} % at {d:g} mm" for p, d in zip(percent, curves.mapping.distance, strict=True))


def _spread(curves: Curves) -> Array:
    """Return the difference of the largest and the smallest charge of the lines over their mean, at each distance."""
    return np.ptp(curves.charge, axis=0) / curves.charge.mean(axis=0)


def fig_8(solves: Solves) -> Entry:
    """Return the entry of Fig. 8: a rectangle on a biaxial film, on lines from B, and which line is uppermost."""
    sensor = solves.choices.sensor("three")
    printed_length = solves.choices.printed_length
    curves, smooth = curves_of(solves, "rectangle", sensor, "B", FIG_8_DEG)
    circle, _ = curves_of(solves, "circle", sensor, "B", FIG_8_DEG)
    printed, _ = curves_of(solves, "rectangle", solves.choices.as_printed(), "B", FIG_8_DEG, printed_length)
    ratio, share = _best_ratio(solves)
    numbers = {
        **curve_numbers(curves),
        "uppermost_deg": _angles(curves, np.argmax),
        "lowermost_deg": _angles(curves, np.argmin),
        "uppermost_as_printed_deg": _angles(printed, np.argmax),
        "lowermost_as_printed_deg": _angles(printed, np.argmin),
        "best_d32_over_d31": ratio,
        "share_of_distances_in_order": share,
    }
    why = (
        "from our B 210° leads to the film's centre and 140° farthest from it; nearer the rim a press stretches the "
        "electrode less. Beside the electrode the rectangle's long side, along x, counts more"
    )
    in_order = f"140° uppermost and 240° lowermost at {100 * share:.0f} % of the distances"
    rows = [
        Row("uppermost line at 4, 8, ... mm", "140° throughout", _extreme(curves, np.argmax), why),
        Row(
            "lowermost line at 4, 8, ... mm",
            "240° throughout",
            _extreme(curves, np.argmin),
            "the reverse of the claim, farther out",
        ),
        Row("under a circle", "not given", _extremes(circle), "no corners: what is left is the place of the rim"),
        Row(
            "with B at 60° from the centre, as printed",
            "140° uppermost, 240° lowermost",
            _extremes(printed),
            "the layout's angles do not explain it",
        ),
        Row(
            "with another d32 over d31",
            "not given",
            in_order + (f", with d32/d31 = {ratio:.2f}" if share else ""),
            f"{'explains it' if share == 1.0 else 'does not explain it'}; tried {RATIOS[0]:g} to {RATIOS[-1]:g}",
        ),
    ]
    caption = "Charge of B under a rectangle of 4 x 2 mm; on the right each line against the mean of all."
    return Entry("Fig. 8", caption, _draw_fig_8(curves, smooth), rows, numbers)


def _draw_fig_8(curves: Curves, smooth: Curves) -> Figure:
    """Draw the curves on the left, and the ratio of each curve to the mean of all curves on the right.

    The two lines that the paper names are highlighted.
    """
    figure, (left, right) = new_axes(12.0, 5.2, columns=2)
    draw_curves(left, curves, smooth)
    left.set_title("Fig. 8: rectangular probe, biaxial film, 1 N")
    others = {"color": PRESSED, "lw": 0.7}
    mean = smooth.charge.mean(axis=0)
    styles = {190.0: others | {"label": "the others"}} | {
        named: {"color": colour, "lw": 2.4, "label": f"{named:.0f}°"}
        for named, colour in zip(FIG_8_DEG, COLOURS, strict=False)
    }
    for angle, charge in zip(np.rad2deg(curves.mapping.angle).round(6).tolist(), smooth.charge, strict=True):
        right.plot(smooth.mapping.distance, 100.0 * (charge / mean - 1.0), **styles.get(angle, others))
    ratio = "charge over the mean of the lines, %"
    title = "the same, against the mean of the lines"
    finish_axes(right, "distance from the centre of B, mm", ratio, title)
    return figure


def _angles(curves: Curves, extreme: Extreme) -> list[float]:
    """Angle of the line with the largest or smallest charge at each distance, degrees."""
    index = extreme(curves.charge, axis=0)
    return [round(float(angle), 6) for angle in np.rad2deg(curves.mapping.angle[index])]


def _extreme(curves: Curves, extreme: Extreme) -> str:
    return ", ".join(f"{angle:.0f}°" for angle in _angles(curves, extreme))


def _extremes(curves: Curves) -> str:
    return f"uppermost {_extreme(curves, np.argmax)}; lowermost {_extreme(curves, np.argmin)}"


def _best_ratio(solves: Solves) -> tuple[float, float]:
    """Return the ratio d32 / d31 with which the order of Fig. 8 holds at most distances, and the share of them."""
    sensor = solves.choices.sensor("three")
    by_d31, by_d32 = (
        curves_of(solves, "rectangle", replace(sensor, piezo=piezo), "B", FIG_8_DEG)[0].charge
        for piezo in (Piezo(d31=1.0, d32=0.0), Piezo(d31=0.0, d32=1.0))
    )
    best = (0.0, 0.0)
    for ratio in RATIOS.tolist():
        charge = by_d31 + ratio * by_d32
        share = float(np.mean((charge.argmax(axis=0) == 0) & (charge.argmin(axis=0) == len(charge) - 1)))
        best = max(best, (share, ratio))
    return best[1], best[0]


def fig_12(solves: Solves) -> Entry:
    """Return the entry of Fig. 12: a triangle on a uniaxial film, on lines from A, compared with a biaxial film."""
    figure, pair = new_axes(12.0, 5.2, columns=2)
    numbers = {}
    rows = []
    for axes, (layout, degrees) in zip(pair, FROM_A_DEG.items(), strict=True):
        uniaxial, smooth = curves_of(solves, "triangle", solves.choices.sensor(layout, "uniaxial"), "A", degrees)
        biaxial, _ = curves_of(solves, "triangle", solves.choices.sensor(layout), "A", degrees)
        draw_curves(axes, uniaxial, smooth)
        axes.set_title(f"Fig. 12: triangular probe, uniaxial, {layout} electrodes, 1 N")
        apart = [100.0 * _spread(curves) for curves in (biaxial, uniaxial)]
        rows.append(
            Row(
                f"how far the lines lie apart, {layout} electrodes",
                "more distinct and separated",
                f"{apart[1].min():.0f} to {apart[1].max():.0f} % of the charge, "
                f"biaxial {apart[0].min():.0f} to {apart[0].max():.0f} %",
                "d31 : d32 = 20 : 2 pC/N, our choice, weighs the radial against the hoop stress by the angle",
            )
        )
        numbers[layout] = {**curve_numbers(uniaxial), "spread": 0.01 * apart[1], "spread_biaxial": 0.01 * apart[0]}
    caption = "Charge of A on a uniaxial film under a triangle of 4 mm, with three and with four electrodes."
    return Entry("Fig. 12", caption, figure, rows, numbers)


def draw_curves(axes: Any, points: Curves, lines: Curves) -> None:
    """Draw the charge against the distance on each line of a mapping.

    Args:
        axes: Axes of matplotlib.
        points: Charges at the presses of the scheme, which are drawn as marks.
        lines: Charges at many presses along the same lines, which are drawn as lines.
    """
    colours = shades(points.mapping.angle.size)
    for angle, colour, marks, line in zip(points.mapping.angle, colours, points.charge, lines.charge, strict=True):
        axes.plot(points.mapping.distance, marks, "o", color=colour, ms=3.5)
        axes.plot(lines.mapping.distance, line, "-", color=colour, lw=1.1, label=f"{np.rad2deg(angle):.0f}°")
    name = points.mapping.electrode
    axes.set(xlabel=f"distance from the centre of {name}, mm", ylabel=f"charge of {name}, pC")
    axes.grid(alpha=0.3)
    axes.legend(title="line from x", fontsize=8, ncols=2)
