"""The demo's page of pictures: one press, the charge maps, the live path, the errors of the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.plots.figure import FELT, PRESSED, new_figure, save_picture
from isocharge.simulate.plots.film import (
    draw_charge_map,
    draw_deflection,
    draw_electrodes,
    draw_section,
    draw_working_area,
    frame_film,
)

if TYPE_CHECKING:
    from isocharge.simulate import Equilibrium, ForwardMap


@dataclass(frozen=True)
class Page:
    """What the page shows.

    Attributes:
        forward_map: Forward map of the sensor and probe.
        equilibrium: One solved press.
        pressed: (x_mm, y_mm, force_N) of every live frame in contact, shape (n, 3).
        estimated: The model's answers to them, shape (n, 3).
        presses: Number of the press that each frame belongs to, shape (n,).
        test_force_N: Forces of the test presses, shape (m,).
        test_error_mm: Their position errors, shape (m,).
    """

    forward_map: "ForwardMap"
    equilibrium: "Equilibrium"
    pressed: Array
    estimated: Array
    presses: np.ndarray
    test_force_N: Array
    test_error_mm: Array


def draw_page(page: Page, path: Path) -> None:
    """Draw the page and write it."""
    electrodes = page.forward_map.sensor.electrodes
    figure = new_figure(15.0, 9.2)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))
    _deflected_film(top, page)
    maps = bottom.subplots(1, len(electrodes) + 1, width_ratios=(*(1.0,) * len(electrodes), 1.25))
    _isocharge_maps(maps[:-1], page.forward_map)
    _error_against_force(maps[-1], page)
    figure.suptitle(f"isocharge demo: {page.forward_map.sensor.name}, {page.forward_map.probe.notation}", fontsize=14)
    save_picture(figure, path)


def _deflected_film(figure: Any, page: Page) -> None:
    left, middle, right = figure.subplots(1, 3)
    draw_deflection(left, page.equilibrium)
    draw_electrodes(left, page.forward_map.sensor, names=False)
    draw_section(middle, page.equilibrium)
    _path(right, page)


def _path(axes: Any, page: Page) -> None:
    for number in np.unique(page.presses):
        frames = page.presses == number
        axes.plot(*page.pressed[frames, :2].T, color=PRESSED, lw=3.0, solid_capstyle="round")
        axes.plot(*page.estimated[frames, :2].T, color=FELT, lw=0.7)
    axes.plot([], [], color=PRESSED, lw=3.0, label="pressed")
    axes.plot([], [], color=FELT, lw=0.7, label="estimated")
    axes.legend(loc="upper right")
    draw_electrodes(axes, page.forward_map.sensor)
    draw_working_area(axes, page.forward_map.radius)
    frame_film(axes, page.forward_map.sensor, page.forward_map.radius, "live path, through the port")


def _isocharge_maps(all_axes: Sequence[Any], forward_map: "ForwardMap", force: float = 1.0) -> None:
    """Contours of each electrode's charge over the position of a press."""
    for number, (axes, name) in enumerate(zip(all_axes, forward_map.sensor.electrode_names, strict=True)):
        draw_charge_map(axes, forward_map, number, force)
        draw_electrodes(axes, forward_map.sensor, highlight=name)
        draw_working_area(axes, forward_map.radius)
        frame_film(axes, forward_map.sensor, forward_map.radius, f"isocharge contours of {name} at {force:g} N, pC")


def _error_against_force(axes: Any, page: Page) -> None:
    force, error = page.test_force_N, page.test_error_mm
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
