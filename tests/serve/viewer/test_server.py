"""Server of the live page: samples for viewers, hostile clients, and access by the token and by pages of the server."""

import asyncio
import base64
import json
import re
import socket
import struct
import time
import urllib.error
from contextlib import suppress
from urllib.parse import urlsplit

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosedError, InvalidStatus

from isocharge.common.errors import OriginError, TokenError
from isocharge.serve.network.address import Token
from isocharge.serve.viewer import connection
from isocharge.serve.viewer.connection import MAX_BURST_BYTES, RateLimit
from isocharge.serve.viewer.hub import MAX_MESSAGE_SAMPLES, MAX_SAMPLE_RATE_HZ
from isocharge.serve.viewer.server import MAX_VIEWERS, Access


def put(page, record, count, **changes):
    """Send records at intervals of 5 ms, the last of which has the present time."""
    end_s = time.time()
    for number in range(count):
        fields = {"timestamp": end_s - 0.005 * (count - 1 - number), "seq": number} | changes
        page.reader.send_sample(page.form.pack(record(**fields)))


def test_new_viewer_receives_the_last_seconds(page, record, viewer):
    async def talk(client):
        record_count = 0
        headers = []
        while record_count < 1000:
            header, rows = await client.samples()
            headers.append(header)
            record_count += rows["records"].sum()
            assert len(rows) <= 600
        return headers

    put(page, record, 1000)
    headers = viewer(page, talk)
    begins_anew = [bool(header[6]) for header in headers]
    assert begins_anew == [True, *[False] * (len(headers) - 1)]


@pytest.mark.parametrize("turns", [20, 200])
def test_viewer_receives_samples_only_after_confirming_earlier_ones(page, record, viewer, turns):
    """A viewer with two unconfirmed messages receives nothing. All later samples then come coalesced in one message.

    Samples that could not be stored are counted as missed.
    """

    async def talk(client):
        first, _ = await client.samples(confirm=False)
        start_s = time.time()
        put(page, record, 1)
        await client.samples(confirm=False)
        for _ in range(turns):
            put(page, record, 100)
            await asyncio.sleep(0.005)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(client.socket.recv(), 0.3)
        await client.confirm(first[3] + 1)
        return *await client.samples(), time.time() - start_s

    header, rows, elapsed_s = viewer(page, talk)
    missed = header[5]
    assert missed + rows["records"].sum() == 100 * turns
    assert missed > 3000 if turns == 200 else missed == 0
    # On a busy machine more time passes, so that the message may contain exactly the largest number of samples.
    assert len(rows) <= MAX_SAMPLE_RATE_HZ * elapsed_s
    assert len(rows) <= MAX_MESSAGE_SAMPLES


def test_stalled_viewer_delays_neither_the_reader_nor_other_viewers(page, record, viewer):
    async def talk(client):
        async with connect(page.live) as stalled:
            stalled.transport.pause_reading()
            record_count = 0
            await client.samples()
            for _ in range(50):
                put(page, record, 10)
                _, rows = await client.samples()
                record_count += rows["records"].sum()
            while record_count < 500:
                _, rows = await client.samples()
                record_count += rows["records"].sum()
            stalled.transport.resume_reading()
            return record_count

    assert viewer(page, talk) == 500
    assert page.reader.dropped == 0


def test_state_messages_are_sent_to_the_viewer(page, viewer):
    async def talk(client):
        page.reader.send_message(counters={"frames": 7}, recording="x.rec")
        page.reader.send_message(marker=[1.0, ""])
        page.reader.send_message(marker=[2.0, "b"])
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
def test_invalid_message_is_answered_with_an_error(page, record, viewer, nonsense):
    async def talk(client):
        await client.socket.send(nonsense)
        error = await client.text("error")
        put(page, record, 1)
        await client.samples()
        return error

    assert "expected" in viewer(page, talk)


def test_too_long_message_ends_the_connection(page, viewer):
    async def talk(client):
        await client.socket.send("x" * 5000)
        while True:
            await client.socket.recv()

    with pytest.raises(ConnectionClosedError, match="1009"):
        viewer(page, talk)
    assert page.get("/")[0] == 200


