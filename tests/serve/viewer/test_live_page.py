"""Live page: samples and state for browsers, hostile clients, and access by the token and by pages of the server."""

import json
import re
import time

import pytest

from isocharge.common.errors import InputError
from isocharge.serve.viewer.live_page import CONTENT_TYPES, Marker, Record, Tare
from isocharge.serve.viewer.tape import LIVE_SAMPLES, MAX_DRAWN_SAMPLES


def put(client, record, count, **changes):
    """Add records at intervals of 5 ms, the last of which has the present time."""
    end_s = time.time()
    for number in range(count):
        client.page.add(record(timestamp=end_s - 0.005 * (count - 1 - number), **changes))


def record_count(client, answer):
    """Return the number of records that the samples of an answer represent."""
    columns = client.session()["columns"]
    return sum(sample[columns.index("records")] for sample in answer["samples"])


def test_new_browser_receives_the_last_ten_seconds_and_then_each_record_once(client, record):
    put(client, record, 3000)
    answer = client.ask("read")
    assert len(answer["samples"]) == MAX_DRAWN_SAMPLES
    assert record_count(client, answer) == pytest.approx(2000, abs=2)
    assert client.ask("read", first=answer["first"])["samples"] == []
    put(client, record, 100)
    answer = client.ask("read", first=answer["first"], most=7)
    assert (len(answer["samples"]), record_count(client, answer), answer["missed"]) == (7, 100, 0)


def test_records_that_a_slow_browser_misses_are_counted(client, record):
    put(client, record, LIVE_SAMPLES + 250)
    answer = client.ask("read", first=0)
    assert (answer["missed"], record_count(client, answer)) == (250, LIVE_SAMPLES)


def test_position_in_a_recording_limits_the_samples(start_page, record):
    client = start_page(is_recording=True)
    put(client, record, 4000)
    answer = client.ask("read", until_s=12.0)
    start_s, _ = answer["state"]["span"]
    first, *_, last = answer["samples"]
    assert (first[0] - start_s, last[0] - start_s) == pytest.approx((2.0, 12.0), abs=0.1)


def test_state_is_sent_if_it_has_changed(client):
    client.page.update(counters={"frames": 7}, recording="x.rec")
    client.page.add_marker((1.0, ""))
    client.page.add_marker((2.0, "b"))
    answer = client.ask("read")
    assert answer["state"] == {"counters": {"frames": 7}, "recording": "x.rec", "markers": [[1.0, ""], [2.0, "b"]]}
    assert "state" not in client.ask("read", version=answer["version"])


@pytest.mark.parametrize(
    ("content", "action"),
    [
        ({"do": "tare"}, Tare()),
        ({"do": "record", "on": True}, Record(on=True)),
        ({"do": "marker", "text": "here"}, Marker("here")),
    ],
)
def test_actions_reach_the_stream_and_its_errors_reach_the_browser(client, content, action):
    received = []
    client.page.act = received.append
    client.ask(**content)
    assert received == [action]

    def refuse(_):
        raise InputError("not now")

    client.page.act = refuse
    status, _, body = client.send("POST", "/request", content)
    assert (status, json.loads(body)) == (400, {"error": "not now"})


def test_a_recording_cannot_be_changed(start_page):
    status, _, body = start_page(is_recording=True).send("POST", "/request", {"do": "tare"})
    assert (status, "recording cannot be changed" in body.decode()) == (400, True)


@pytest.mark.parametrize(
    "content",
    [
        {"do": "shutdown"},
        {"do": "record"},
        {"do": "marker", "text": "x" * 81},
        {"do": "marker", "text": "a\nb"},
        {"do": "read", "first": -1},
        {"do": "read", "most": 601},
        [],
        "",
        b"\0" * 100,
    ],
)
def test_wrong_request_is_refused_with_the_reason(client, content):
    client.page.act = lambda _: None
    status, _, body = client.send("POST", "/request", content)
    assert status == 400
    assert json.loads(body)["error"]
    assert client.ask("read")["samples"] == []


def test_description_and_samples_need_the_token(start_page):
    client = start_page(token="s3cret")
    assert client.send("GET", "/")[0] == 200  # the page itself contains nothing about the film
    for method, path in (("GET", "/session.json"), ("POST", "/request"), ("GET", "/unknown")):
        assert client.send(method, path, {"do": "read"})[0] == 401
        assert client.send(method, path, {"do": "read"}, Authorization="Bearer other")[0] == 401
    # The page of a reverse proxy may have any name, because pages of other sites do not know the token.
    headers = {"Host": "proxy.example", "Authorization": "Bearer s3cret"}
    assert client.send("POST", "/request", {"do": "read"}, **headers)[0] == 200


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/etc/passwd", 404),
        ("GET", "/request", 405),
        ("PUT", "/request", 405),
    ],
)
def test_unknown_path_wrong_method_and_page_of_another_site_are_refused(client, method, path, status):
    assert client.send(method, path)[0] == status
    assert client.send(method, path, Host="evil.example:8001", Origin="http://evil.example:8001")[0] == 403


def test_file_of_an_unknown_type_in_the_folder_of_the_page_is_not_served(start_page, monkeypatch):
    monkeypatch.delitem(CONTENT_TYPES, ".svg")
    assert start_page().send("GET", "/icon.svg")[0] == 404


def test_files_of_the_page_are_served(client):
    """Each file that the page names is served. The headers forbid the browser to load files from other servers."""
    status, headers, body = client.send("GET", "/")
    assert status == 200
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self'" in policy
    for name in re.findall(rb'(?:href|src)="([^"]+)"', body):
        assert client.send("GET", f"/{name.decode()}")[0] == 200
    session = client.session()
    assert session["film"]["electrodes"] == ["A", "B", "C"]
    assert not session["is_replay"]
