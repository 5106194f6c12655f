"""HTTP connections without a network: the responses do not depend on how the requests are split into pieces."""

import asyncio

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.http.connection import Connection
from isocharge.serve.network.protocol.response import response_of

INNER = b"POST /one HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc"
"""A complete request, which is also used as the body of another request."""

TRAILED = b"POST /one HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n"
"""Beginning of a request in chunks, after which further chunks or trailers may follow."""


class Echo:
    """Handler that responds with the method, path, headers and body of the request."""

    limits = ServerLimits()

    def may_block(self, _path):
        return False

    def answer(self, method, path, headers, body, _client=None):
        return response_of(200, b"text/plain", repr((method, path, sorted(headers), body)).encode())

    def count_refusal(self, _response, _client=None):
        pass


class Wire(asyncio.Transport):
    """Transport that stores the sent bytes."""

    def __init__(self):
        super().__init__()
        self.sent = bytearray()
        self.closed = False

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
    """Return the bytes of a request, whose body is sent as one chunk if `chunked` is true."""
    if chunked:
        framing = b"Transfer-Encoding: chunked\r\n"
        chunk = b"%x\r\n%s\r\n" % (len(body), body) if body else b""
        body = chunk + b"0\r\n\r\n"
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
"""Requests with few different parts, so that heads are repeated. Some bodies contain a request."""


@pytest.fixture(scope="module")
def connect():
    """Return a function that creates a connection and its wire."""
    with asyncio.Runner() as runner:

        def start():
            connection = Connection(Echo(), set(), runner.get_loop())
            wire = Wire()
            connection.connection_made(wire)
            return connection, wire

        yield start


def answers(connect, pieces):
    """Return the sent bytes without `100 Continue`, and whether the connection was closed."""
    connection, wire = connect()
    for piece in pieces:
        connection.data_received(piece)
    return bytes(wire.sent).replace(b"HTTP/1.1 100 Continue\r\n\r\n", b""), wire.closed


def byte_by_byte(data):
    return split(data, 1)


def split(data, size):
    """Return pieces of a number of bytes."""
    return [data[start : start + size] for start in range(0, len(data), size)]


@given(requests=st.lists(REQUESTS, min_size=1, max_size=6), prefix=st.sampled_from([b"", b"\r\n"]))
@settings(max_examples=60, deadline=None)
def test_repeated_requests_in_one_piece_have_the_same_answers_as_single_bytes(connect, requests, prefix):
    """The head of a repeated request in one piece is not parsed again. Single bytes are always parsed."""
    repeated = [prefix + each for each in requests for _ in range(2)]
    assert answers(connect, repeated) == answers(connect, byte_by_byte(b"".join(repeated)))


@given(requests=st.lists(REQUESTS, min_size=1, max_size=6), cuts=st.lists(st.integers(1, 120), max_size=30))
@settings(max_examples=60, deadline=None)
def test_requests_split_at_any_byte_are_answered(connect, requests, cuts):
    data = b"".join(each for each in requests for _ in range(2))
    pieces = []
    rest = data
    for size in cuts:
        pieces.append(rest[:size])
        rest = rest[size:]
    pieces.append(rest)
    nonempty_pieces = [piece for piece in pieces if piece]
    assert answers(connect, nonempty_pieces) == answers(connect, byte_by_byte(data))


def test_body_that_looks_like_an_earlier_request_is_not_answered_as_a_request(connect):
    """The second part of the request equals a complete request that was answered before."""
    outer = request(b"POST", b"/two", b"", b"first\r\n\r\n" + INNER, chunked=False)
    inner_start = outer.index(INNER)
    sent, _ = answers(connect, [INNER, outer[:inner_start], outer[inner_start:], INNER])
    assert sent.count(b"HTTP/1.1 200 OK") == 3
    assert sent.count(b"'/two'") == 1


def test_end_of_an_earlier_request_alone_is_refused(connect):
    """The bytes that completed a request are not a request themselves."""
    sent, closed = answers(connect, [INNER[:1], INNER[1:], INNER[1:]])
    assert sent.count(b"HTTP/1.1 200") == 1
    assert sent.count(b"HTTP/1.1 400") == 1
    assert closed


@pytest.mark.parametrize("blank", [b"\r\n\r\n", b"\n\r\n\r\n"])
def test_blank_lines_before_a_request_are_ignored(connect, blank):
    sent, _ = answers(connect, [blank, blank, INNER, blank, blank])
    assert sent.count(b"HTTP/1.1 200") == 1


def test_trailers_are_not_headers(connect):
    """The trailers of a request appear neither in its headers nor in the headers of the next request."""
    sent, _ = answers(connect, [TRAILED + b"0\r\nHost: y\r\nA: b\r\n\r\n", INNER])
    assert sent.count(b"HTTP/1.1 200") == 2
    assert b"b'y'" not in sent
    assert b"b'a'" not in sent


@pytest.mark.parametrize(
    "endless",
    [TRAILED + b"0\r\n" + b"a: b\r\n" * 9000, TRAILED + b"0\r\na: " + b"b" * 50_000, TRAILED + b"1;" + b"x" * 50_000],
    ids=["trailers", "one trailer", "chunk extension"],
)
@pytest.mark.parametrize("size", [1, 100, 4096])
def test_trailers_and_chunk_extensions_have_the_limit_of_headers(connect, endless, size):
    sent, closed = answers(connect, split(endless, size))
    assert sent.startswith(b"HTTP/1.1 431")
    assert closed


def test_many_small_chunks_are_one_body(connect):
    head = TRAILED[: TRAILED.index(b"3\r\n")]
    data = head + b"1\r\nx\r\n" * 20_000 + b"0\r\n\r\n"
    sent, _ = answers(connect, split(data, 4096))
    assert b"x" * 20_000 in sent
