"""The demo's page of pictures: one press, the charge maps, the live path, the errors of the model."""

from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.stats import binned_statistic

from isocharge.common.arrays import Array
from isocharge.simulate import Equilibrium, ForwardMap
from isocharge.simulate.plots.figure import FELT, PRESSED, new_figure, save_picture
from isocharge.simulate.plots.film import (
    draw_charge_map,
    draw_deflection,
    draw_electrodes,
    draw_section,
    draw_working_area,
    frame_film,
)


def draw_page(forward_map: ForwardMap, equilibrium: Equilibrium, followed: Array, tested: Array, path: Path) -> None:
    """Draw the page and write it.

    Args:
        forward_map: The film.
        equilibrium: The press that is shown.
        followed: Live presses: number, true and estimated (x, y, F), shape (n, 7), mm and N.
        tested: Test presses, true and estimated, shape (m, 6).
        path: The picture.
    """
    count = len(forward_map.electrodes)
    figure = new_figure(15.0, 9.2)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))
    left, middle, right = top.subplots(1, 3)
    draw_deflection(left, equilibrium)
    draw_electrodes(left, forward_map.sensor, names=False)
    draw_section(middle, equilibrium)
    _path(right, forward_map, followed)
    maps = bottom.subplots(1, count + 1, width_ratios=(*(1.0,) * count, 1.25))
    for number, (axes, name) in enumerate(zip(maps, forward_map.electrodes, strict=False)):
        draw_charge_map(axes, forward_map, number)
        draw_electrodes(axes, forward_map.sensor, highlight=name)
        _frame(axes, forward_map, f"isocharge contours of {name} at 1 N, pC")
    _error_against_force(maps[-1], tested[:, 2], np.hypot(*(tested[:, 3:5] - tested[:, :2]).T))
    figure.suptitle(f"isocharge demo: {forward_map.sensor.name}, {forward_map.probe.notation}", fontsize=14)
    save_picture(figure, path)


def _frame(axes: Any, forward_map: ForwardMap, title: str) -> None:
    draw_working_area(axes, forward_map.domain.radius)
    frame_film(axes, forward_map.sensor, forward_map.domain.radius, title)


def _path(axes: Any, forward_map: ForwardMap, followed: Array) -> None:
    for number in np.unique(followed[:, 0]):
        frames = followed[followed[:, 0] == number]
        labels = ("pressed", "estimated") if number == followed[0, 0] else (None, None)
        axes.plot(*frames[:, 1:3].T, color=PRESSED, lw=3.0, solid_capstyle="round", label=labels[0])
        axes.plot(*frames[:, 4:6].T, color=FELT, lw=0.7, label=labels[1])
    axes.legend(loc="upper right")
    draw_electrodes(axes, forward_map.sensor)
    _frame(axes, forward_map, "live path, through the port")


def _error_against_force(axes: Any, force: Array, error: Array) -> None:
    axes.loglog(force, error, ".", color=PRESSED, ms=2, alpha=0.5)
    edges = np.geomspace(force.min(), force.max(), 13)
    for share, style, label in ((50, "-", "median"), (95, "--", "95 %")):
        line = binned_statistic(force, error, partial(np.percentile, q=share), edges).statistic
        axes.plot(np.sqrt(edges[:-1] * edges[1:]), line, style, color=FELT, label=label)
    axes.legend()
    axes.set(title="position error of test presses", xlabel="force, N", ylabel="error, mm")
    axes.set_ylim(bottom=2e-3)
    axes.grid(alpha=0.3, which="both")
