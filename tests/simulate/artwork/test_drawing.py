"""DXF and SVG drawings, read again with ezdxf and svgelements, and straight leads."""

from dataclasses import replace
from itertools import combinations

import ezdxf
import numpy as np
import pytest
from svgelements import SVG, Path

from isocharge.common.errors import SensorError
from isocharge.simulate import Electrode, load_sensor
from isocharge.simulate.artwork.drawing import RULER_LENGTH, draw_layout, to_dxf, to_svg
from isocharge.simulate.artwork.leads import straight_leads
from isocharge.simulate.artwork.reading import read_artwork

MICROMETRE = 1e-3
"""One micrometre, mm."""


@pytest.fixture(params=["four-25um-biaxial-15mm", "shapes"])
def sensor(request):
    if request.param != "shapes":
        return load_sensor(request.param)
    triangle = Electrode('<"A&B">', ((0.0, 10.0123456), (3.0, 10.0), (1.2345678, 14.0)))
    square = Electrode.of_square("C", (-12.3456789, 0.1), 2.7182818)
    return replace(load_sensor("three-25um-biaxial"), electrodes=(triangle, square))


@pytest.fixture
def drawing(sensor):
    return draw_layout(sensor, straight_leads(sensor))


def box(points):
    return [*np.min(points, axis=0), *np.max(points, axis=0)]


def test_dxf_has_the_positions_and_sizes_of_the_sensor(sensor, drawing, tmp_path):
    path = tmp_path / "layout.dxf"
    path.write_text(to_dxf(drawing), "utf-8")
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
    assert {line.dxf.const_width for line in space.query('LWPOLYLINE[layer=="LEADS"]')} == {0.3}


@pytest.fixture
def with_traces(sensor):
    """A sensor whose electrodes have traces and share a polygon on the back."""
    back = (((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (1.0, 29.0), (-30.0, 30.0)),)
    bent = [((x, y), (1.5 * x, 1.5 * y), (1.6 * x, 1.5 * y + 3.0)) for x, y in (e.centre for e in sensor.electrodes)]
    traced = (e.with_trace(path, 0.5) for e, path in zip(sensor.electrodes[:2], bent, strict=False))
    named = [replace(e, name=name, back=back) for e, name in zip(traced, ("Z", "left one"), strict=True)]
    return replace(sensor, electrodes=tuple(named))


@pytest.mark.parametrize("scale", [1.0, 25.4], ids=["mm", "inches"])
def test_read_artwork_returns_the_electrodes_that_were_drawn(with_traces, scale, tmp_path):
    drawing = draw_layout(with_traces, straight_leads(with_traces))
    if scale != 1.0:
        drawing.units = ezdxf.units.IN
        for entity in drawing.modelspace():
            entity.transform(ezdxf.math.Matrix44.scale(1.0 / scale))
    (tmp_path / "layout.dxf").write_text(to_dxf(drawing), "utf-8")
    again = read_artwork(tmp_path / "layout.dxf", back="BACK")
    assert [electrode.name for electrode in again] == ["Z", "left one"]
    for electrode, drawn in zip(again, with_traces.electrodes, strict=True):
        for polygons, others in ((electrode.front, drawn.front), (electrode.back, drawn.back)):
            for one, other in zip(polygons, others, strict=True):
                np.testing.assert_allclose(one, other, atol=1e-9)


def drawn(path, *lines):
    document = ezdxf.new("R2010", units=0)
    document.modelspace().add_line((0.0, 0.0), (1.0, 1.0))
    for points, width in lines:
        attributes = {"layer": "metal", "const_width": width}
        document.modelspace().add_lwpolyline(points, "xyb", close=len(points) == 4, dxfattribs=attributes)
    document.saveas(path)
    return path


def test_read_artwork_of_a_drawing_without_names_and_unit(tmp_path):
    """The drawing has a clockwise square, a trace of two lines that cross, and a disk of four arcs."""
    bulge = np.tan(np.pi / 8)
    disk = [(22.0, 0.0, bulge), (20.0, 2.0, bulge), (18.0, 0.0, bulge), (20.0, -2.0, bulge)]
    lines = [[(2.0, 2.0), (2.0, 12.0)], [(0.0, 11.0), (8.0, 11.0)], [(0.0, 0.0), (0.0, 4.0), (4.0, 4.0), (4.0, 0.0)]]
    one, other = read_artwork(drawn(tmp_path / "mine.dxf", *((line, 0.5) for line in (*lines, disk))), "METAL")
    assert (one.name, other.name) == ("A", "B")
    assert one.area == pytest.approx(16.0 + 0.5 * 8.0 + 0.5 * 8.0 - 0.25)
    assert other.area == pytest.approx(4.0 * np.pi, rel=0.01)


def test_pads_that_a_later_trace_joins_keep_the_order_of_the_drawing(tmp_path):
    """The first trace touches only the first pad. The second trace then joins the first pad and the third pad."""
    pads = [[(x, 0.0), (x, 4.0), (x + 4.0, 4.0), (x + 4.0, 0.0)] for x in (0.0, 20.0, 40.0)]
    traces = [[(2.0, -5.0), (2.0, 2.0)], [(2.0, 2.0), (2.0, 9.0), (20.0, 9.0), (42.0, 9.0), (42.0, 2.0)]]
    first, second = read_artwork(drawn(tmp_path / "mine.dxf", *((line, 0.5) for line in (*pads, *traces))), "METAL")
    assert first.centre == pytest.approx((2.0, 2.0))
    assert [box(corners)[0] for corners in first.more] == pytest.approx([40.0, 1.75, 1.75])
    assert second.centre == pytest.approx((22.0, 2.0))
    assert second.more == ()


SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]


