"""Pages in headless Chromium: the live page draws each press where and as hard as it is; pages of other sites."""

import json
import re
import signal
import threading
import time

import numpy as np
import pytest

from infer_requests import INFER, infer_request
from isocharge.serve import Script, VirtualSensor
from isocharge.serve.network.protocol.handler import Handler
from serve.viewer.conftest import errors_of

RATE_HZ, PRESS_S, PAUSE_S = 200.0, 1.5, 0.9
PRESSES = [(0.0, 0.0, 1.0), (6.0, 2.0, 0.5), (-5.0, 3.0, 2.0), (2.0, -6.0, 0.2), (5.0, -3.5, 0.1)]

SHOWN = """[".x b", ".y b", ".force b"].map(
  (name) => Number(isocharge.page.film.find(name).textContent.replace("\\u2212", "-")))"""

LATENCY = """async () => {
  const { film } = isocharge.page, { fetch } = window;
  const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  film.ages = [-56, -50, -40];
  film.showHealth();
  const shown = film.find(".age").textContent;
  window.fetch = async (...request) => {
    await wait(500);
    const answer = await fetch(...request);
    await wait(500);
    return answer;
  };
  await wait(2500);
  window.fetch = fetch;
  return `${shown}, ${film.ages.at(-1) > 450}`;
}"""

NOTE = """() => {
  const { film } = isocharge.page, at = Date.now() / 1000 + 60;
  film.take({ samples: [], missed: 0, sent_s: at });
  film.update({ ...film.state, note: { text: "hot", at } });
  film.showHealth();
  return film.find(".note").textContent;
}"""


@pytest.fixture
def touch():
    """Event before which nothing touches the film, so that the first tare is right however late the stream starts."""
    return threading.Event()


@pytest.fixture
def sensor(film, touch):
    """A sensor of presses that stand still, with pauses that are long enough for a tare, played again and again."""
    rows = [row for press in PRESSES for row in ((np.nan, np.nan, 0.0), press)]
    counts = [round(PAUSE_S * RATE_HZ), round(PRESS_S * RATE_HZ)] * len(PRESSES)
    presses = Script(np.repeat(rows, counts, axis=0), RATE_HZ)
    with VirtualSensor(film.charges, presses, noise=lambda charge_pC, _: charge_pC * touch.is_set()) as sensor:
        yield sensor


@pytest.fixture
def stream(sensor, start_live, tmp_path, monkeypatch):
    """Start `serve stream --live`. Return the process and a client of its page."""
    monkeypatch.chdir(tmp_path)
    return start_live("stream", "linear", "--port", sensor.url, "--output", "none")


@pytest.fixture
def page(chromium, stream):
    """The page of the stream in a window. Whatever it complains about fails the test."""
    context = chromium.new_context(viewport={"width": 1280, "height": 820})
    page = context.new_page()
    complaints = errors_of(page)
    page.goto(stream[1].url, timeout=120_000)
    wait_for(page, "isocharge.page.film?.history.latest != null")
    yield page
    context.close()
    assert [text for text in complaints if not re.search(r"ERR_CONNECTION|WebSocket|Failed to load", text)] == []


def wait_for(page, expression, timeout_s=40.0):
    """Return the expression's first true value, as `wait_for_function` does, which the page's own policy forbids."""
    end = time.monotonic() + timeout_s
    while not (value := page.evaluate(expression)):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(20)
    return value


def test_live_page_shows_numbers_until_the_frames_stop_and_sends_requests(stream, page, touch, tmp_path):
    """The requests are a tare, a pause, a recording and a marker."""
    wait_for(page, "isocharge.page.film.drawnKind === 'none'")
    touch.set()
    # The kind and the numbers are read at once: a press that ends in between takes its numbers away.
    x, y, force = wait_for(page, f"isocharge.page.film.drawnKind === 'contact' && {SHOWN}")
    assert min(np.hypot(px - x, py - y) + abs(pressed - force) for px, py, pressed in PRESSES) < 0.3
    latency = page.evaluate(LATENCY)
    assert latency == "6 ms, true"  # the board's clock is 56 ms ahead; a slow answer travels for 500 ms
    assert page.evaluate(NOTE) == "hot"  # the server's clock is a minute ahead
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
    for press in ("down", "down", "up"):  # while a key is held, the browser repeats it
        getattr(page.keyboard, press)("m")
    wait_for(page, "isocharge.page.film.history.markers.length === 1")
    page.keyboard.press("r")
    wait_for(page, "!isocharge.page.film.state.recording")
    (path,) = tmp_path.glob("linear-1-*.rec")
    assert path.read_text().count('{"marker":') == 1

    for width, height in ((1280, 820), (390, 844), (820, 1180)):
        page.set_viewport_size({"width": width, "height": height})
        wait_for(page, f"document.documentElement.scrollWidth === {width}")
        plan = page.locator(".plan canvas").bounding_box()
        assert plan["y"] + plan["height"] <= height  # the film is seen without scrolling

    wait_for(page, "isocharge.page.film.drawnKind === 'contact'")
    stream[0].send_signal(signal.SIGSTOP)
    shown = wait_for(page, f"isocharge.page.film.drawnKind === 'silent' && {{shown: {SHOWN}}}")["shown"]
    assert np.all(np.isnan(shown))


