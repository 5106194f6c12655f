"""DXF and SVG drawings, read again with ezdxf and svgelements."""

from dataclasses import replace

import ezdxf
import numpy as np
import pytest
from svgelements import SVG, Path

from isocharge.simulate import Electrode, load_sensor
from isocharge.simulate.artwork import draw_layout, to_dxf, to_svg
from solved_charges import with_film

MICROMETRE = 1e-3
"""One micrometre, mm."""


@pytest.fixture(params=["four-25um-biaxial-15mm", "shapes"])
def sensor(request):
    if request.param != "shapes":
        return load_sensor(request.param)
    triangle = Electrode('<"A&B">', ((0.0, 10.0123456), (3.0, 10.0), (1.2345678, 14.0)))
    square = Electrode.of_square("C", (-12.3456789, 0.1), 2.7182818)
    return replace(load_sensor("three-25um-biaxial"), electrodes=(triangle, square))


def box(points):
    return [*np.min(points, axis=0), *np.max(points, axis=0)]


def test_dxf_has_the_positions_and_sizes_of_the_sensor(sensor, tmp_path):
    path = tmp_path / "layout.dxf"
    path.write_text(to_dxf(draw_layout(sensor)), "utf-8")
    document = ezdxf.readfile(path)
    assert not document.audit().errors
    assert document.units == ezdxf.units.MM
    space = document.modelspace()
    outlines = [np.array(line.get_points("xy")) for line in space.query('LWPOLYLINE[layer=="ELECTRODES"]')]
    for outline, electrode in zip(outlines, sensor.electrodes, strict=True):
        assert outline == pytest.approx(np.array(electrode.corners), abs=MICROMETRE)
    (film,) = space.query("CIRCLE")
    assert film.dxf.radius == pytest.approx(sensor.film.radius)
    names = [text.dxf.text.replace("\ufffd", "") for text in space.query('TEXT[layer=="NAMES"]')]
    assert names == ["".join(filter(str.isprintable, name)) for name in sensor.electrode_names]


def test_rim_of_an_oval_film_is_not_a_circle():
    """The semi-axes of the rim are 10 % larger and smaller than the radius of 45 mm."""
    sensor = load_sensor("three-25um-biaxial")
    space = draw_layout(with_film(sensor, oval=0.1)).modelspace()
    (rim,) = space.query('LWPOLYLINE[layer=="FILM"]')
    assert box([*rim.get_points("xy")]) == pytest.approx([-49.5, -40.5, 49.5, 40.5])
    assert not space.query("CIRCLE")


def test_svg_is_to_scale(sensor, tmp_path):
    path = tmp_path / "layout.svg"
    path.write_text(to_svg(draw_layout(sensor)), "utf-8")
    svg = SVG.parse(str(path), ppi=25.4)  # a pixel is a millimetre
    boxes = np.array([shape.bbox() for shape in svg.elements(lambda element: isinstance(element, Path))])
    film = boxes[np.argmax(boxes[:, 3] - boxes[:, 1])]
    assert film[2:] - film[:2] == pytest.approx([2.0 * sensor.film.radius] * 2, abs=MICROMETRE)
    middle = 0.5 * (film[2:] + film[:2])
    for electrode in sensor.electrodes:
        left, low, right, high = box(electrode.corners)
        expected = [middle[0] + left, middle[1] - high, middle[0] + right, middle[1] - low]
        assert np.abs(boxes - expected).max(axis=1).min() < MICROMETRE


def test_electrode_without_metal_on_the_back_has_its_area_there_beside_pads_of_others():
    """Without such pads, the metal covers the whole back and is not drawn."""
    whole = load_sensor("three-25um-biaxial")
    first, second, third = whole.electrodes
    pad = Electrode.of_square("", first.centre, 2.0).corners
    padded = replace(whole, electrodes=(replace(first, back=(pad,)), second, third))
    backs = [draw_layout(sensor).modelspace().query('LWPOLYLINE[layer=="BACK"]') for sensor in (whole, padded)]
    drawn = [[np.array(line.get_points("xy")) for line in back] for back in backs]
    assert drawn[0] == []
    np.testing.assert_allclose(drawn[1], [pad, second.corners, third.corners])
