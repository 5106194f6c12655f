"""Picture of a calibration, with a map of the position error and the residuals of the presses."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_layout
from isocharge.train.calibration.contact_error import spread_contacts
from isocharge.train.calibration.result import CalibrationResult

GOOD_PRESS_COLOUR = "#3a7ca5"
"""Colour of the residuals of good presses."""


def calibration_picture(result: CalibrationResult) -> Figure:
    """Draw the presses, their residuals, and a map of the position error that the uncertainty of the film causes.

    Args:
        result: Result of the calibration.
    """
    figure = new_figure(11.0, 4.8)
    figure.suptitle(f"calibration of {result.problem.sensor.name}", fontsize=13)
    map_axes, residual_axes = figure.subplots(1, 2)

    # The position error at each contact, the electrodes and the presses
    map_x, map_y, _ = spread_contacts(result.problem.domain).T
    position_error_mm = result.sensitivity.film_limits(result.film.covariance).position  # at each contact
    points = map_axes.scatter(map_x, map_y, c=position_error_mm, s=60)
    figure.colorbar(points, ax=map_axes, label="position error by the film, mm")
    error = result.film_error  # root mean square over the contacts
    sensor, _ = result.sensor_and_probe
    title = f"{len(result.presses)} presses leave {error.position_mm:.2g} mm, {error.force_percent:.2g} % of force"
    draw_layout(map_axes, sensor, result.problem.domain.radius, title)
    x, y, _ = result.estimation.contact.T  # of the presses
    is_bad = result.estimation.is_bad
    map_axes.plot(x[~is_bad], y[~is_bad], "o", color="white", mec=INK, ms=6, label="presses")
    if is_bad.any():
        map_axes.plot(x[is_bad], y[is_bad], "X", color=FELT, mec=INK, ms=9, label="left out")
    map_axes.legend(loc="upper right", fontsize=8)

    # The residual of each press, relative to the expected size. A press without redundant measurements has no residual.
    relative_residual = np.sqrt(np.nan_to_num(result.estimation.press_chi2))
    largest_shown = max(3.0, 1.1 * relative_residual[~is_bad].max(initial=0.0))
    residual_axes.bar(result.presses.lines, relative_residual, color=np.where(is_bad, FELT, GOOD_PRESS_COLOUR))
    residual_axes.set_ylim(0.0, largest_shown)  # presses that were left out may extend beyond
    residual_axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    residual_axes.axhline(1.0, color=INK, lw=0.8, ls="--")  # the expected size
    residual_axes.set(
        title="residuals of the presses",
        xlabel="line of the press",
        ylabel="residual, relative to its expected size",
    )
    return figure
