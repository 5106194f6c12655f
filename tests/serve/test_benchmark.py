"""Timing: percentiles and rates against numpy and a known clock."""

import json
import re

import numpy as np
import pytest

from isocharge.serve import Predictor, find_model, load_model
from isocharge.serve.benchmark import (
    Contender,
    in_process_contenders,
    press_charges,
    take_turns,
)


class Clock:
    """A clock that only calls move."""

    def __init__(self):
        self.now = 0

    def __call__(self):
        return self.now

    def takes(self, *durations_us):
        """A call that takes the next of these durations each time."""
        waiting = iter(1000 * duration for duration in durations_us)
        last = [0]

        def call():
            last[0] = next(waiting, last[0])
            self.now += last[0]

        return call


def test_durations_are_those_of_the_clock():
    """The first round, ten times as slow, does not count."""
    clock = Clock()
    contenders = [
        Contender("steady", 1, clock.takes(*[70], 7)),
        Contender("batch", 100, clock.takes(*[500], 50)),
    ]
    steady, batch = take_turns(contenders, 1e-6, clock=clock)
    assert (steady.name, steady.p50_us, steady.p99_us, steady.calls) == ("steady", 7.0, 7.0, 9)
    assert steady.presses_per_s == pytest.approx(1e6 / 7.0)
    assert batch.presses_per_s == pytest.approx(100 * 1e6 / 50.0)
    (timed,) = take_turns([Contender("steady", 1, clock.takes(7))], 0.07, clock=clock)
    assert timed.calls == 9 * 1000  # nine of ten rounds, 7 ms each


def test_contenders_compute_the_contacts_of_the_model():
    folder = find_model("three-25um-biaxial")
    model, predictor = load_model(folder), Predictor(folder)
    charges = press_charges(predictor, model.golden.charge_pC)
    assert (charges.shape, charges.dtype) == ((4096, 3), np.float32)
    presses = [row for row in model.golden.charge_pC.tolist() if not predictor.flags(predictor.predict(row))]
    assert set(map(tuple, charges.tolist())) == set(map(tuple, presses))
    contenders = in_process_contenders(predictor, charges)
    assert [contender.presses for contender in contenders] == [1, 1, 16, 256, 4096]
    one, batch = contenders[1].call(), contenders[2].call()
    assert tuple(one) == tuple(predictor.predict(charges[0]))
    assert len(batch.x_mm) == 16


def test_the_command_prints_a_table_and_json(command):
    code, out, err = command("serve", "bench", "--seconds", "0.2")
    assert (code, err) == (0, "")
    errors = load_model(find_model("three-25um-biaxial")).metadata.errors
    assert float(re.search(r"position_median_mm (\S+)", out)[1]) == pytest.approx(
        errors["position_median_mm"], rel=1e-3
    )
    code, out, _ = command("serve", "bench", "four-25um-biaxial", "--seconds", "0.2", "--json")
    report = json.loads(out)
    assert report["model"] == "four-25um-biaxial/1"
    assert all(0 < timing["p50_us"] <= timing["p99_us"] for timing in report["timings"])
