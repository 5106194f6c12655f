"""Boards that are asked: when, and what comes back."""

import os
import threading
import tty
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve import Port
from isocharge.serve.port.request import QUIET_S, UNANSWERED_S, Asker, Request

pytestmark = pytest.mark.xdist_group("clock")


class Clock:
    """A clock that is set by hand."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


def asker_at(clock, **settings):
    return Asker(Request(b"?\n", **settings), clock)


def test_the_next_request_waits_for_the_answer_and_for_the_rate():
    clock = Clock()
    asker = asker_at(clock, rate_Hz=100.0)
    assert asker.wait_s() == 0.0
    assert asker.asked() == b"?\n"
    assert asker.wait_s() == pytest.approx(UNANSWERED_S)
    clock.now_s += 0.003
    assert asker.heard(b"1,2\n") == b"1,2\n"
    assert asker.wait_s() == pytest.approx(0.007)
    clock.now_s += 0.0069
    asker.heard(b"3\n")
    assert asker.wait_s() == pytest.approx(QUIET_S)


def test_a_request_without_an_answer_is_repeated():
    clock = Clock()
    asker = asker_at(clock)
    asker.asked()
    clock.now_s += 0.5 * UNANSWERED_S
    assert asker.wait_s() == pytest.approx(0.5 * UNANSWERED_S)
    clock.now_s += 0.5 * UNANSWERED_S
    assert asker.wait_s() == pytest.approx(0.0)
    asker.asked()
    asker.forget()
    assert asker.wait_s() == 0.0


@settings(derandomize=True)
@given(st.binary(min_size=1, max_size=8), st.binary(max_size=20), st.lists(st.integers(0, 28), max_size=5))
def test_the_echo_is_taken_out_however_it_is_cut(request_bytes, answer, cuts):
    asker = Asker(Request(request_bytes, echo=True))
    asker.asked()
    stream = request_bytes + answer
    at = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    assert b"".join(asker.heard(stream[a:b]) for a, b in pairwise(at)) == answer
    assert asker.echo_share == 1.0


def test_an_answer_that_is_no_echo_stays():
    asker = Asker(Request(b"\x01\x04\x00", echo=True))
    asker.asked()
    assert asker.heard(b"\x02\x04\x00\x10") == b"\x02\x04\x00\x10"
    assert asker.echo_share == 0.0


def test_an_echo_is_counted_and_stays_where_it_is_not_expected():
    asker = Asker(Request(b"?", echo=False))
    asker.asked()
    assert asker.heard(b"?1\n") == b"?1\n"
    assert asker.echo_share == 1.0


@pytest.mark.xdist_group("clock")
def test_a_port_asks():
    """A pseudo-terminal that answers each request with a line of its own, echo first."""
    board, reader = os.openpty()
    tty.setraw(reader)

    def answer():
        for number in range(10):
            assert os.read(board, 100) == b"?"
            os.write(board, b"?%d\n" % number)

    answering = threading.Thread(target=answer)
    answering.start()
    with Port(os.ttyname(reader), request=Request(b"?", 200.0, echo=True), silence_s=5.0) as port:
        got, chunks = b"", iter(port)
        while got.count(b"\n") < 10:
            got += next(chunks).data
        assert port.echo_share == 1.0
    answering.join()
    os.close(board)
    os.close(reader)
    assert got.split(b"\n")[:10] == [b"%d" % k for k in range(10)]
