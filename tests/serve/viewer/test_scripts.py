"""The description of the film, and the scripts of the page that draw it, run by Node.js."""

import json
import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from isocharge.serve import find_model, load_model
from isocharge.serve.viewer.film_description import describe_film
from isocharge.serve.viewer.tape import sample_type, sample_values
from isocharge.simulate import Circle, Film, deflection, press
from isocharge.simulate.sensor.sensor_file import film_to_dict
from processes import finished

VIEWER = Path(str(files("isocharge.serve.viewer")))
FILM = Film(radius=45.0, thickness=0.025, young=3000.0, poisson=0.34)


def test_electrode_polygons_include_the_calibration(film):
    """A released model has squares. The other film has polygons with traces, turned by a right angle and shifted."""
    described = describe_film("left", load_model(find_model("three-25um-biaxial")).metadata)
    squares = np.squeeze([described["polygons_mm"][name] for name in "ABC"], axis=1)  # without traces
    angle = np.radians([-90.0, 30.0, 150.0])
    np.testing.assert_allclose(squares.mean(axis=1), 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=1e-6)
    np.testing.assert_allclose(np.ptp(squares, axis=1), 3.0)
    trace = {"more_mm": [[[2, 0], [2, -9], [3, -9]]], "back_mm": [[[2, 0], [3, 0], [2, 1]]]}
    electrodes = {name: {"polygon_mm": [[2, 0], [3, 0], [2, 1]]} | trace for name in "ABC"}
    turned = {"name": "mine", "electrodes": electrodes, "calibration": {"rotation_deg": 90.0, "shift_mm": [0.5, 0.25]}}
    described = describe_film("left", film.metadata(sensor=turned))
    polygons = [[[0.5, 2.25], [0.5, 3.25], [-0.5, 2.25]], [[0.5, 2.25], [9.5, 2.25], [9.5, 3.25]]]
    np.testing.assert_allclose(described["polygons_mm"]["C"], polygons, atol=1e-12)


def node(script):
    """Run a script by Node.js, and return the JSON value that it prints."""
    if shutil.which("node") is None:
        pytest.skip("needs Node.js, which reads the page's modules as a browser does")
    done = finished(["node", "--input-type=module", "-e", script])
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(("radius_mm", "middle"), [(None, [30.0, 0.0]), (45.0, [0.0, 0.0])])
def test_page_shows_the_whole_area_of_a_film_whose_corner_is_the_origin(radius_mm, middle):
    """The area has x from 0 to 60 mm. It is in the middle of the view unless the film has a radius."""
    film = {
        "working_area_mm": [[0, -15], [60, -15], [60, 15], [0, 15]],
        "polygons_mm": {},
        "force_range_N": [0.2, 5.0],
        "film": {"radius_mm": radius_mm},
        "electrodes": [],
    }
    at, reach, on_pad, beyond, lens_y = node(
        f"""globalThis.document = {{ createElement: () => ({{}}), documentElement: {{}} }};
        globalThis.getComputedStyle = () => ({{ getPropertyValue: () => "" }});
        globalThis.matchMedia = () => ({{ addEventListener() {{}} }});
        const {{ Plan }} = await import("{(VIEWER / "page/plan.js").as_uri()}");
        const plan = new Plan({{ width: 400, height: 400, clientWidth: 400 }}, {json.dumps(film)});
        const shown = (x, y) => {{ const place = plan.inView({{ x, y }}); return [place.x, place.y]; }};
        const lens = plan.lensPlace(0.7 * plan.reach, plan.css, {{ x: plan.middle.x + plan.reach, y: 0 }});
        const {{ x, y }} = plan.middle;
        console.log(JSON.stringify([[x, y], plan.reach, shown(50, 0), shown(500, 0), lens[1]]));"""
    )
    assert at == middle
    assert reach == pytest.approx(1.16 * np.hypot(60.0 - middle[0], 15.0))
    assert on_pad == [50.0, 0.0]
    assert middle[0] + 0.9 * reach < beyond[0] < middle[0] + reach
    assert lens_y < 0.13 * reach  # below the scale in the upper left corner


def test_page_decodes_the_samples_of_the_server(record):
    electrodes = ("A", "B", "C")
    values = sample_values(record(charge_pC={"A": 1.5, "B": None, "C": -3.0}, latency_us=9.0), electrodes)
    got = node(
        f"""import {{ decode }} from "{(VIEWER / "page/decode.js").as_uri()}";
        console.log(JSON.stringify(decode({json.dumps(values)}, {json.dumps(sample_type(electrodes).names)})));"""
    )
    expected = {"charges": [1.5, None, -3.0], "contact": True, "y": None, "t": 1763600000.1234567, "latency": 9.0}
    assert (expected | {"x": 1.23456789, "records": 1}).items() <= got.items()


@pytest.mark.parametrize(
    ("changes", "largest_error"),
    [
        ({}, 0.1),
        ({"pretension": 1.5}, 0.13),
        ({"thickness": 0.11}, 0.15),
        ({"thickness": 1.0}, 0.3),
    ],
)
def test_deflection_that_the_page_draws_is_near_that_of_the_solver(changes, largest_error):
    """The error is compared with the largest deflection of each press."""
    film = replace(FILM, **changes)
    presses = [(0.0, 0.3), (12.0, 2.0), (20.0, 0.05)]  # distances, mm, and forces, N
    points_mm = 44.0 * np.sqrt(np.linspace(0.0, 1.0, 200)) * np.exp(2.4j * np.arange(200))  # Fibonacci spiral
    points_mm[:3] = 0.0, 12.0, 20.0
    places = np.stack([points_mm.real, points_mm.imag], axis=1)
    results = node(
        f"""import {{ Deflection }} from "{(VIEWER / "page/deflection.js").as_uri()}";
        const field = new Deflection({json.dumps(film_to_dict(film))}, 1.0, 2.0);
        console.log(JSON.stringify({json.dumps(presses)}.map(([distance, force]) => {{
          field.press(distance, 0, force);
          return {places.tolist()}.map(([x, y]) => field.at(x, y));
        }})));"""
    )
    for (distance_mm, force_N), result in zip(presses, results, strict=True):
        expected = deflection(press(film, Circle(1.0), (distance_mm, 0.0), force_N), places)
        assert np.abs(np.array(result) - expected).max() < largest_error * expected.max()
