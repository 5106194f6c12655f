"""Drawings read back by other programs: svgelements and ezdxf."""

from dataclasses import replace
from itertools import combinations

import ezdxf
import numpy as np
import pytest
from svgelements import SVG, Path

from isocharge.common.errors import SensorError
from isocharge.simulate import Electrode, load_sensor
from isocharge.simulate.artwork.drawing import RULER, draw_layout, to_dxf, to_svg
from isocharge.simulate.artwork.leads import straight_leads
from isocharge.simulate.artwork.reading import read_artwork

MICROMETRE = 1e-3
"""In mm."""


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


def test_dxf_has_the_places_and_sizes_of_the_sensor(sensor, drawing, tmp_path):
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
    """Traces, and a back that two electrodes share."""
    back = (((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (1.0, 29.0), (-30.0, 30.0)),)
    bent = [((x, y), (1.5 * x, 1.5 * y), (1.6 * x, 1.5 * y + 3.0)) for x, y in (e.centre for e in sensor.electrodes)]
    traced = (e.with_trace(path, 0.5) for e, path in zip(sensor.electrodes[:2], bent, strict=False))
    named = [replace(e, name=name, back=back) for e, name in zip(traced, ("Z", "left one"), strict=True)]
    return replace(sensor, electrodes=tuple(named))


@pytest.mark.parametrize("scale", [1.0, 25.4])
def test_a_drawing_is_read_as_the_electrodes_that_it_shows(with_traces, scale, tmp_path):
    """Also in inches, where every length is another number."""
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


def test_lines_of_a_foreign_drawing(tmp_path):
    """A clockwise square, its trace in two lines that cross, and a disk of four arcs: no names, no unit."""
    bulge = np.tan(np.pi / 8)
    disk = [(22.0, 0.0, bulge), (20.0, 2.0, bulge), (18.0, 0.0, bulge), (20.0, -2.0, bulge)]
    lines = [[(2.0, 2.0), (2.0, 12.0)], [(0.0, 11.0), (8.0, 11.0)], [(0.0, 0.0), (0.0, 4.0), (4.0, 4.0), (4.0, 0.0)]]
    one, other = read_artwork(drawn(tmp_path / "mine.dxf", *((line, 0.5) for line in (*lines, disk))), "METAL")
    assert (one.name, other.name) == ("A", "B")
    assert one.area == pytest.approx(16.0 + 0.5 * 8.0 + 0.5 * 8.0 - 0.25)
    assert other.area == pytest.approx(4.0 * np.pi, rel=0.01)


SQUARE = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]


@pytest.mark.parametrize(
    ("lines", "layers", "message"),
    [
        ([([(0.0, 0.0), (9.0, 0.0)], 0.0)], ("metal",), r"layer 'metal': LWPOLYLINE #\w+ is open and has no width"),
        ([([SQUARE[k] for k in (0, 1, 3, 2)], 0.0)], ("metal",), "LWPOLYLINE #.* does not cross itself"),
        ([(SQUARE, 0.0)], ("copper",), "layer 'copper' has no lines; those that have are metal"),
        ([(SQUARE, 0.0)], ("0",), r"layer '0': LINE #\w+: expected one of LWPOLYLINE, POLYLINE"),
    ],
)
def test_drawings_that_show_no_electrodes(tmp_path, lines, layers, message):
    with pytest.raises(SensorError, match=message):
        read_artwork(drawn(tmp_path / "mine.dxf", *lines), *layers)


def test_a_file_that_is_no_drawing(tmp_path):
    (tmp_path / "mine.dxf").write_text("film")
    with pytest.raises(SensorError, match=r"mine\.dxf: expected a DXF file"):
        read_artwork(tmp_path / "mine.dxf")


def test_svg_is_the_same_drawing_to_scale(sensor, drawing, tmp_path):
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
    assert np.abs(boxes[:, 2] - boxes[:, 0] - RULER).min() < MICROMETRE


def sampled(path):
    return path[0] + np.linspace(0.0, 1.0, 2000)[:, None] * (path[1] - path[0])


def test_leads_reach_the_rim_and_cross_nothing(sensor):
    leads = straight_leads(sensor)
    assert leads.without == ()
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


def test_an_electrode_without_a_straight_way_is_named():
    """A ring of squares without gaps that are wide enough, and one in the middle."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    ring = [Electrode.of_square(f"R{n}", (10.0 * np.cos(a), 10.0 * np.sin(a)), 2.7) for n, a in enumerate(angles)]
    middle = Electrode.of_square("M", (0.0, 0.0), 3.0)
    leads = straight_leads(replace(load_sensor("three-25um-biaxial"), electrodes=(middle, *ring)))
    assert leads.without == ("M",)
    assert leads.summary == "no straight way to the rim for M: lead them out on another layer"
