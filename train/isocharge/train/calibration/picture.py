"""Picture of a calibration, with maps of the contact error, intervals of the properties, and residuals."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from matplotlib.tri import Triangulation

from isocharge.common.arrays import Array
from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_layout
from isocharge.train.calibration.contact_error import N_CONTACTS, PLANNED, ContactError, spread_contacts
from isocharge.train.calibration.result import CalibrationResult

LEVELS_MM = (0.02, 5.0)
"""Position errors at both ends of the colour scale, mm."""

ASSUMED = "#b9c4cf"
"""Colour of the estimates before the presses."""

FITTED = "#3a7ca5"
"""Colour of the estimates after the presses, and of the residuals of good presses."""

NEIGHBOURS = 12
"""Number of neighbouring contacts over which the map of the error is averaged.

The map is averaged, because neighbouring contacts have different forces."""

MAX_DRAWN_RESIDUAL = 10.0
"""Height of the largest bar of a residual, relative to the expected size of the residual."""


def calibration_picture(result: CalibrationResult) -> Figure:
    """Draw the picture of a calibration.

    The picture contains maps of the position error before and after the presses, the intervals of the properties, and
    the residuals of the presses.

    Args:
        result: Result of the calibration.
    """
    figure = new_figure(11.0, 8.8)
    (before_axes, after_axes), (property_axes, residual_axes) = figure.subplots(2, 2, height_ratios=(1.15, 1.0))
    before = result.problem.prior.covariance(PLANNED)
    _draw_error(before_axes, result, before, result.film_error_before, "before the presses")
    after_title = f"after {len(result.presses)} presses"
    error_areas = _draw_error(after_axes, result, result.film.covariance, result.film_error, after_title)
    _draw_presses(after_axes, result)
    label = "position error by the film (rms), mm"
    figure.colorbar(
        error_areas, ax=[before_axes, after_axes], label=label, ticks=LogLocator(subs=(1.0, 2.0, 5.0)), format="%g"
    )

    _draw_properties(property_axes, result)
    _draw_residuals(residual_axes, result)
    figure.suptitle(f"calibration of {result.problem.sensor.name}", fontsize=13)
    return figure


def _draw_presses(axes: Any, result: CalibrationResult) -> None:
    """Draw the positions of the presses, and mark the presses that were left out as bad.

    Args:
        axes: Axes of matplotlib.
        result: Result of the calibration.
    """
    x, y, _ = result.estimation.contact.T
    is_bad = result.estimation.is_bad
    axes.plot(x[~is_bad], y[~is_bad], "o", color="white", mec=INK, ms=6, label="presses")
    if is_bad.any():
        axes.plot(x[is_bad], y[is_bad], "X", color=FELT, mec=INK, ms=9, label="left out")
    axes.legend(loc="upper right", fontsize=8)


def _draw_error(axes: Any, result: CalibrationResult, covariance: Array, error: ContactError, title: str) -> Any:
    """Draw the electrodes and a map of the position error due to the uncertainty of the film.

    Args:
        axes: Axes of matplotlib.
        result: The calibration, which defines the contacts of the map.
        covariance: Covariance of the unknowns of the film, shape (n_unknown, n_unknown).
        error: Root-mean-square errors of all contacts.
        title: Beginning of the title.

    Returns:
        The coloured areas, for which a colour bar can be drawn.
    """
    # Neighbouring contacts have different forces. Therefore, the map shows the rms error over several neighbours.
    x, y, _ = spread_contacts(result.problem.domain, N_CONTACTS).T
    distance = np.hypot(x[:, None] - x, y[:, None] - y)  # between all pairs of contacts, shape (n, n)
    nearest = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    error_mm = result.sensitivity.position_errors_mm(covariance)
    rms_error = np.sqrt((error_mm[nearest] ** 2).mean(axis=1))

    levels = np.geomspace(*LEVELS_MM, 25)
    error_areas = axes.tricontourf(
        Triangulation(x, y), np.clip(rms_error, *LEVELS_MM), levels, norm=LogNorm(), cmap="viridis"
    )
    sensor, _ = result.sensor_and_probe
    full_title = f"{title}:\n{error.position_mm:.2g} mm, {error.force_percent:.2g} % of force (rms)"
    draw_layout(axes, sensor, result.problem.domain.radius, full_title)
    return error_areas


def _draw_properties(axes: Any, result: CalibrationResult) -> None:
    """Draw the 95 % intervals of the properties before and after the presses.

    The horizontal axis shows the difference of each property from its value before the presses, in the standard
    deviations before the presses.

    Args:
        axes: Axes of matplotlib.
        result: Result of the calibration.
    """
    properties = dict(list(result.properties.items())[::-1])  # reversed, because rows are numbered from the bottom
    prior = result.problem.prior
    row = np.arange(len(properties))
    before = {name: float(prior.mean[prior.layout.index(name)]) for name in properties}
    centre = np.array([(one.value - before[name]) / one.before_std for name, one in properties.items()])
    half_width = np.array([2.0 * one.std / one.before_std for one in properties.values()])
    is_identified = np.array([one.identified for one in properties.values()])

    # The estimate after the presses is a white mark in the middle of its interval.
    axes.barh(row, 4.0, left=-2.0, color=ASSUMED, height=0.72, label="before the presses")
    for is_drawn, colour, label in (
        (is_identified, FITTED, "identified"),
        (~is_identified, INK, "not identified"),
    ):
        axes.errorbar(
            centre[is_drawn],
            row[is_drawn],
            xerr=half_width[is_drawn],
            fmt="w|",
            ecolor=colour,
            elinewidth=4,
            label=label,
        )
    for index, one in enumerate(properties.values()):
        unit = "" if one.unit == "1" else f" {one.unit}"
        value_text = f"{one.value:.2g} ± {one.std:.1g}{unit}"
        axes.annotate(value_text, (4.2, index), va="center", fontsize=7, annotation_clip=False)  # right of the axes
    axes.set(
        title="properties with 95 % intervals",
        xlabel="difference from the value before, in standard deviations",
        xlim=(-4.0, 4.0),
        yticks=row,
        yticklabels=[name.replace("_", " ") for name in properties],
    )
    axes.tick_params(axis="y", labelsize=7)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)


def _draw_residuals(axes: Any, result: CalibrationResult) -> None:
    """Draw the residual of each press as a bar, relative to the expected size of the residual.

    The height of a bar is limited to `MAX_DRAWN_RESIDUAL`. The bars of presses that were left out have another colour.

    Args:
        axes: Axes of matplotlib.
        result: Result of the calibration.
    """
    lines = result.presses.lines
    # A press without redundant measurements has no residual.
    relative_residual = np.sqrt(np.nan_to_num(result.estimation.press_chi2))
    colours = [FELT if bad else FITTED for bad in result.estimation.is_bad]
    axes.bar(lines, np.minimum(relative_residual, MAX_DRAWN_RESIDUAL), color=colours)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.axhline(1.0, color=INK, lw=0.8, ls="--")  # the expected size
    axes.set(
        title="residuals of the presses",
        xlabel=f"{result.presses.row_noun} of the press",
        ylabel="residual, relative to its expected size",
    )
