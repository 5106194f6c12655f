"""The page's server, asked by the stock WebSocket client and by others that mean no good."""

import asyncio
import json
import re
import ssl
import time
import urllib.error
from importlib.resources import files

import pytest
import trustme
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosedError, InvalidStatus

from isocharge.serve.network.tls import Tls
from isocharge.serve.viewer.app import MESSAGES_PER_S, VIEWERS, Budget

PAGE = files("isocharge.serve.viewer") / "page"


def put(page, record, count, film=0, **changes):
    """Records 5 ms apart, ending now."""
    end = time.time()
    for k in range(count):
        changed = {"timestamp": end - 0.005 * (count - 1 - k), "seq": k} | changes
        page.readers[film].put(page.form.pack(record(**changed)))


def test_samples_come_as_they_were_put(page, record, viewer):
    async def talk(client):
        await client.samples()
        put(page, record, 3, x_mm=1.5, force_N=0.75)
        header, rows = await client.samples()
        return header, rows

    header, rows = viewer(page, talk)
    assert header[:3] == (1, 0, len(rows))
    assert rows["x_mm"].tolist() == [1.5] * len(rows)
    assert rows["force_N"][-1] == 0.75
    assert rows["charge_pC"][-1][0] == 800.0625


def test_a_new_viewer_sees_the_last_seconds(page, record, viewer):
    put(page, record, 1000)
    time.sleep(0.3)

    async def talk(client):
        return await client.samples()

    header, rows = viewer(page, talk)
    assert header[6] == 1  # begin anew
    assert rows["records"].sum() == 1000
    assert len(rows) <= 600


def test_nobody_gets_more_than_he_draws(page, record, viewer):
    """Two messages that are not confirmed: then nothing, and all that came meanwhile in one with few samples."""

    async def talk(client):
        first, _ = await client.samples(confirm=False)
        put(page, record, 1)
        await client.samples(confirm=False)
        for _ in range(20):
            put(page, record, 100)
            await asyncio.sleep(0.02)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(client.socket.recv(), 0.3)
        await client.confirm(first[3] + 1)
        return await client.samples()

    header, rows = viewer(page, talk)
    assert rows["records"].sum() == 2000
    assert len(rows) < 600
    assert header[5] == 0


def test_a_viewer_that_is_far_behind_is_told_what_it_missed(page, record, viewer):
    async def talk(client):
        first, _ = await client.samples(confirm=False)
        put(page, record, 1)
        await client.samples(confirm=False)
        for _ in range(200):
            put(page, record, 100)
            await asyncio.sleep(0.005)
        await asyncio.sleep(0.1)
        await client.confirm(first[3] + 1)
        return await client.samples()

    header, rows = viewer(page, talk)
    assert header[5] + rows["records"].sum() == 20_000
    assert header[5] > 3000


def test_a_stalled_viewer_holds_up_neither_reader_nor_others(page, record, viewer):
    async def talk(client):
        async with connect(page.live) as stalled:
            stalled.transport.pause_reading()
            seen, began = 0, time.monotonic()
            await client.samples()
            for _ in range(50):
                put(page, record, 10)
                _, rows = await client.samples()
                seen += rows["records"].sum()
            while seen < 500:
                seen += (await client.samples())[1]["records"].sum()
            stalled.transport.resume_reading()
            return seen, time.monotonic() - began

    seen, elapsed_s = viewer(page, talk)
    assert seen == 500
    assert elapsed_s < 10.0
    assert page.readers[0].dropped == 0


def test_requests_reach_the_reader(page, viewer):
    async def talk(client):
        await client.ask(do="tare")
        await client.ask(do="record", on=True)
        await client.ask(do="marker", text="here")
        return [await asyncio.to_thread(page.readers[0].request) for _ in range(3)]

    tare, record, marker = viewer(page, talk)
    assert tare["do"] == "tare"
    assert (record["do"], record["on"]) == ("record", True)
    assert (marker["do"], marker["text"]) == ("marker", "here")


def test_states_reach_the_viewer(page, viewer):
    async def talk(client):
        page.readers[0].tell(counters={"frames": 7}, recording="x.rec")
        page.readers[0].tell(marker=[1.0, ""])
        page.readers[0].tell(marker=[2.0, "b"])
        while True:
            state = await client.text("state")
            if len(state.get("markers", ())) == 2:
                return state

    state = viewer(page, talk)
    assert state["counters"] == {"frames": 7}
    assert state["recording"] == "x.rec"
    assert state["markers"] == [[1.0, ""], [2.0, "b"]]


@pytest.mark.parametrize(
    "nonsense", ["", "nonsense", "[]", '{"do": "shutdown"}', b"", b"12345", "[" * 4000, "\0" * 100]
)
def test_nonsense_is_answered_and_nothing_breaks(page, record, viewer, nonsense):
    async def talk(client):
        await client.socket.send(nonsense)
        error = await client.text("error")
        put(page, record, 1)
        await client.samples()
        return error

    assert "expected" in viewer(page, talk)


