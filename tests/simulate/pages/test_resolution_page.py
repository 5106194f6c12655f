"""The page of `simulate identify --html`: one file, with the numbers of the identification, in every browser."""

import base64
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    ForwardMap,
    Resolution,
    SolveSettings,
    Theory,
    limits_at,
    load_sensor,
    noise_model,
)
from isocharge.simulate.identifiability.identification import LimitMap, identify
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.pages.resolution_page import resolution_page

MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)
CHROMIUM = shutil.which("chromium")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run")
FLAGS += ("--disable-background-networking", "--disable-component-update", "--disable-sync")


@pytest.fixture(scope="module")
def identification():
    """A film that folds within 5 mm, its electrodes turned."""
    sensor = load_sensor("three-25um-uniaxial")
    sensor = replace(sensor, calibration=replace(sensor.calibration, rotation=0.1))
    settings = SolveSettings(theory=MEMBRANE, resolution=Resolution(4, 8, 4))
    return identify(ForwardMap.build(sensor, Circle(1e-3), 5e-3, (0.05, 2.0), settings), noise_model("reference"))


@pytest.fixture(scope="module")
def page(identification):
    return resolution_page(identification)


class Elements(HTMLParser):
    """Elements with their attributes, and the texts of title and scripts."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.texts, self._inside = [], [], None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, _):
        self._inside = None

    def handle_data(self, data):
        if self._inside in ("script", "title", "h1"):
            self.texts.append(data)


def data_of(page):
    scripts = [text for text in Elements(page).texts if text.startswith("{")]
    assert len(scripts) == 1
    return json.loads(scripts[0])


def decoded(table, data):
    logs = np.frombuffer(base64.b64decode(table["log16"]), "<u2") / 65535.0
    values = table["smallest"] * (table["largest"] / table["smallest"]) ** logs
    return values.reshape(len(data["force_N"]), data["rings"], data["angles"])


def test_it_is_one_file_that_asks_for_nothing(page):
    elements = Elements(page).elements
    assert not [attrs for _, attrs in elements if {"src", "href", "srcset", "action"} & set(attrs)]
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|WebSocket|import\(", page)
    assert not re.search(r"https?://", page)
    (policy,) = [attrs["content"] for _, attrs in elements if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert len(page.encode()) < 1_000_000
    assert "@@" not in page


def test_it_has_the_numbers_of_the_identification(identification, page):
    data, about = data_of(page), identification.to_dict()
    assert (data["sensor"], data["probe"]) == (about["sensor"], about["probe"])
    assert (data["area"], data["folds_mm"]) == (about["working_area"], about["folds_mm"])
    assert data["folds_mm"]
    np.testing.assert_allclose(data["force_N"], np.geomspace(0.05, 2.0, 13))
    rings = Rings.spread(5e-3, data["rings"], data["angles"])
    for number, force in enumerate(data["force_N"]):
        limits = LimitMap.of(identification.charges, identification.noise, force, rings)
        np.testing.assert_allclose(decoded(data["position"], data)[number], 1e3 * limits.position, rtol=3e-4)
        np.testing.assert_allclose(decoded(data["force"], data)[number], 1e2 * limits.relative_force, rtol=3e-4)
    for electrode, shown in zip(identification.sensor.electrodes, data["electrodes"], strict=True):
        turn = np.exp(0.1j) * (np.array(electrode.corners) @ [1.0, 1.0j])
        np.testing.assert_allclose(np.array(shown["corners_mm"]) @ [1.0, 1.0j], 1e3 * turn, atol=1e-4)
    for name in ("position", "force"):
        low, high = data[name]["colours"]
        values = decoded(data[name], data)
        assert np.mean(values < low) < 0.02
        assert low > 0.2 * values.min()
        assert np.mean(values > high) < 0.15
        assert all(f"{end:e}"[0] in "125" for end in (low, high))


def test_the_same_identification_gives_the_same_bytes(identification, page):
    assert resolution_page(identification) == page


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "<b>&amp;", "@@script@@", "Fühler \u2028 '\""])
def test_a_name_is_only_a_name(identification, name):
    page = resolution_page(replace(identification, sensor=replace(identification.sensor, name=name)))
    parsed = Elements(page)
    assert [tag for tag, _ in parsed.elements].count("script") == 2
    assert data_of(page)["sensor"] == name
    assert f"Resolution of {name}" in parsed.texts


def test_one_force_is_enough(identification):
    area = replace(identification.area, force_range=(1.0, 1.0))
    data = data_of(resolution_page(replace(identification, area=area)))
    assert data["force_N"] == [1.0]
    assert decoded(data["position"], data).shape == (1, 100, 90)


# In a browser


@pytest.fixture
def browser():
    """Debian's Chromium, with nothing but a page."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
    if CHROMIUM is None:
        pytest.skip("needs Debian's package chromium")
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, page, tmp_path):
    """Open the page in a window of some kind; complaints of the browser fail the test."""
    path, complaints = tmp_path / "page.html", []
    path.write_text(page, encoding="utf-8")

    def show(width=1280, height=960, scheme="light", **options):
        window = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme, **options)
        view = window.new_page()
        view.on("pageerror", lambda error: complaints.append(str(error)))
        view.on("console", lambda message: complaints.append(message.text))
        view.on("request", lambda request: complaints.append(request.url) if request.url != path.as_uri() else None)
        view.goto(path.as_uri())
        settle(view)
        return view

    yield show
    assert complaints == []


