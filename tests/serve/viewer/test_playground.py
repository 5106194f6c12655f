"""The playground in headless Chromium: its answers, charges and flags against the golden vectors and the simulator."""

import json
from functools import cache

import numpy as np
import pytest

from drawn_contacts import draw_contacts
from isocharge.serve import Predictor, find_model, load_model
from isocharge.serve.viewer.film_description import describe_film
from isocharge.serve.viewer.playground_page import MODELS, playground_html
from isocharge.simulate import Circle, load_sensor, press, touch_charge
from kept import ROOT
from playground_film import FORCE_RANGE_N, coefficients, stress_series
from serve.viewer.conftest import errors_of

MAX_SIZE_BYTES = 1_000_000
SERIES = ROOT / "serve/isocharge/serve/viewer/playground/film-25um.json"

ANSWERS = """([index, rows]) => {
  const sensor = isocharge.playground.sensors[index];
  return rows.map((charges) => {
    const answer = sensor.answer(charges);
    return { ...answer, flags: sensor.flags(answer) };
  });
}"""

CHARGES = """([index, presses]) => {
  const sensor = isocharge.playground.sensors[index];
  return presses.map(([x, y, force]) => sensor.charges(x, y, force));
}"""

CURVES = """([index, [x, y, force]]) => {
  const { playground } = isocharge;
  const sensor = playground.sensors[index];
  const charges = sensor.charges(x, y, force);
  const grid = playground.grids.get(index);
  return charges.map((charge, electrode) => grid.isocharge(electrode, charge, force));
}"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("playground") / "playground.html"
    path.write_text(playground_html(), "utf-8")
    return path


def open_window(chromium, file, width=800, height=600, bypass_csp=True, **options):
    """Open the playground, offline, in a window of a given size, with its errors and its requests as lists.

    Scripts of a test do not run under the security policy of the page, so it is bypassed unless it is tested.
    """
    viewport = {"width": width, "height": height}
    context = chromium.new_context(viewport=viewport, offline=True, bypass_csp=bypass_csp, **options)
    page = context.new_page()
    page.errors, page.requests = errors_of(page), []
    page.on("request", lambda request: page.requests.append(request.url))
    page.goto(file.as_uri())
    page.locator("#verdict .text:not(:empty)").wait_for()
    return page


@pytest.fixture(scope="module")
def page(chromium, file):
    """The playground in a window that all tests share."""
    return open_window(chromium, file)


@pytest.fixture
def open_page(chromium, file):
    """Return a function that opens the playground in a window, which is closed when the test ends."""
    pages = []

    def start(*size, **options):
        pages.append(open_window(chromium, file, *size, **options))
        return pages[-1]

    yield start
    for page in pages:
        page.context.close()


def test_the_file_is_small_and_loads_nothing_from_elsewhere(open_page, file):
    page = open_page(bypass_csp=False)
    assert file.stat().st_size <= MAX_SIZE_BYTES
    assert [url for url in page.requests if not url.startswith("data:")] == [file.as_uri()]
    assert page.errors == []


@pytest.mark.parametrize("name", MODELS)
def test_answers_are_the_golden_vectors(page, name):
    golden = load_model(find_model(name)).golden
    answers = page.evaluate(ANSWERS, [MODELS.index(name), golden.charge_pC.tolist()])
    keys = ("x", "y", "force", "xStd", "yStd", "forceStd", "misfit", "correlation")
    values = [[answer[key] for key in keys] for answer in answers]
    outputs = [golden.outputs[key] for key in ("contact", "contact_std", "misfit", "contact_correlation")]
    expected = np.hstack(outputs)[:, : len(keys)]  # of the correlations, the page computes that of x and y
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-4)


solve_press = cache(press)
"""The films of all models are equal, so that the presses of one model are also those of the others."""


@pytest.mark.parametrize("index", range(len(MODELS)))
def test_charges_are_those_of_the_solver(page, index):
    """Between the electrodes, on an electrode, and far outside of the working area."""
    sensor = load_sensor(MODELS[index])
    on_electrode = np.mean(sensor.electrodes[0].corners, axis=0)
    presses = [(3.0, -2.0, 0.05), (*on_electrode, 0.3), (5.0, 24.0, 2.0)]
    expected = [touch_charge(sensor, solve_press(sensor.film, Circle(1.0), (x, y), force)) for x, y, force in presses]
    charges = page.evaluate(CHARGES, [index, presses])
    np.testing.assert_allclose(charges, expected, rtol=1e-3)


@pytest.mark.parametrize("index", range(len(MODELS)))
def test_flags_are_those_of_the_predictor(page, index):
    """With a dead electrode, a wrong gain, and presses outside of the working area."""
    charges = np.array(page.evaluate(CHARGES, [index, draw_contacts(0, 120, 24.0, FORCE_RANGE_N).tolist()]))
    charges[::3, 0] = 0.0
    charges[1::3, 1] *= 1.2
    predictor = Predictor(MODELS[index])
    answers = page.evaluate(ANSWERS, [index, charges.tolist()])
    flags = [set(answer["flags"]) for answer in answers]
    assert flags == [set(predictor.flags(predictor.predict(row))) for row in charges]
    assert len({frozenset(row) for row in flags}) > 2


@pytest.mark.parametrize("press", [(3.0, -2.0, 0.5), (-5.0, 4.0, 1.5), (0.5, 6.0, 0.1)])
def test_the_isocharge_curves_cross_at_the_press(page, press):
    page.wait_for_function("isocharge.playground.grids.get(0).isComplete")
    for segments in page.evaluate(CURVES, [0, press]):
        starts, ends = np.array(segments)[:, :2], np.array(segments)[:, 2:]
        along = ends - starts
        share = np.clip(np.sum((press[:2] - starts) * along, axis=1) / np.sum(along**2, axis=1), 0.0, 1.0)
        nearest = starts + share[:, None] * along
        assert np.linalg.norm(nearest - press[:2], axis=1).min() < 0.1


def test_a_press_with_the_mouse_gives_its_place_and_force(page):
    box = page.locator("#stage").bounding_box()
    page.evaluate("isocharge.playground.setFaults({ noise: 0 })")
    page.mouse.move(box["x"] + 0.45 * box["width"], box["y"] + 0.4 * box["height"])
    page.mouse.down()
    page.wait_for_function("Math.abs(isocharge.playground.press.x + 2.4) < 0.2")
    page.wait_for_timeout(300)
    x, y, force = page.evaluate("(({ x, y, force }) => [x, y, force])(isocharge.playground.result.answer)")
    assert (x, y, force) == (pytest.approx(-2.4, abs=0.2), pytest.approx(4.8, abs=0.2), pytest.approx(0.5, rel=0.05))
    assert "mm from your press" in page.inner_text("#verdict")
    page.mouse.up()
    assert page.errors == []


def test_a_dead_electrode_and_a_wrong_gain_are_flagged_with_four_electrodes(page):
    page.click("#models button:nth-of-type(2)")
    page.select_option("#dead", "0")
    page.wait_for_function("document.querySelector('#flags').innerText.includes('misfit')")
    assert "cannot be trusted" in page.inner_text("#verdict")
    page.select_option("#dead", "-1")
    page.wait_for_function("!document.querySelector('#flags').innerText.includes('misfit')")


def test_a_phone_shows_the_whole_width_and_is_pressed_with_a_finger(open_page):
    page = open_page(360, 740, has_touch=True, is_mobile=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    box = page.locator("#stage").bounding_box()
    assert box["width"] > 300
    assert box["y"] + box["height"] < 740
    page.touchscreen.tap(box["x"] + 0.5 * box["width"], box["y"] + 0.4 * box["height"])
    page.wait_for_function("Math.abs(isocharge.playground.press.y - 0.2 * 24) < 0.5")
    for button in page.locator("button").all():
        assert button.bounding_box()["height"] >= 36.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_series_of_the_package_is_that_of_the_simulator():
    made = stress_series()
    stored = json.loads(SERIES.read_bytes())
    np.testing.assert_allclose(coefficients(stored["inner"]), coefficients(made["inner"]), atol=2e-5)
    np.testing.assert_allclose(coefficients(stored["outer"]), coefficients(made["outer"]), atol=2e-5)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("name", MODELS)
def test_every_model_of_the_page_is_a_biaxial_film_whose_stress_the_series_describes(name):
    model = load_model(find_model(name))
    sensor = model.metadata.sensor
    assert sensor["film"] == pytest.approx(json.loads(SERIES.read_bytes())["film"])
    assert sensor["piezo"]["d31"] == sensor["piezo"]["d32"]
    polygons = describe_film(name, model.metadata)["polygons_mm"]
    assert [len(polygons[electrode][0]) for electrode in model.metadata.electrodes] == [4] * len(polygons)
