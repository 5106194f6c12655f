"""Work in a second thread: its progress, and its end when the first thread fails."""

import threading
import time
from concurrent.futures import CancelledError

import pytest

from isocharge.common.progress import listening, report, second_thread


@pytest.mark.parametrize(("shown_title", "title"), [(None, "sums"), ("the other sums", "the other sums")])
def test_the_progress_of_a_second_thread_reaches_the_listener(shown_title, title):
    calls = []
    with listening(lambda *call: calls.append(call)), second_thread(shown_title) as executor:
        future = executor.submit(report, "sums", 1, 2, "half")
        assert future.result() is None
        report("sums", 2, 2)
    assert calls == [(title, 1, 2, "half"), ("sums", 2, 2, "")]


def test_a_second_thread_stops_at_its_next_report_if_the_first_thread_is_interrupted():
    is_running = threading.Event()

    def work_for_a_minute():
        is_running.set()
        for done in range(6000):
            report("work", done, 6000)
            time.sleep(0.01)

    futures = []

    def interrupted_block():
        with second_thread() as executor:
            futures.append(executor.submit(work_for_a_minute))
            assert is_running.wait(10.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_block()
    (future,) = futures
    assert isinstance(future.exception(), CancelledError)