MASK = bytes(4)
FLOODS = {
    "confirmations": b"\x82\x84" + MASK + bytes(4),
    "pings": b"\x89\x80" + MASK,
    "long pings": b"\x89\xfd" + MASK + bytes(125),
    "pongs": b"\x8a\x80" + MASK,
    "empty continuations": b"\x00\x80" + MASK,
}
"""Bytes of WebSocket frames. The first byte is the kind, and the second byte is the length with the bit of the mask."""


def open_websocket(place):
    """Return a socket with an open WebSocket connection to the live stream."""
    client = socket.create_connection((place.hostname, place.port), timeout=20)
    client.sendall(
        b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    assert b" 101 " in client.recv(100)
    return client


def test_reading_is_paused_while_the_client_reads_no_responses(start_page, monkeypatch):
    """Otherwise, pongs that the client does not read would fill the memory."""
    monkeypatch.setattr(connection, "MAX_BURST_BYTES", 1 << 40)
    with open_websocket(urlsplit(start_page().url)) as hostile:
        hostile.settimeout(1.0)
        with pytest.raises(TimeoutError):
            hostile.sendall(FLOODS["long pings"] * 200_000)  # 26 MB, more than the system's buffers


@pytest.mark.parametrize("kind", FLOODS)
def test_too_much_data_in_any_kind_of_frame_ends_the_connection(page, record, viewer, kind):
    """The limit also applies to frames that are no messages. Another viewer still receives its samples."""
    place = urlsplit(page.url)

    def flood():
        with open_websocket(place) as hostile:
            first = b"\x01\x80" + MASK if kind == "empty continuations" else b""
            sent = 0
            with suppress(OSError):
                hostile.sendall(first)
                while sent < 100 * MAX_BURST_BYTES:
                    hostile.sendall(FLOODS[kind] * 50)
                    sent += 50 * len(FLOODS[kind])
                while hostile.recv(1 << 16):
                    pass
            return sent

    async def talk(client):
        flooding = asyncio.create_task(asyncio.to_thread(flood))
        for _ in range(10):
            put(page, record, 1)
            await client.samples()
        return await flooding

    assert viewer(page, talk) < 100 * MAX_BURST_BYTES


def test_rate_limit_refills_with_time():
    limit = RateLimit(10.0, 5.0, 0.0)
    assert limit.allows(5, 0)
    assert limit.allows(5, 0)
    assert not limit.allows(5, 0)
    assert limit.allows(4, 2)
    assert limit.allows(10, 100)
    assert not limit.allows(11, 200)


def test_number_of_viewers_is_limited(page, viewer):
    async def talk(client):
        others = [await connect(page.live) for _ in range(MAX_VIEWERS - 1)]
        with pytest.raises(InvalidStatus) as refused:
            await connect(page.live)
        for other in others:
            await other.close()
        await client.ask(do="tare")
        return refused.value.response

    response = viewer(page, talk)
    assert response.status_code == 429
    assert "places for viewers" in json.loads(response.body)["error"]


@pytest.mark.parametrize(
    "request_",
    [
        b"GET / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n" + b"a: b\r\n" * 500_000,
        b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 500_000,
        b"GET /" + b"a" * 3_000_000 + b" HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 3000000\r\n\r\n" + bytes(3_000_000),
        struct.pack("<1000d", *range(1000)),
    ],
    ids=["trailers", "headers", "address", "body", "noise"],
)
def test_wrong_http_request_is_refused(page, request_):
    """A request of any length is refused or answered before it has been read completely."""
    place = urlsplit(page.url)
    with socket.create_connection((place.hostname, place.port), timeout=20) as connection:
        with suppress(OSError):
            connection.sendall(request_)
            connection.shutdown(socket.SHUT_WR)
        answer = b""
        with suppress(ConnectionResetError):
            while piece := connection.recv(1 << 16):
                answer += piece
    assert not answer or re.match(rb"HTTP/1\.1 (200|4\d\d) ", answer)
    assert page.get("/")[0] == 200


def test_websocket_from_a_page_of_another_site_is_refused(page, viewer):
    with pytest.raises(InvalidStatus) as refused:
        viewer(page, None, origin="http://evil.example")
    assert refused.value.response.status_code == 403
    with pytest.raises(urllib.error.HTTPError, match="403"):
        page.get("/session.json", Host="evil.example")


def test_description_and_websocket_need_the_token(start_page, viewer):
    page = start_page(token="s3cret")
    assert page.get("/")[0] == 200  # the page itself contains nothing about the film
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

    token_in_header = {"additional_headers": {"Authorization": "Bearer s3cret"}}
    token_in_subprotocol = {"subprotocols": ["isocharge.live.1", "bearer.czNjcmV0"]}
    for options in (token_in_header, token_in_subprotocol):
        assert viewer(page, talk, **options) == "isocharge.live.1"


def test_page_ends_with_the_stream(start_page, viewer):
    page = start_page()

    async def talk(client):
        await client.samples()
        page.reader.close()
        while True:
            await client.socket.recv()

    with pytest.raises(ConnectionClosedError, match="1012"):
        viewer(page, talk)


@pytest.mark.parametrize("path", ["/etc/passwd", "/../server.py", "/vendor"])
def test_unknown_path_is_not_found(page, path):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        page.get(path)


def test_files_of_the_page_are_served(page):
    """Each file that the page names is served. The headers forbid the browser to load files from other servers."""
    status, headers, body = page.get("/")
    assert status == 200
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self'" in policy
    for name in re.findall(rb'(?:href|src)="([^"]+)"', body):
        assert page.get(f"/{name.decode()}")[0] == 200
    session = json.loads(page.get("/session.json")[2])
    assert session["film"]["electrodes"] == ["A", "B", "C"]
    assert not session["is_replay"]


def bearer(token):
    """Return the subprotocol that contains a token."""
    return "bearer." + base64.urlsafe_b64encode(token.encode()).decode().rstrip("=")


@pytest.mark.parametrize("host", [b"127.0.0.1:8001", b"localhost:8001", b"[::1]:8001", b"192.168.1.7"])
def test_access_allows_pages_of_this_machine(host):
    Access().check({b"host": host, b"origin": b"http://" + host})


@pytest.mark.parametrize(
    "origin", [b"http://evil.example", b"null", b"http://127.0.0.1:9999", b"http://[", b"file://", b"\xff\xfe"]
)
def test_access_refuses_pages_of_other_sites(origin):
    with pytest.raises(OriginError):
        Access().check({b"host": b"127.0.0.1:8001", b"origin": origin})


def test_second_host_header_is_refused(page):
    with socket.create_connection(page.url.removeprefix("http://").split(":"), timeout=20) as client:
        client.sendall(b"GET /session.json HTTP/1.1\r\nHost: localhost\r\nHost: 127.0.0.1\r\n\r\n")
        assert client.recv(1000).startswith(b"HTTP/1.1 400 ")


def test_access_refuses_a_rebound_host_name():
    """After DNS rebinding, the page and the server have the same name, which is not a name of this server."""
    headers = {b"host": b"evil.example:8001", b"origin": b"http://evil.example:8001"}
    with pytest.raises(OriginError, match=r"expected an IP address or one of 127\.0\.0\.1, localhost"):
        Access().check(headers)
    Access(host="evil.example").check(headers)  # the server listens on this name
    Access(Token("secret")).check(headers | {b"authorization": b"Bearer secret"})  # the page knows the token


def test_access_takes_the_token_from_header_or_subprotocol():
    access = Access(Token("s3cret?>~"))
    headers = {b"host": b"127.0.0.1:1"}
    access.check(headers | {b"authorization": b"Bearer s3cret?>~"})
    access.check(headers, ["isocharge.live.1", bearer("s3cret?>~")])
    for offered in ([], ["isocharge.live.1"], [bearer("other")], ["bearer.***"], ["bearer."], ["bearer.\u00e9"]):
        with pytest.raises(TokenError):
            access.check(headers, offered)
