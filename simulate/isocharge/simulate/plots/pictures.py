"""Whole pictures: the charge curves of a mapping scheme, and isocharge contours with the position that they give."""

from collections.abc import Mapping, Sequence
from itertools import chain

from matplotlib.figure import Figure

from isocharge.simulate.contours.charge_curves import Curves
from isocharge.simulate.contours.field_contours import Contour, ContourField
from isocharge.simulate.contours.graphical_method import DrawnContour
from isocharge.simulate.plots.curves import draw_contours, draw_curves, draw_mapping
from isocharge.simulate.plots.figure import COLOURS, new_figure
from isocharge.simulate.plots.film import draw_electrodes, draw_probe, draw_working_area, frame_film
from isocharge.simulate.sensor.sensor import Sensor

MARGIN = 1e-3
"""Space around the lines of a mapping scheme, m."""

CORNER = 0.85
"""Where the probe is drawn if it has no position: this share of the radius left of the centre, and above it."""


def curves_picture(sensor: Sensor, curves: Curves, smooth: Curves) -> Figure:
    """Charge curves, and where their presses lie on the film.

    Args:
        sensor: The sensor.
        curves: Charges of the presses of a mapping scheme.
        smooth: The same lines with more presses.
    """
    figure = new_figure(12.0, 5.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    draw_curves(left, curves, smooth)
    draw_mapping(right, curves.mapping)
    draw_electrodes(right, sensor, highlight=curves.mapping.electrode)
    frame_film(right, sensor, curves.mapping.reach + MARGIN, f"lines from {curves.mapping.electrode}")
    figure.suptitle(f"{sensor.name}, {curves.probe.notation}, {curves.force:g} N")
    return figure


def contours_picture(
    field: ContourField,
    contours: Mapping[str, Sequence[tuple[Contour, ...]]],
    drawn: Mapping[str, Sequence[DrawnContour | None]],
    position: tuple[float, float] | None,
) -> Figure:
    """Contours of each electrode on the film, and the probe where they meet.

    Args:
        field: The charges over the disk.
        contours: Pieces of each contour, by electrode.
        drawn: The contours as the graphical method draws them, by electrode; may be empty.
        position: Where the contours meet (x, y), m; None if they do not, or are not those of one press.
    """
    forward_map, radius = field.forward_map, field.table.radius
    figure = new_figure(7.4, 8.0)
    axes = figure.subplots()
    for name, colour in zip(forward_map.electrode_names, COLOURS * len(contours), strict=False):
        draw_contours(axes, list(chain.from_iterable(contours.get(name, ()))), colour, f"{name}, from the field")
        for number, contour in enumerate(contour for contour in drawn.get(name, ()) if contour is not None):
            label = f"{name}, drawn" if number == 0 else None
            axes.plot(*1e3 * contour.points.T, "--", color=colour, lw=0.9, label=label)
    draw_electrodes(axes, forward_map.sensor)
    draw_working_area(axes, radius, f"within {1e3 * radius:g} mm")
    corner = (-CORNER * radius, CORNER * radius)
    draw_probe(axes, forward_map.probe, position or corner, "probe, where they meet" if position else "probe")
    title = f"isocharge contours: {forward_map.sensor.name}, {forward_map.probe.notation}, {field.force:g} N"
    frame_film(axes, forward_map.sensor, radius, title)
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    return figure
