"""The link between the processes: the reader never waits, and what arrives is whole."""

import time

from isocharge.serve.viewer.link import make_link
from isocharge.serve.viewer.messages import Marker, Tare

SAMPLE = bytes(range(64))


def test_samples_arrive_whole_and_in_order():
    reader, page = make_link()
    for number in range(100):
        reader.put(bytes([number]) * 64)
    data = page.take(64)
    assert data == b"".join(bytes([number]) * 64 for number in range(100))
    assert page.take(64) == b""
    assert page.is_open
    reader.close()
    page.close_here()


def test_a_reader_does_not_wait_for_a_page_that_takes_nothing():
    reader, page = make_link()
    began = time.perf_counter()
    for _ in range(40_000):
        reader.put(SAMPLE)
    told = sum(reader.tell(counters={"frames": 1}, note="x" * 500) for _ in range(2000))
    assert time.perf_counter() - began < 5.0
    assert reader.dropped > 0
    assert told < 2000
    taken = len(b"".join(iter(lambda: page.take(64), b""))) // 64
    assert taken + reader.dropped == 40_000
    assert len(page.replies()) == told
    reader.close()
    page.close_here()


def test_requests_and_the_end():
    reader, page = make_link()
    assert page.ask(Marker("here"))
    assert reader.request() == Marker("here")
    page.close_here()
    assert reader.request() is None
    reader.put(SAMPLE)
    assert not reader.is_open
    assert not reader.tell(note="nobody")
    reader.close()


def test_the_page_sees_the_reader_end():
    reader, page = make_link()
    reader.put(SAMPLE)
    reader.close()
    assert page.take(64) == SAMPLE
    assert page.take(64) == b""
    assert not page.is_open
    assert not page.ask(Tare())
    page.close_here()
