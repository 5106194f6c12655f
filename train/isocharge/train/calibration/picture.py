"""The picture of a calibration: error left over the film before and after, quantities with their intervals, misses."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from isocharge.common.arrays import Array
from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_electrodes, draw_working_area, frame_film
from isocharge.train.calibration.calibrate import Calibration
from isocharge.train.calibration.contact_error import ContactError

LEVELS_MM = (0.02, 5.0)
"""Errors at the ends of the colours, mm."""

TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Errors that the colour bar names, mm."""

ASSUMED, FITTED = "#b9c4cf", "#3a7ca5"
"""Colours of what was assumed before the presses and of what they say."""


def calibration_picture(calibration: Calibration) -> Figure:
    """Maps of the error that the film leaves, quantities in units of what was assumed, misses of the presses."""
    figure = new_figure(15.0, 9.4)
    (before, after), (identified, misses) = figure.subplots(2, 2, height_ratios=(1.15, 1.0))
    for axes, error, title in (
        (before, calibration.left_before, "before the presses"),
        (after, calibration.left, f"after {len(calibration.presses)} presses"),
    ):
        shades = _draw_error(axes, calibration, error)
        axes.set_title(f"{title}: {error.position_mm:.2g} mm, {error.force_percent:.2g} % of force (rms)")
    _draw_presses(after, calibration)
    figure.colorbar(
        shades, ax=[before, after], label="position error by not knowing the film (rms), mm", ticks=TICKS, format="%g"
    )
    _draw_quantities(identified, calibration)
    _draw_misses(misses, calibration)
    figure.suptitle(f"calibration of {calibration.film[0].name}", fontsize=13)
    return figure


def _draw_error(axes: Any, calibration: Calibration, error: ContactError) -> Any:
    x, y, _ = calibration.sensitivity.contact.T
    levels = np.geomspace(*LEVELS_MM, 25)
    smooth = _smoothed(np.column_stack([x, y]), error.each_mm)
    shades = axes.tricontourf(Triangulation(x, y), np.clip(smooth, *LEVELS_MM), levels, norm=LogNorm(), cmap="viridis")
    sensor, radius_mm = calibration.film[0], calibration.scene.domain.radius_mm
    draw_electrodes(axes, sensor)
    draw_working_area(axes, 1e-3 * radius_mm)
    frame_film(axes, sensor, 1e-3 * radius_mm)
    return shades


def _smoothed(position: Array, values: Array, neighbours: int = 12) -> Array:
    """Root mean square over the nearest contacts: neighbours have different forces."""
    distance = np.hypot(*(position[:, None] - position[None, :]).T)
    nearest = np.argsort(distance, axis=1)[:, :neighbours]
    smoothed: Array = np.sqrt((values[nearest] ** 2).mean(axis=1))
    return smoothed


def _draw_presses(axes: Any, calibration: Calibration) -> None:
    contact, bad = calibration.posterior.contact, calibration.posterior.bad
    axes.plot(*contact[~bad, :2].T, "o", color="white", mec=INK, ms=6, label="presses")
    if bad.any():
        axes.plot(*contact[bad, :2].T, "X", color=FELT, mec=INK, ms=9, label="left out")
    axes.legend(loc="upper right", fontsize=8)


def _draw_quantities(axes: Any, calibration: Calibration) -> None:
    """95 % intervals after the presses within those before, each in units of the standard deviation before."""
    quantities = list(calibration.quantities.values())[::-1]
    row = np.arange(len(quantities))
    axes.barh(row, 4.0, left=-2.0, color=ASSUMED, height=0.72, label="assumed before, 95 %")
    before = calibration.before.parameters / calibration.scene.charges.prior.std
    now = calibration.posterior.parameters / calibration.scene.charges.prior.std
    for number, quantity in enumerate(quantities):
        centre = float(quantity.weights @ (now - before)) / quantity.before_std
        half = 1.96 * quantity.std / quantity.before_std
        axes.plot([centre - half, centre + half], [number, number], color=FITTED if quantity.identified else INK, lw=5)
        axes.plot(centre, number, "|", color="white", ms=9)
        axes.annotate(
            f"{quantity.value:.3g} ± {quantity.std:.2g}", (4.2, number), va="center", fontsize=8, annotation_clip=False
        )
    axes.plot([], [], color=FITTED, lw=5, label="identified by the presses, 95 %")
    axes.plot([], [], color=INK, lw=5, label="not identified")
    axes.set(yticks=row, yticklabels=[quantity.name for quantity in quantities], xlim=(-4.0, 4.0))
    axes.set(xlabel="from what was assumed, in its standard deviations", title="what the presses tell")
    axes.tick_params(axis="y", labelsize=8)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3)


def _draw_misses(axes: Any, calibration: Calibration) -> None:
    posterior = calibration.posterior
    miss = np.sqrt(posterior.chi2 / np.maximum(posterior.freedom, 1.0))
    colours = [FELT if bad else FITTED for bad in posterior.bad]
    axes.bar(np.arange(len(miss)), np.minimum(miss, 10.0), color=colours)
    axes.axhline(1.0, color=INK, lw=0.8, ls="--")
    lines = calibration.presses.lines
    every = max(1, len(lines) // 20)
    axes.set(xticks=np.arange(0, len(lines), every), xticklabels=[lines[i] for i in range(0, len(lines), every)])
    axes.set(xlabel="line of the press", ylabel="miss over what noise and rig explain", title="how well the film fits")
