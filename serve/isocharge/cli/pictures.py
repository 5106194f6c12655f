"""The demo's page of pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disk
from matplotlib.patches import Polygon

from isocharge.simulate.arrays import Array

if TYPE_CHECKING:
    from isocharge.simulate import Equilibrium, ForwardMap, Sensor

INK, PRESSED, FELT = "#1b2a41", "#9aa5b1", "#d1495b"
"""Colours of outlines, of what was pressed and of what was felt."""


@dataclass(frozen=True)
class Page:
    """What the page shows.

    Attributes:
        film: Forward map of the sensor and probe.
        equilibrium: One solved press.
        pressed: (x_mm, y_mm, force_N) of every live frame in contact, shape (n, 3).
        felt: What the model made of it, shape (n, 3).
        presses: Number of the press that each frame belongs to, shape (n,).
        test_force_N: Forces of the test presses, shape (m,).
        test_error_mm: Their position errors, shape (m,).
    """

    film: "ForwardMap"
    equilibrium: "Equilibrium"
    pressed: Array
    felt: Array
    presses: np.ndarray
    test_force_N: Array
    test_error_mm: Array


def draw_page(page: Page, path: Path) -> None:
    """Draw the page and write it as PNG."""
    electrodes = page.film.sensor.electrodes
    figure = Figure(figsize=(15.0, 9.2), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = cast(np.ndarray, figure.subfigures(2, 1))
    _deflected_film(top, page)
    maps = bottom.subplots(1, len(electrodes) + 1, width_ratios=(*(1.0,) * len(electrodes), 1.25))
    _isocharge_maps(maps[:-1], page.film)
    _error_against_force(maps[-1], page)
    figure.suptitle(f"isocharge demo: {page.film.sensor.name}, {page.film.probe.notation}", fontsize=14)
    figure.savefig(path, dpi=110)


def _deflected_film(figure: Any, page: Page) -> None:
    left, middle, right = figure.subplots(1, 3)
    _film_from_above(left, page)
    _film_in_section(middle, page)
    _path(right, page)


def _film_from_above(axes: Any, page: Page) -> None:
    film = page.equilibrium.film
    radius = 1e3 * film.radius * np.sqrt(np.linspace(0.0, 0.999999, 240))
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    w = page.equilibrium.deflection(1e-3 * np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape) * 1e3
    shades = axes.contourf(x, y, w, levels=24, cmap="viridis_r")
    axes.figure.colorbar(shades, ax=axes, shrink=0.8, label="deflection, mm")
    _outlines(axes, page.film.sensor, names=False)
    axes.add_patch(Disk((0, 0), 1e3 * film.radius, fill=False, color=INK))
    axes.set(title=f"the film under {page.equilibrium.force:g} N", xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _film_in_section(axes: Any, page: Page) -> None:
    """A cut through the probe and the centre of the film."""
    equilibrium = page.equilibrium
    reach = 1e3 * equilibrium.film.radius
    along = np.linspace(-0.999999, 0.999999, 801) * reach
    at = np.array(equilibrium.at)
    direction = at / np.linalg.norm(at) if np.linalg.norm(at) > 0 else np.array([1.0, 0.0])
    w = 1e3 * equilibrium.deflection(1e-3 * along[:, None] * direction)
    axes.plot(along, -w, color=INK, lw=1.5)
    foot = float(1e3 * at @ direction)
    half = 1e3 * equilibrium.probe.reach
    axes.plot([foot - half, foot + half], [0.25, 0.25], color=FELT, lw=5, solid_capstyle="butt")
    axes.annotate("", (foot, -w.max()), (foot, 0.2), arrowprops={"arrowstyle": "->", "color": FELT})
    axes.set(
        title=f"cut through probe and centre: {w.max():.2f} mm deep",
        xlabel="along the cut, mm",
        ylabel="-deflection, mm (stretched)",
    )


def _path(axes: Any, page: Page) -> None:
    for number in np.unique(page.presses):
        mine = page.presses == number
        axes.plot(*page.pressed[mine, :2].T, color=PRESSED, lw=3.0, solid_capstyle="round")
        axes.plot(*page.felt[mine, :2].T, color=FELT, lw=0.7)
    axes.plot([], [], color=PRESSED, lw=3.0, label="pressed")
    axes.plot([], [], color=FELT, lw=0.7, label="felt")
    axes.legend(loc="upper right")
    _outlines(axes, page.film.sensor)
    _working_area(axes, page.film)
    axes.set(title="live path, through the port", xlabel="x, mm", ylabel="y, mm", aspect="equal")


def _isocharge_maps(all_axes: Sequence[Any], film: "ForwardMap", force: float = 1.0, count: int = 81) -> None:
    """Contours of each electrode's charge over the position of a press."""
    radius = film.radius * np.sqrt(np.linspace(0.0, 1.0, count // 2))
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    charge = 1e12 * film.forward(x.ravel(), y.ravel(), np.full(x.size, force))
    for number, (axes, name) in enumerate(zip(all_axes, film.sensor.electrode_names, strict=True)):
        values = charge[:, number].reshape(x.shape)
        axes.contourf(1e3 * x, 1e3 * y, values, levels=30, cmap="YlGnBu")
        lines = axes.contour(1e3 * x, 1e3 * y, values, levels=12, colors=INK, linewidths=0.8)
        axes.clabel(lines, fmt="%.0f", fontsize=7)
        _outlines(axes, film.sensor, highlight=name)
        _working_area(axes, film)
        axes.set(
            title=f"isocharge contours of {name} at {force:g} N, pC", xlabel="x, mm", ylabel="y, mm", aspect="equal"
        )


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
    axes.set(title="position error of presses never seen", xlabel="force, N", ylabel="error, mm")
    axes.set_ylim(bottom=2e-3)
    axes.grid(alpha=0.3, which="both")


def _outlines(axes: Any, sensor: "Sensor", highlight: str = "", names: bool = True) -> None:
    for electrode in sensor.electrodes:
        corners = 1e3 * sensor.calibration.place(np.array(electrode.corners))
        colour = FELT if electrode.name == highlight else INK
        axes.add_patch(Polygon(corners, fill=False, ec=colour, lw=1.6))
        if names:
            axes.annotate(electrode.name, corners.mean(axis=0), ha="center", va="center", color=colour, fontsize=9)


def _working_area(axes: Any, film: "ForwardMap") -> None:
    axes.add_patch(Disk((0, 0), 1e3 * film.radius, fill=False, ls=":", color=INK))
    reach = 1e3 * max(film.radius, *(np.hypot(*corner) for e in film.sensor.electrodes for corner in e.corners)) + 0.7
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
