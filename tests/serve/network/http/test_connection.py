"""HTTP connections without a network: the responses do not depend on how the requests are split into pieces."""

import asyncio

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.http.connection import Connection
from isocharge.serve.network.protocol.response import response_of

INNER = b"POST /one HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc"

TRAILED = b"POST /one HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n"


class Echo:
    """Handler that responds with the method, path, headers and body of the request."""

    limits = ServerLimits()

    def may_block(self, _path):
        return False

    def answer(self, method, path, headers, body, _client=None):
        return response_of(200, b"text/plain", repr((method, path, sorted(headers), body)).encode())

    def refused(self, _response, _client=None):
        pass


class Wire(asyncio.Transport):
    """Transport that stores the sent bytes."""

    def __init__(self):
        super().__init__()
        self.sent, self.closed = bytearray(), False

    def write(self, data):
        self.sent += data

    def write_eof(self):
        self.closed = True

    close = abort = write_eof

    def can_write_eof(self):
        return True

    def is_closing(self):
        return self.closed

    def pause_reading(self):
        pass

    resume_reading = pause_reading


def request(method, path, header, body, *, chunked):
    if chunked:
        framing = b"Transfer-Encoding: chunked\r\n"
        body = (b"%x\r\n%s\r\n" % (len(body), body) if body else b"") + b"0\r\n\r\n"
    else:
        framing = b"Content-Length: %d\r\n" % len(body)
    return b"%s %s HTTP/1.1\r\nHost: localhost\r\n%s%s\r\n%s" % (method, path, header, framing, body)


REQUESTS = st.builds(
    request,
    st.sampled_from([b"POST", b"HEAD"]),
    st.sampled_from([b"/one", b"/two", b"/%6fne"]),
    st.sampled_from([b"", b"Connection: close\r\n", b"Expect: 100-continue\r\n"]),
    st.sampled_from([b"", b"abc", b"xyz", b"\r\n\r\n", INNER, b"\r\n\r\n" + INNER]),
    chunked=st.booleans(),
)
"""Few, so that they repeat; some bodies hold a request themselves."""


@pytest.fixture(scope="module")
def connect():
    """A function that gives a fresh connection and its wire."""
    with asyncio.Runner() as runner:

        def start():
            connection = Connection(Echo(), set(), runner.get_loop())
            wire = Wire()
            connection.connection_made(wire)
            return connection, wire

        yield start


def answers(connect, pieces):
    protocol, wire = connect()
    for piece in pieces:
        protocol.data_received(piece)
    return bytes(wire.sent).replace(b"HTTP/1.1 100 Continue\r\n\r\n", b""), wire.closed


def byte_by_byte(data):
    return [data[at : at + 1] for at in range(len(data))]


@given(requests=st.lists(REQUESTS, min_size=1, max_size=6), prefix=st.sampled_from([b"", b"\r\n"]))
@settings(max_examples=60, deadline=None)
def test_a_request_in_one_piece_is_answered_as_byte_by_byte(connect, requests, prefix):
    """A known head is not parsed again, a byte is no head: both give the same answers."""
    requests = [prefix + each for each in requests for _ in range(2)]
    assert answers(connect, requests) == answers(connect, byte_by_byte(b"".join(requests)))


@given(requests=st.lists(REQUESTS, min_size=1, max_size=6), cuts=st.lists(st.integers(1, 120), max_size=30))
@settings(max_examples=60, deadline=None)
def test_requests_split_at_any_byte_are_answered(connect, requests, cuts):
    data = b"".join(each for each in requests for _ in range(2))
    pieces, rest = [], data
    for size in cuts:
        pieces.append(rest[:size])
        rest = rest[size:]
    assert answers(connect, [*filter(None, [*pieces, rest])]) == answers(connect, byte_by_byte(data))


def test_body_that_looks_like_an_earlier_request_is_not_answered_as_a_request(connect):
    """The second part of the request equals a complete request that was answered before."""
    outer = request(b"POST", b"/two", b"", b"first\r\n\r\n" + INNER, chunked=False)
    at = outer.index(INNER)
    sent, _ = answers(connect, [INNER, outer[:at], outer[at:], INNER])
    assert sent.count(b"HTTP/1.1 200 OK") == 3
    assert sent.count(b"'/two'") == 1


def test_end_of_an_earlier_request_alone_is_refused(connect):
    """The bytes that completed a request are not a request themselves."""
    sent, closed = answers(connect, [INNER[:1], INNER[1:], INNER[1:]])
    assert (sent.count(b"HTTP/1.1 200"), sent.count(b"HTTP/1.1 400"), closed) == (1, 1, True)


@pytest.mark.parametrize("blank", [b"\r\n\r\n", b"\n\r\n\r\n"])
def test_blank_lines_before_a_request_are_ignored(connect, blank):
    sent, _ = answers(connect, [blank, blank, INNER, blank, blank])
    assert sent.count(b"HTTP/1.1 200") == 1


def test_trailers_are_not_headers(connect):
    """Of a request that is answered, and of the next one."""
    sent, _ = answers(connect, [TRAILED + b"0\r\nHost: y\r\nA: b\r\n\r\n", INNER])
    assert [sent.count(part) for part in (b"HTTP/1.1 200", b"b'y'", b"b'a'")] == [2, 0, 0]


@pytest.mark.parametrize(
    "endless",
    [TRAILED + b"0\r\n" + b"a: b\r\n" * 9000, TRAILED + b"0\r\na: " + b"b" * 50_000, TRAILED + b"1;" + b"x" * 50_000],
    ids=["trailers", "one trailer", "chunk extension"],
)
@pytest.mark.parametrize("piece", [1, 100, 4096])
def test_trailers_and_chunk_extensions_have_the_limit_of_headers(connect, endless, piece):
    sent, closed = answers(connect, [endless[at : at + piece] for at in range(0, len(endless), piece)])
    assert (sent[:12], closed) == (b"HTTP/1.1 431", True)


def test_many_small_chunks_are_one_body(connect):
    data = TRAILED[: TRAILED.index(b"3\r\n")] + b"1\r\nx\r\n" * 20_000 + b"0\r\n\r\n"
    sent, _ = answers(connect, [data[at : at + 4096] for at in range(0, len(data), 4096)])
    assert b"x" * 20_000 in sent
