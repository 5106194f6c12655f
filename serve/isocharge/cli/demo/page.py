"""The demo's page of pictures: one press, the charge maps, the live path, the errors of the model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

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


@dataclass(frozen=True)
class Live:
    """What came over the port; n frames are those in which model and script agree that there is a contact.

    Attributes:
        pressed: True (x, y, F), shape (n, 3), mm and N.
        estimated: The model's (x, y, F), shape (n, 3).
        presses: Number of the press, shape (n,).
        frames, lost, repeated: Numbers of frames that arrived, did not arrive, and arrived twice.
    """

    pressed: Array
    estimated: Array
    presses: np.ndarray
    frames: int
    lost: int
    repeated: int


def draw_page(
    forward_map: ForwardMap, equilibrium: Equilibrium, live: Live, pressed: Array, estimated: Array, path: Path
) -> None:
    """Draw the page and write it; `pressed` and `estimated` are the test presses and answers, shape (m, 3)."""
    count = len(forward_map.electrodes)
    figure = new_figure(15.0, 9.2)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))
    left, middle, right = top.subplots(1, 3)
    draw_deflection(left, equilibrium)
    draw_electrodes(left, forward_map.sensor, names=False)
    draw_section(middle, equilibrium)
    _path(right, forward_map, live)
    maps = bottom.subplots(1, count + 1, width_ratios=(*(1.0,) * count, 1.25))
    for number, (axes, name) in enumerate(zip(maps, forward_map.electrodes, strict=False)):
        draw_charge_map(axes, forward_map, number)
        draw_electrodes(axes, forward_map.sensor, highlight=name)
        _frame(axes, forward_map, f"isocharge contours of {name} at 1 N, pC")
    _error_against_force(maps[-1], pressed[:, 2], np.hypot(*(estimated - pressed)[:, :2].T))
    figure.suptitle(f"isocharge demo: {forward_map.sensor.name}, {forward_map.probe.notation}", fontsize=14)
    save_picture(figure, path)


def _frame(axes: Any, forward_map: ForwardMap, title: str) -> None:
    draw_working_area(axes, forward_map.domain.radius)
    frame_film(axes, forward_map.sensor, forward_map.domain.radius, title)


def _path(axes: Any, forward_map: ForwardMap, live: Live) -> None:
    for number in np.unique(live.presses):
        frames = live.presses == number
        axes.plot(*live.pressed[frames, :2].T, color=PRESSED, lw=3.0, solid_capstyle="round")
        axes.plot(*live.estimated[frames, :2].T, color=FELT, lw=0.7)
    axes.plot([], [], color=PRESSED, lw=3.0, label="pressed")
    axes.plot([], [], color=FELT, lw=0.7, label="estimated")
    axes.legend(loc="upper right")
    draw_electrodes(axes, forward_map.sensor)
    _frame(axes, forward_map, "live path, through the port")


def _error_against_force(axes: Any, force: Array, error: Array) -> None:
    axes.loglog(force, error, ".", color=PRESSED, ms=2, alpha=0.5)
    edges = np.geomspace(force.min(), force.max(), 13)
    bins = np.clip(np.digitize(force, edges) - 1, 0, 11)
    middle = np.sqrt(edges[:-1] * edges[1:])
    for share, style in ((50, "-"), (95, "--")):
        line = [np.percentile(error[bins == k], share) if (bins == k).any() else np.nan for k in range(12)]
        axes.plot(middle, line, style, color=FELT, label="median" if share == 50 else "95 %")
    axes.legend()
    axes.set(title="position error of test presses", xlabel="force, N", ylabel="error, mm")
    axes.set_ylim(bottom=2e-3)
    axes.grid(alpha=0.3, which="both")
