"""The demo's page of pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.patches import Circle as Disk

from isocharge.arrays import Array
from isocharge.simulate.plots.figure import FELT, INK, PRESSED, new_figure
from isocharge.simulate.plots.film import draw_charge_map, draw_electrodes, draw_working_area, frame_film

if TYPE_CHECKING:
    from isocharge.simulate import Equilibrium, ForwardMap


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
    figure = new_figure(15.0, 9.2)
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
    draw_electrodes(axes, page.film.sensor, names=False)
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
    draw_electrodes(axes, page.film.sensor)
    draw_working_area(axes, page.film.radius)
    frame_film(axes, page.film.sensor, page.film.radius, "live path, through the port")


def _isocharge_maps(all_axes: Sequence[Any], film: "ForwardMap", force: float = 1.0) -> None:
    """Contours of each electrode's charge over the position of a press."""
    for number, (axes, name) in enumerate(zip(all_axes, film.sensor.electrode_names, strict=True)):
        draw_charge_map(axes, film, number, force)
        draw_electrodes(axes, film.sensor, highlight=name)
        draw_working_area(axes, film.radius)
        frame_film(axes, film.sensor, film.radius, f"isocharge contours of {name} at {force:g} N, pC")


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
