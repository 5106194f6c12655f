"""The clockwork: turns, rows, threads. Never how fast something is: the clock of these tests is theirs."""

from collections import Counter

import numpy as np
import pytest
import torch

from isocharge.train.report.timing import latencies, one_thread, throughputs


class Clock:
    """A clock that only calls advance, ns."""

    def __init__(self):
        self.now = 0

    def __call__(self):
        return self.now

    def taking(self, microseconds, counter=None, name=""):
        def call(*_):
            self.now += round(1e3 * microseconds)
            if counter is not None:
                counter[name] += 1

        return call


def test_durations_are_those_of_the_calls():
    clock, progress = Clock(), []
    contenders = {"slow": [clock.taking(2000.0)], "fast": [clock.taking(100.0), clock.taking(200.0)]}
    durations = latencies(contenders, 3, 4.0, lambda *done: progress.append(done), clock)
    np.testing.assert_array_equal(durations["slow"], np.full((3, 3), 2000.0))  # three calls at least
    assert durations["fast"].shape == (3, 20)  # 4 ms over the median of five calls, 200 us
    assert set(durations["fast"].ravel()) == {100.0, 200.0}
    assert progress == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_every_press_has_its_turn():
    counter, clock = Counter(), Clock()
    calls = [clock.taking(50.0, counter, number) for number in range(4)]
    latencies({"method": calls}, 2, 2.0, lambda *_: None, clock)
    assert set(counter) == {0, 1, 2, 3}
    assert max(counter.values()) - min(counter.values()) <= 4  # one more for each of four rows of calls


def test_batches_and_slow_methods():
    clock, rows = Clock(), {"quick": [], "slow": []}

    def method(name, per_row_us):
        def predict(batch):
            rows[name].append(len(batch))
            clock.now += round(1e3 * per_row_us * len(batch))

        return predict

    contenders = {"quick": method("quick", 10.0), "slow": method("slow", 2000.0)}
    rates = throughputs(contenders, np.zeros((640, 3)), 2, 0.2, lambda *_: None, clock)
    assert rows == {"quick": [10, 10, 640, 640, 640], "slow": [10, 10, 10, 10, 10]}
    assert rates == {"quick": pytest.approx(1e5), "slow": pytest.approx(500.0)}


def test_threads_are_given_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
