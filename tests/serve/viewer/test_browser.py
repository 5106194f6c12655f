"""The start page and the live page in headless Chromium: the live page draws each press where and as hard as it is."""

import contextlib
import re
import socket
import time

import numpy as np
import pytest

from isocharge.serve import Script, VirtualSensor
from isocharge.serve.network.protocol.page import page as start_page

RATE_HZ, PRESS_S, PAUSE_S = 200.0, 1.5, 0.9
PRESSES = [(0.0, 0.0, 1.0), (6.0, 2.0, 0.5), (-5.0, 3.0, 2.0), (2.0, -6.0, 0.2), (5.0, -3.5, 0.1)]

DRAWN = """() => {
  const film = isocharge.page.film, plan = film.plan, canvas = plan.canvas;
  const g = canvas.getContext("2d"), { data } = g.getImageData(0, 0, canvas.width, canvas.height);
  const lens = plan.lens ?? { x: 1e9, y: 1e9, size: 0 }, mm = plan.pixel, css = canvas.width / canvas.clientWidth;
  let [count, x, y, left, right, top, bottom] = [0, 0, 0, Infinity, 0, Infinity, 0];
  for (let j = 0; j < canvas.height; j++) for (let i = 0; i < canvas.width; i++) {
    const at = 4 * (j * canvas.width + i);
    if (data[at] < 150 || data[at + 2] > 90 || data[at + 1] > 150) continue;
    const [u, v] = [(i - canvas.width / 2) * mm, (canvas.height / 2 - j) * mm];
    if (Math.hypot(u - lens.x, v - lens.y) < 1.05 * lens.size) continue;
    count++; x += i; y += j;
    [left, right, top, bottom] = [Math.min(left, i), Math.max(right, i), Math.min(top, j), Math.max(bottom, j)];
  }
  return { kind: film.drawnKind, count,
    x: (x / count + 0.5 - canvas.width / 2) * mm, y: (canvas.height / 2 - y / count - 0.5) * mm,
    width: (right - left + 1) / css, height: (bottom - top + 1) / css, shown: [".x b", ".y b", ".force b"].map(
      (name) => Number(film.find(name).textContent.replace("\\u2212", "-"))) };
}"""

LATENCY = """() => {
  const { film } = isocharge.page;
  film.ages = [-56, -50, -40];
  film.showHealth();
  return film.find(".age").textContent;
}"""


@pytest.fixture
def presses(film):
    """Presses that stand still, with pauses that are long enough for a tare, played again and again."""
    pause, press = np.zeros(round(PAUSE_S * RATE_HZ)), np.ones(round(PRESS_S * RATE_HZ))
    force_N = np.concatenate([np.concatenate([pause, force * press]) for _, _, force in PRESSES])
    places = [
        np.concatenate([np.concatenate([pause * np.nan, place[axis] * press]) for place in PRESSES]) for axis in (0, 1)
    ]
    with VirtualSensor(film.charges, Script(*places, force_N, RATE_HZ)) as sensor:
        yield sensor


@pytest.fixture
def free_port():
    with contextlib.closing(socket.socket()) as place:
        place.bind(("127.0.0.1", 0))
        return place.getsockname()[1]


@pytest.fixture
def start_stream(presses, models, free_port, start_command, tmp_path, monkeypatch):
    """Start `serve stream --live`, on the same port again and again."""
    monkeypatch.chdir(tmp_path)

    def start():
        process = start_command(
            *("serve", "stream", "linear", "--models", models, "--port", presses.url, "--output", "none"),
            *("--live", f"127.0.0.1:{free_port}"),
        )
        while "live page" not in (line := process.stderr.readline()):
            assert line, "the page did not start"
        return process

    return start


@pytest.fixture
def open_page(chromium, free_port):
    """Open the page in a new window; whatever it complains about fails the test."""
    complaints, contexts = [], []

    def start():
        contexts.append(chromium.new_context(viewport={"width": 1280, "height": 820}))
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.goto(f"http://127.0.0.1:{free_port}/", timeout=120_000)
        wait_for(page, "isocharge.page.film?.history.latest != null")
        return page

    yield start
    for context in contexts:
        context.close()
    assert [text for text in complaints if not re.search(r"ERR_CONNECTION|WebSocket|Failed to load", text)] == []


def wait_for(page, expression, timeout_s=40.0):
    """As `wait_for_function`, which the page's own policy forbids."""
    end = time.monotonic() + timeout_s
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(20)


def test_live_page_shows_numbers_and_sends_tare_pause_record_and_marker(start_stream, open_page, tmp_path):
    start_stream()
    page = open_page()
    wait_for(page, "isocharge.page.film.drawnKind === 'contact'")
    x, y, force = page.evaluate(DRAWN)["shown"]
    assert min(np.hypot(px - x, py - y) + abs(pressed - force) for px, py, pressed in PRESSES) < 0.3
    latency = page.evaluate(LATENCY)
    assert latency == "6 ms"  # the board's clock is 56 ms ahead
    page.get_by_role("button", name="Tare").click()
    wait_for(page, "isocharge.page.film.drawnKind === 'tare'")
    wait_for(page, "isocharge.page.film.drawnKind === 'contact'")

    picture = "isocharge.page.film.find('.trace.force canvas').toDataURL()"
    page.keyboard.press("Space")
    wait_for(page, "document.querySelector('[data-do=pause]').getAttribute('aria-pressed') === 'true'")
    before, end = page.evaluate(picture), page.evaluate("isocharge.page.film.history.end")
    page.wait_for_timeout(500)
    assert page.evaluate(picture) == before
    assert page.evaluate("isocharge.page.film.history.end") > end  # the stream does not pause
    page.keyboard.press("Space")
    wait_for(page, f"{picture} !== {before!r}")

    page.get_by_role("button", name="Record").click()
    wait_for(page, "isocharge.page.film.state.recording")
    page.keyboard.press("m")
    wait_for(page, "isocharge.page.film.history.markers.length === 1")
    page.keyboard.press("r")
    wait_for(page, "!isocharge.page.film.state.recording")
    (path,) = tmp_path.glob("linear-1-*.rec")
    assert '{"marker":' in path.read_text()

    for width, height in ((1280, 820), (390, 844), (820, 1180)):
        page.set_viewport_size({"width": width, "height": height})
        wait_for(page, f"document.documentElement.scrollWidth === {width}")
        plan = page.locator(".plan canvas").bounding_box()
        assert plan["y"] + plan["height"] <= height  # the film is seen without scrolling


def test_start_page_shows_all_columns_on_a_desktop_and_on_a_phone(chromium, store):
    html = (
        start_page(store)
        .replace("linear/", "eight-25um-biaxial-student/")
        .replace("A, B, C<", "A, B, C, D, E, F, G, H<")
    )
    page = chromium.new_page()
    page.set_content(html)
    for width in (1280, 390):
        page.set_viewport_size({"width": width, "height": 844})
        boxes = [cell.bounding_box() for cell in page.locator("td, dd").all()]
        assert all(box["x"] + box["width"] <= width for box in boxes)
        assert min(cell.bounding_box()["width"] for cell in page.locator("dd").all()) > 300
    page.close()
