"""The clockwork: turns, rows, threads. Never how fast something is."""

import time
from collections import Counter

import numpy as np
import torch

from isocharge.train.report.timing import latencies, machine, one_thread, throughputs


def waiting(milliseconds, counter=None, name=""):
    def call():
        if counter is not None:
            counter[name] += 1
        end = time.perf_counter() + 1e-3 * milliseconds
        while time.perf_counter() < end:
            pass

    return call


def test_durations_are_those_of_the_calls():
    told = []
    taken = latencies(
        {"slow": [waiting(2.0)], "fast": [waiting(0.1), waiting(0.1)]}, 3, 4.0, lambda *done: told.append(done)
    )
    assert taken["slow"].shape == (3, 3)
    assert taken["fast"].shape[0] == 3
    assert taken["fast"].shape[1] > 3
    assert taken["slow"].min() >= 2000.0
    assert 100.0 <= taken["fast"].min() < 2000.0
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_every_press_has_its_turn():
    counter = Counter()
    calls = [waiting(0.05, counter, number) for number in range(4)]
    latencies({"method": calls}, 2, 2.0, lambda *_: None)
    assert set(counter) == {0, 1, 2, 3}
    assert max(counter.values()) <= 3 * min(counter.values()) + 10


def test_batches_and_slow_methods():
    seen = []

    def quick(batch):
        seen.append(len(batch))

    def slow(batch):
        time.sleep(2e-3 * len(batch))

    rates = throughputs({"quick": quick, "slow": slow}, np.zeros((640, 3)), 2, 0.2, lambda *_: None)
    assert seen[-1] == 640
    assert 200.0 < rates["slow"] < 500.0


def test_threads_are_given_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_the_machine_is_named():
    record = machine()
    assert {"cpu", "cores", "python", "numpy", "scikit-learn", "onnxruntime", "torch"} <= record.keys()
    assert all(record.values())