UNLOAD = "/v2/repository/models/linear/unload"

ATTACK = """<!doctype html><title>attack</title><iframe name="result"></iframe>
<form id="form" method="post" enctype="text/plain" target="result" action="{target}{unload}"><input name="x"></form>
<script>
async function attack() {{
  const tensor = {{ name: "charge_pC", datatype: "FP32", shape: [1, 3], data: [1, 2, 3] }};
  const body = JSON.stringify({{ inputs: [tensor] }});
  const answers = [];
  for (const [path, options] of [
    ["{infer}", {{ method: "POST", mode: "no-cors", body }}], ["{unload}", {{ method: "POST", mode: "no-cors" }}],
    ["/v2", {{ mode: "no-cors" }}], ["/metrics", {{}}],
  ]) {{
    try {{
      const answer = await fetch("{target}" + path, options);
      answers.push(answer.type === "opaque" ? "opaque" : answer.status);
    }} catch (error) {{ answers.push("blocked"); }}
  }}
  return answers;
}}
</script>"""


def test_no_page_of_another_origin_operates_the_server_in_chromium(chromium, store, start_http):
    handler = Handler(store)
    url = start_http(handler).url
    port = url.rpartition(":")[2]
    attack = ATTACK.format(target=url, infer=INFER, unload=UNLOAD)
    page = chromium.new_page()

    # A page of another origin: a form, and fetches that may not read the answers.
    page.route("http://evil.example/", lambda route: route.fulfill(body=attack, content_type="text/html"))
    page.goto("http://evil.example/")
    page.evaluate("attack()")
    page.evaluate("document.getElementById('form').submit()")
    page.wait_for_timeout(500)

    # A rebound name: the page and the server have the same origin, and the page could read the answers.
    answer = page.goto(f"http://evil.example:{port}/v2")
    assert answer.status == 403
    content = page.evaluate("fetch('/v2/models/linear').then((answer) => answer.text())")
    assert "Host: expected an IP address" in json.loads(content)["error"]

    # The server's own page, which a user opens by its address, still works.
    assert page.goto(f"{url}/v2").status == 200
    statuses = "fetch('/v2/models/linear/infer', { method: 'POST', body: arguments }).then((answer) => answer.status)"
    body = json.dumps(json.dumps(infer_request()))
    assert page.evaluate(statuses.replace("arguments", body)) == 200
    page.close()

    samples = [sample for family in handler.traffic.registry.collect() for sample in family.samples]
    assert sum(sample.value for sample in samples if sample.labels.get("status") == "403") >= 5
    statistics = store.get("linear", "").statistics.to_json()
    assert statistics["inference_count"] == 1  # the press of the server's own page
    assert len(store.versions_of()) == 2  # nothing was unloaded


def test_typed_token_opens_the_page_of_a_recording(chromium, start_page):
    """The page has one button to pause, and the film in relief becomes low again after its row was high."""
    page = chromium.new_page()
    page.goto(start_page(token="s3cret", is_recording=True).url)
    responses = {"other": page.get_by_text("token is wrong"), "s3cret": page.get_by_role("button", name="Pause")}
    for token, response in responses.items():
        page.get_by_label("Token").fill(token)
        page.keyboard.press("Enter")
        response.wait_for()  # fails if there are two
    relief = page.locator(".relief")
    box = relief.bounding_box()
    for flags_height in ("900px", ""):
        page.locator(".flags").evaluate(f"flags => flags.style.height = '{flags_height}'")
        page.wait_for_timeout(500)
    assert relief.bounding_box() == box
