"""Pictures of the film, as matplotlib has them."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from isocharge.simulate import Calibration, Domain, Electrode, FunctionMap, load_sensor
from isocharge.simulate.plots.film import draw_charge_map, draw_electrodes


def test_all_metal_is_drawn_where_it_lies():
    pad, back = Electrode.of_square("A", (5.0, 0.0), 3.0), ((0.0, -9.0), (9.0, -9.0), (9.0, 9.0))
    electrode = replace(pad.with_trace(((5.0, 0.0), (9.0, 0.0)), 0.5), back=(back,))
    sensor = replace(load_sensor("three-25um-biaxial"), electrodes=(electrode,))
    axes = Figure().subplots()
    draw_electrodes(axes, replace(sensor, calibration=Calibration(shift=(1.0, 0.0))))
    corners = [patch.get_xy()[:-1] - [1.0, 0.0] for patch in axes.patches]
    for drawn, polygon in zip(corners, (*electrode.front, back), strict=True):
        np.testing.assert_allclose(drawn, polygon)
    assert [patch.get_linestyle() for patch in axes.patches] == ["-", "-", "--"]
    assert [(text.get_text(), *text.xy) for text in axes.texts] == [("A", *np.add(electrode.centre, [1.0, 0.0]))]


def test_the_whole_film_is_shaded():
    """By charges that are the place itself: the shades reach to the rim on all sides."""
    charge_map = FunctionMap(lambda contact: contact[:, :1], ("A",), Domain(8.0, (0.1, 1.0)))
    axes = Figure().subplots()
    draw_charge_map(axes, charge_map, 0)
    assert axes.dataLim.extents == pytest.approx([-8.0, -8.0, 8.0, 8.0], abs=0.02)
