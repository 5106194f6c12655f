"""Turns and threads. Never how fast something is: the clock of these tests is theirs."""

from collections import Counter

import numpy as np
import torch

from isocharge.train.report.timing import durations, one_thread


class Clock:
    """A clock that only calls advance, ns."""

    def __init__(self):
        self.now, self.calls = 0, Counter()

    def __call__(self):
        return self.now

    def taking(self, microseconds, name=""):
        def call():
            self.now += round(1e3 * microseconds)
            self.calls[name] += 1

        return call


def test_durations_are_those_of_the_calls():
    clock = Clock()
    contenders = {"slow": [clock.taking(2000.0)], "fast": [clock.taking(100.0), clock.taking(200.0)]}
    taken = durations(contenders, 3, 4.0, clock=clock)
    np.testing.assert_array_equal(taken["slow"], np.full((3, 3), 2000.0))  # three calls at least
    assert taken["fast"].shape in ((3, 20), (3, 40))  # 4 ms over the median of three calls
    assert set(taken["fast"].ravel()) == {100.0, 200.0}


def test_every_press_has_its_turn():
    clock = Clock()
    durations({"method": [clock.taking(50.0, number) for number in range(4)]}, 2, 2.0, clock=clock)
    assert set(clock.calls) == {0, 1, 2, 3}
    assert max(clock.calls.values()) - min(clock.calls.values()) <= 4  # one more for each of four rows of calls


def test_threads_are_given_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