def test_a_message_that_is_too_long_ends_the_connection(page, viewer):
    async def talk(client):
        await client.socket.send("x" * 5000)
        while True:
            await client.socket.recv()

    with pytest.raises(ConnectionClosedError, match="1009"):
        viewer(page, talk)
    assert page.get("/")[0] == 200


def test_a_flood_ends_the_connection(page, viewer):
    async def talk(client):
        for _ in range(2000):
            await client.confirm(0)
        while True:
            await client.socket.recv()

    with pytest.raises(ConnectionClosedError, match="1008"):
        viewer(page, talk)
    assert page.get("/")[0] == 200


def test_the_budget_comes_back():
    budget = Budget(10.0, 0.0)
    assert sum(budget.spend(0.0) for _ in range(30)) == 10
    assert sum(budget.spend(0.5) for _ in range(30)) == 5
    assert sum(budget.spend(100.0) for _ in range(30)) == 10
    assert MESSAGES_PER_S > 2 * 60


def test_viewers_are_bounded(page, viewer):
    async def talk(client):
        others = [await connect(page.live) for _ in range(VIEWERS - 1)]
        with pytest.raises(InvalidStatus) as refused:
            await connect(page.live)
        for other in others:
            await other.close()
        await client.ask(do="tare")
        return refused.value.response

    response = viewer(page, talk)
    assert response.status_code == 429
    assert "places for viewers" in json.loads(response.body)["error"]


def test_another_site_s_page_gets_nothing(page, viewer):
    with pytest.raises(InvalidStatus) as refused:
        viewer(page, None, origin="http://evil.example")
    assert refused.value.response.status_code == 403
    with pytest.raises(urllib.error.HTTPError, match="403"):
        page.get("/session.json", Origin="http://evil.example")
    with pytest.raises(urllib.error.HTTPError, match="403"):
        page.get("/session.json", Host="evil.example")


def test_the_token_is_asked_for(start_page, viewer):
    page = start_page(token="s3cret")
    assert page.get("/")[0] == 200  # the page itself says nothing of a film
    with pytest.raises(urllib.error.HTTPError, match="401"):
        page.get("/session.json")
    assert page.get("/session.json", Authorization="Bearer s3cret")[0] == 200
    for options in ({}, {"additional_headers": {"Authorization": "Bearer other"}}):
        with pytest.raises(InvalidStatus) as refused:
            viewer(page, None, **options)
        assert refused.value.response.status_code == 401

    async def talk(client):
        await client.samples()
        return client.socket.subprotocol

    assert viewer(page, talk, additional_headers={"Authorization": "Bearer s3cret"}) == "isocharge.live.1"


def test_the_token_as_a_page_sends_it(start_page):
    page = start_page(token="s3cret")

    async def follow():
        async with connect(page.live, subprotocols=["isocharge.live.1", "bearer.czNjcmV0"]) as socket:
            return socket.subprotocol

    assert asyncio.run(follow()) == "isocharge.live.1"


def test_tls(start_page, viewer, record, tmp_path):
    authority = trustme.CA()
    certificate = authority.issue_cert("127.0.0.1")
    certificate.private_key_and_cert_chain_pem.write_to_path(tmp_path / "server.pem")
    page = start_page(tls=Tls(tmp_path / "server.pem"))
    assert page.live.startswith("wss://")
    context = ssl.create_default_context()
    authority.configure_trust(context)

    async def talk(client):
        put(page, record, 1)
        await client.ask(do="tare")
        return await client.samples()

    viewer(page, talk, ssl=context)
    assert page.readers[0].request()["do"] == "tare"


def test_two_films_on_one_page(start_page, record, viewer):
    page = start_page(films=2)

    async def talk(client):
        put(page, record, 5, film=1, x_mm=-3.0)
        while True:
            header, rows = await client.samples()
            if header[1] == 1 and len(rows):
                await client.ask(do="tare", film=1)
                return rows

    assert viewer(page, talk)["x_mm"][-1] == -3.0
    assert page.readers[1].request()["do"] == "tare"


def test_the_end_of_the_stream_ends_the_page(start_page, viewer):
    page = start_page()

    async def talk(client):
        await client.samples()
        page.readers[0].close()
        while True:
            await client.socket.recv()

    with pytest.raises(ConnectionClosedError, match="1012"):
        viewer(page, talk)


@pytest.mark.parametrize("path", ["/etc/passwd", "/../app.py", "/vendor", "/v2", "/live"])
def test_other_paths(page, path):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        page.get(path)


def test_files_of_the_page(page):
    """Every file that the page names is served, loads nothing from elsewhere, and a browser is told to see to it."""
    status, headers, body = page.get("/")
    assert status == 200
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self'" in policy
    for name in re.findall(rb'(?:href|src)="([^"]+)"', body):
        assert page.get(f"/{name.decode()}")[0] == 200
    session = json.loads(page.get("/session.json")[2])
    assert session["films"][0]["electrodes"] == ["A", "B", "C"]
    assert not session["is_replay"]