def settle(view):
    """Wait until a frame was drawn."""
    view.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


@pytest.mark.slow
def test_values_between_the_tabulated_ones(opened, identification):
    """Within 1 % nearly everywhere, and 5 % but for folds, where the errors grow without bounds."""
    view, rng = opened(), np.random.default_rng(8)
    distance, angle = 5.0 * np.sqrt(rng.uniform(0, 1, 300)), rng.uniform(-np.pi, np.pi, 300)
    force = np.exp(rng.uniform(np.log(0.05), np.log(2.0), 300))
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    read = view.evaluate(
        """presses => presses.map(([x, y, force]) => {
          const [first, last] = [data.force_N[0], data.force_N[data.force_N.length - 1]];
          state.share = Math.log(force / first) / Math.log(last / first);
          return ["position", "force"].map(name => Math.exp(valueAt(sheet(name), x, y)));
        })""",
        np.stack([x, y, force], axis=1).tolist(),
    )
    limits = limits_at(identification.charges, np.stack([1e-3 * x, 1e-3 * y, force], axis=1), identification.noise)
    expected = np.stack([1e3 * limits.position, 1e2 * limits.force], axis=1)
    folds = np.array(identification.to_dict()["folds_mm"])
    clear = np.hypot(x[:, None] - folds[:, 0], y[:, None] - folds[:, 1]).min(axis=1) > 0.5
    assert clear.sum() > 150
    wrong = np.abs(np.array(read)[clear] / expected[clear] - 1.0)
    assert np.quantile(wrong, 0.95) < 0.01
    assert wrong.max() < 0.05


@pytest.mark.slow
def test_slider_keys_and_hover_read_the_map(opened, identification):
    view = opened()
    assert "Force 1.00 N" in view.inner_text("label[for=force]")
    table = view.inner_text("#summary").split()
    row = next(row for row in identification.to_dict()["limits_in_working_area"] if row["force_N"] == 1.0)
    figures = [float(text) for text in table if re.fullmatch(r"[\d.]+", text)]
    names = [f"{kind}_{which}" for kind in ("position", "force") for which in ("median", "rms", "worst")]
    expected = [row[f"{name}_{'mm' if name.startswith('position') else 'percent'}"] for name in names]
    np.testing.assert_allclose(figures, expected, rtol=0.04)  # printed with two digits
    at_one = view.inner_text("#reading")
    view.focus("#force")
    for _ in range(50):
        view.keyboard.press("ArrowLeft")
    settle(view)
    assert "Force 0.831 N" in view.inner_text("label[for=force]")
    assert view.inner_text("#reading") != at_one
    view.focus("#map")
    view.keyboard.press("ArrowRight")
    view.keyboard.press("Shift+ArrowDown")
    settle(view)
    assert "(0.10, -1.00) mm" in view.inner_text("#reading")
    box = view.locator("#map").bounding_box()
    view.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    settle(view)
    assert re.search(r"\(-?0\.0\d, -?0\.0\d\) mm\s+in the working area", view.inner_text("#reading"))
    view.mouse.move(box["x"] + 2, box["y"] + 2)
    settle(view)
    assert "beyond what was searched" in view.inner_text("#reading")
    before = view.screenshot()
    view.check("input[value=force]")
    settle(view)
    assert view.screenshot() != before


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [(1280, 960), (390, 844)])
def test_it_fits_every_screen(opened, scheme, width, height):
    view = opened(width, height, scheme, device_scale_factor=2)
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    paper = view.evaluate("getComputedStyle(document.body).backgroundColor")
    assert paper == {"light": "rgb(255, 255, 255)", "dark": "rgb(18, 24, 31)"}[scheme]
    pixels = view.evaluate("document.getElementById('map').width")
    assert abs(pixels - 2 * view.locator("#map").bounding_box()["width"]) <= 1.0
    painted = view.evaluate(
        """() => { const map = document.getElementById("map"), n = map.width;
        const p = map.getContext("2d").getImageData(0, 0, n, n).data;
        let opaque = 0; for (let i = 3; i < p.length; i += 4) opaque += p[i] === 255; return opaque / (n * n); }"""
    )
    assert 0.1 < painted < 0.9
