"""Drawings read back by other programs: svgelements and ezdxf."""

import re
from dataclasses import replace
from itertools import combinations, pairwise
from xml.etree import ElementTree

import ezdxf
import numpy as np
import pytest
from svgelements import SVG, Circle, Polygon, SimpleLine

from isocharge.simulate import Electrode, built_in_sensors, load_sensor
from isocharge.simulate.artwork.dxf import layout_dxf
from isocharge.simulate.artwork.leads import route
from isocharge.simulate.artwork.ruler import RULER_MM
from isocharge.simulate.artwork.svg import layout_svg

MICROMETRE = 1e-3
"""In mm."""


@pytest.fixture(params=[*built_in_sensors(), "shapes"])
def sensor(request):
    if request.param != "shapes":
        return load_sensor(request.param)
    made = load_sensor("three-25um-biaxial")
    triangle = Electrode('<"A&B">', ((0.0, 10.0123456e-3), (3e-3, 10e-3), (1.2345678e-3, 14e-3)))
    square = Electrode.of_square("C", (-12.3456789e-3, 0.1e-3), 2.7182818e-3)
    return type(made)(made.name, made.film, made.piezo, (triangle, square))


def corners_of(sensor):
    return {electrode.name: 1e3 * np.array(electrode.corners) for electrode in sensor.electrodes}


def test_svg_has_the_places_and_sizes_of_the_sensor(sensor, tmp_path):
    path = tmp_path / "layout.svg"
    path.write_text(layout_svg(sensor, route(sensor)), "utf-8")
    drawing = SVG.parse(str(path), ppi=25.4)  # a pixel is a millimetre
    margin = -drawing.viewbox.x
    assert drawing.width / drawing.viewbox.width == pytest.approx(1.0)

    def frame(points):
        return np.array([[point.x - margin, margin - point.y] for point in points])

    found = {}
    for shape in drawing.elements(lambda element: isinstance(element, Polygon)):
        if shape.id.startswith("electrode-"):
            found[shape.id.removeprefix("electrode-")] = frame(shape.points)
    assert found.keys() == corners_of(sensor).keys()
    for name, corners in corners_of(sensor).items():
        assert found[name] == pytest.approx(corners, abs=MICROMETRE)
    film = next(drawing.elements(lambda element: isinstance(element, Circle)))
    assert film.implicit_rx == pytest.approx(1e3 * sensor.film.radius, abs=MICROMETRE)
    lines = list(drawing.elements(lambda element: isinstance(element, SimpleLine)))
    lengths = [abs(line.implicit_x2 - line.implicit_x1) for line in lines]
    assert max(lengths) == pytest.approx(RULER_MM, abs=MICROMETRE)


def test_svg_is_xml_whatever_the_names_hold():
    sensor = load_sensor("three-25um-biaxial")
    first = replace(sensor.electrodes[0], name="a\x01\n]]>")
    sensor = replace(sensor, name="</title><script>\x02\uffff", electrodes=(first, *sensor.electrodes[1:]))
    root = ElementTree.fromstring(layout_svg(sensor, route(sensor)))
    title = root.find("{http://www.w3.org/2000/svg}title")
    assert title.text.startswith("</title><script>\ufffd\ufffd, electrodes")


def test_dxf_has_the_places_and_sizes_of_the_sensor(sensor, tmp_path):
    path = tmp_path / "layout.dxf"
    path.write_text(layout_dxf(sensor, route(sensor)), "utf-8")
    document = ezdxf.readfile(path)
    assert not document.audit().errors
    assert document.units == ezdxf.units.MM
    space = document.modelspace()
    outlines = [np.array(line.get_points("xy")) for line in space.query('LWPOLYLINE[layer=="ELECTRODES"]')]
    for outline, corners in zip(outlines, corners_of(sensor).values(), strict=True):
        assert outline == pytest.approx(corners, abs=MICROMETRE)
    (film,) = space.query("CIRCLE")
    assert film.dxf.radius == pytest.approx(1e3 * sensor.film.radius)
    names = [text.dxf.text for text in space.query('TEXT[layer=="NAMES"]')]
    assert names == list(sensor.electrode_names)
    widths = {line.dxf.const_width for line in space.query('LWPOLYLINE[layer=="LEADS"]')}
    assert max(widths) == min(widths) == pytest.approx(0.3)


def nearest(first, second):
    """Smallest distance of two polylines, sampled every 0.05 mm, mm."""

    def sample(path):
        parts = [a + np.linspace(0, 1, max(2, int(np.hypot(*(b - a)) / 0.05)))[:, None] * (b - a)
                 for a, b in pairwise(path)]  # fmt: skip
        return np.concatenate(parts)

    one, other = sample(first), sample(second)
    return min(np.hypot(*(other - point).T).min() for point in one)


def test_leads_reach_the_rim_and_cross_nothing(sensor):
    leads = route(sensor)
    assert leads.without == ()
    assert "without crossing" in leads.words
    paths = {lead.electrode: 1e3 * lead.path for lead in leads.leads}
    closed = {name: np.concatenate([corners, corners[:1]]) for name, corners in corners_of(sensor).items()}
    for name, path in paths.items():
        assert np.hypot(*path[-1]) == pytest.approx(1e3 * sensor.film.radius)
        assert path[0] == pytest.approx(corners_of(sensor)[name].mean(axis=0))
        for other, outline in closed.items():
            assert other == name or nearest(path, outline) > 0.4
    for first, second in combinations(paths.values(), 2):
        assert nearest(first, second) > 0.5


def test_an_electrode_that_is_walled_in_is_said_to_be(sensor):
    """Holes all round an electrode: its lead has no way."""
    x, y = sensor.electrodes[0].centre
    ring = [(x + 6e-3 * np.cos(a), y + 6e-3 * np.sin(a), 2e-3) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    leads = route(sensor, keep_out=tuple(ring))
    assert sensor.electrodes[0].name in leads.without
    assert re.search("no way to the rim was found for .* another layer", leads.words)