@pytest.mark.parametrize(
    ("lines", "layers", "message"),
    [
        pytest.param([([(0.0, 0.0), (9.0, 0.0)], 0.0)], ("metal",), r"#\w+ is open and has no width", id="open line"),
        pytest.param([([SQUARE[k] for k in (0, 1, 3, 2)], 0.0)], ("metal",), "#.* does not cross itself", id="bow tie"),
        pytest.param([(SQUARE, 0.0)], ("copper",), "has no lines; the layers with lines are metal", id="layer"),
        pytest.param([(SQUARE, 0.0)], ("0",), r"LINE #\w+: expected one of LWPOLYLINE, POLYLINE", id="not an outline"),
    ],
)
def test_read_artwork_of_a_drawing_without_electrodes_raises_sensor_error(tmp_path, lines, layers, message):
    with pytest.raises(SensorError, match=message):
        read_artwork(drawn(tmp_path / "mine.dxf", *lines), *layers)


def test_read_artwork_of_a_text_file_raises_sensor_error(tmp_path):
    (tmp_path / "mine.dxf").write_text("film")
    with pytest.raises(SensorError, match=r"mine\.dxf: expected a DXF file"):
        read_artwork(tmp_path / "mine.dxf")


def test_svg_is_to_scale(sensor, drawing, tmp_path):
    path = tmp_path / "layout.svg"
    path.write_text(to_svg(drawing), "utf-8")
    svg = SVG.parse(str(path), ppi=25.4)  # a pixel is a millimetre
    boxes = np.array([shape.bbox() for shape in svg.elements(lambda element: isinstance(element, Path))])
    film = boxes[np.argmax(boxes[:, 3] - boxes[:, 1])]
    assert film[2:] - film[:2] == pytest.approx([2.0 * sensor.film.radius] * 2, abs=MICROMETRE)
    middle = 0.5 * (film[2:] + film[:2])
    for electrode in sensor.electrodes:
        left, low, right, high = box(electrode.corners)
        expected = [middle[0] + left, middle[1] - high, middle[0] + right, middle[1] - low]
        assert np.abs(boxes - expected).max(axis=1).min() < MICROMETRE
    assert np.abs(boxes[:, 2] - boxes[:, 0] - RULER_LENGTH).min() < MICROMETRE


def sampled(path):
    return path[0] + np.linspace(0.0, 1.0, 2000)[:, None] * (path[1] - path[0])


def test_leads_reach_the_rim_without_crossing_leads_or_electrodes(sensor):
    leads = straight_leads(sensor)
    assert leads.unconnected == ()
    assert leads.summary == f"all {len(sensor.electrodes)} leads go straight to the rim"
    for electrode in sensor.electrodes:
        path = leads.paths[electrode.name]
        assert np.hypot(*path[1]) == pytest.approx(sensor.film.radius)
        assert path[0] == pytest.approx(np.array(electrode.centre))
        for other in sensor.electrodes:
            left, low, right, high = box(other.corners)
            x, y = sampled(path).T
            near = (x > left - 0.44) & (x < right + 0.44) & (y > low) & (y < high)
            assert other is electrode or not near.any()
    for first, second in combinations(leads.paths.values(), 2):
        assert min(np.hypot(*(sampled(second) - point).T).min() for point in sampled(first)[::10]) > 0.59


def test_electrode_without_a_straight_lead_is_reported():
    """The gaps in a ring of squares are too narrow for the lead of the square in the middle."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = [Electrode.of_square(f"R{n}", (10.0 * np.cos(a), 10.0 * np.sin(a)), 2.7) for n, a in enumerate(angles)]
    middle = Electrode.of_square("M", (0.0, 0.0), 3.0)
    leads = straight_leads(replace(load_sensor("three-25um-biaxial"), electrodes=(middle, *ring)))
    assert leads.unconnected == ("M",)
    assert leads.summary == "no straight lead to the rim for M: use another layer for their leads"
