"""Pictures of the film, checked by the objects that matplotlib draws."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from function_map import FunctionMap
from isocharge.simulate import Calibration, Circle, Domain, Electrode, load_sensor, press
from isocharge.simulate.plots.film import (
    FELT,
    INK,
    draw_charge_map,
    draw_deflection,
    draw_electrodes,
    draw_layout,
    draw_section,
)

SENSOR = load_sensor("three-25um-biaxial")


@pytest.fixture
def axes():
    return Figure().subplots()


def test_draw_electrodes_draws_front_and_back_at_their_positions(axes):
    pad = Electrode.of_square("A", (5.0, 0.0), 3.0)
    back = ((0.0, -9.0), (9.0, -9.0), (9.0, 9.0))
    electrode = replace(pad.with_trace(((5.0, 0.0), (9.0, 0.0)), 0.5), back=(back,))
    sensor = replace(SENSOR, electrodes=(electrode,))
    draw_electrodes(axes, replace(sensor, calibration=Calibration(shift=(1.0, 0.0))))
    corners = [patch.get_xy()[:-1] - [1.0, 0.0] for patch in axes.patches]
    for drawn, polygon in zip(corners, (*electrode.front, back), strict=True):
        np.testing.assert_allclose(drawn, polygon)
    assert [patch.get_linestyle() for patch in axes.patches] == ["-", "-", "--"]
    assert [(text.get_text(), *text.xy) for text in axes.texts] == [("A", *np.add(electrode.centre, [1.0, 0.0]))]


def test_draw_layout_shows_all_electrodes_and_highlights_one(axes):
    """The axes show the corners of the electrodes, of which the outermost is 12.8 mm from the centre."""
    sensor = load_sensor("four-25um-biaxial")
    draw_layout(axes, sensor, 8.0, highlight="B")
    assert {text.get_text(): text.get_color() for text in axes.texts} == {"A": INK, "B": FELT, "C": INK, "D": INK}
    corners = np.concatenate([electrode.corners for electrode in sensor.electrodes])
    low, high = axes.get_xlim()
    assert -low == high > np.linalg.norm(corners, axis=1).max()


def test_draw_charge_map_covers_the_whole_disk(axes):
    """The shaded area extends to the edge of the domain on all sides."""
    charge_map = FunctionMap(lambda contact: contact[:, :1], ("A",), Domain(8.0, (0.1, 1.0)))
    draw_charge_map(axes, charge_map, 0)
    assert axes.dataLim.extents == pytest.approx([-8.0, -8.0, 8.0, 8.0], abs=0.02)


def test_pictures_of_an_oval_film_end_at_its_rim(axes):
    """The semi-axes of the oval are 48.6 mm along y and 41.4 mm along x."""
    film = replace(SENSOR.film, oval=0.08, oval_axis=np.pi / 2.0)
    solved = press(film, Circle(1.0), (0.0, 5.0), 1.0)
    draw_deflection(axes, solved)
    for drawn in (
        axes.patches[-1].get_xy(),
        np.concatenate([path.vertices for path in axes.collections[0].get_paths()]),
    ):
        np.testing.assert_allclose(np.abs(drawn).max(axis=0), [41.4, 48.6], rtol=1e-3)
    axes.clear()
    draw_section(axes, solved)
    np.testing.assert_allclose(axes.lines[0].get_xdata()[[0, -1]], [-48.6, 48.6])


def test_draw_section_goes_through_the_probe(axes):
    """The section extends from rim to rim. The deflection is largest under the mark of the probe."""
    draw_section(axes, press(SENSOR.film, Circle(1.0), (3.0, -4.0), 1.0))
    film, mark = axes.lines
    along, height = film.get_data()
    assert [*mark.get_xdata(), *along[[0, -1]]] == pytest.approx([4.0, 6.0, -45.0, 45.0], rel=1e-5)
    assert along[height.argmin()] == pytest.approx(5.0, abs=0.5)
