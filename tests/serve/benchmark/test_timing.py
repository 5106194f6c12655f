"""Timing: percentiles and rates against numpy and a known clock; load over HTTP against the server's counts."""

import json
import sys
import time

import numpy as np
import pytest

from isocharge.common.errors import IsochargeError
from isocharge.serve import Predictor, find_model, load_model
from isocharge.serve.benchmark import (
    Contender,
    HttpLoad,
    Timing,
    in_process_contenders,
    machine,
    press_charges,
    take_turns,
)
from isocharge.serve.benchmark.timing import LEAST_CALLS, ROUNDS
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Handler


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
        Contender("steady", 1, clock.takes(*[70] * LEAST_CALLS, 7)),
        Contender("batch", 100, clock.takes(*[500] * LEAST_CALLS, 50)),
    ]
    steady, batch = take_turns(contenders, 1e-6, clock=clock)
    assert (steady.name, steady.p50_us, steady.p99_us) == ("steady", 7.0, 7.0)
    assert steady.calls == (ROUNDS - 1) * LEAST_CALLS
    assert steady.presses_per_s == pytest.approx(1e6 / 7.0)
    assert batch.presses_per_s == pytest.approx(100 * 1e6 / 50.0)


def test_a_turn_lasts_as_long_as_it_should():
    clock = Clock()
    (timing,) = take_turns([Contender("one", 1, clock.takes(10))], 1e-2, clock=clock)
    assert timing.calls == pytest.approx((ROUNDS - 1) * 100, abs=ROUNDS)
    assert clock.now == pytest.approx(1e7, rel=0.02)


def test_percentiles_are_numpy_s():
    durations = np.random.default_rng(0).exponential(1e5, 5000)
    timing = Timing.of("x", 3, durations, in_parallel=4)
    assert timing.p50_us == pytest.approx(np.quantile(durations, 0.5) / 1e3)
    assert timing.p99_us == pytest.approx(np.quantile(durations, 0.99) / 1e3)
    assert timing.presses_per_s == pytest.approx(12 / durations.mean() * 1e9)


def test_progress_is_told():
    told = []
    take_turns([Contender("one", 1, lambda: None)], 1e-4, progress=lambda *of: told.append(of))
    assert told == [(number + 1, ROUNDS) for number in range(ROUNDS)]


def test_ways_predict_what_the_model_does():
    folder = find_model("three-25um-biaxial")
    model, predictor = load_model(folder), Predictor(folder)
    charges = press_charges(model.golden.charge_pC, seed=3)
    assert (charges.shape, charges.dtype) == ((4096, 3), np.float32)
    assert np.array_equal(charges, press_charges(model.golden.charge_pC, seed=3))
    assert set(map(tuple, charges.tolist())) == set(map(tuple, model.golden.charge_pC.tolist()))
    contenders = in_process_contenders(predictor, charges[:300])
    assert [contender.presses for contender in contenders] == [1, 1, 16, 256]
    one, batch = contenders[1].call(), contenders[2].call()
    assert tuple(one) == tuple(predictor.predict(charges[0]))
    assert len(batch.x_mm) == 16


def test_load_over_http_is_what_the_server_counts(store, film, start_http):
    """As many requests as the server counts, no faster than time passes."""
    handler = Handler(store)
    place = start_http(handler).url.removeprefix("http://").split(":")
    counters = store.get("linear").statistics
    with HttpLoad(place[0], int(place[1]), "linear") as load:
        contender = load.contender(film.golden_pC()[:5])
        assert (contender.name, contender.presses) == ("HTTP, JSON, 5", 5)
        contender.call()
        assert (counters.answered, counters.presses) == (1, 5)
        began = time.perf_counter()
        timing = load.many(film.golden_pC()[:1], 7, 0.3)
        elapsed = time.perf_counter() - began
    answered = counters.answered - 1
    assert 0.5 * answered < timing.calls <= answered
    assert timing.presses_per_s < 2.0 * answered / elapsed
    assert timing.p50_us < timing.p99_us < 1e6 * elapsed


def test_a_refusal_is_an_error(store, start_http):
    handler = Handler(store, ServerLimits(batch=1))
    place = start_http(handler).url.removeprefix("http://").split(":")
    with (
        HttpLoad(place[0], int(place[1]), "linear") as load,
        pytest.raises(IsochargeError, match=r"expected an answer 200, got b'HTTP/1\.1 413"),
    ):
        load.contender(np.ones((2, 3), np.float32)).call()


def test_the_machine_names_its_versions():
    assert machine()["numpy"] == np.__version__
    assert set(machine()) == {"cpu", "cores", "system", "python", "numpy", "onnxruntime"}


def test_the_command_prints_a_table_and_json(command):
    code, out, err = command("serve", "bench", "--seconds", "0.2")
    assert (code, err) == (0, "")
    assert "HTTP, JSON, 16 connections" in out
    errors = load_model(find_model("three-25um-biaxial")).metadata.errors
    line = next(line for line in out.splitlines() if line.startswith("position, mm"))
    assert [float(word) for word in line.split()[2:4]] == pytest.approx(
        [errors["position_median_mm"], errors["position_rms_mm"]], rel=5e-3
    )
    code, out, _ = command("serve", "bench", "four-25um-biaxial", "--seconds", "0.2", "--seed", "5", "--json")
    report = json.loads(out)
    assert (report["model"], report["seed"], report["without_http"]) == ("four-25um-biaxial/1", 5, None)
    assert [timing["presses"] for timing in report["timings"]] == [1, 1, 16, 256, 4096, 1, 256, 1]
    assert all(0 < timing["p50_us"] <= timing["p99_us"] for timing in report["timings"])


def test_without_the_extra_http_is_left_out(command, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("isocharge.serve.network.http")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    code, out, err = command("serve", "bench", "--seconds", "0.1")
    assert code == 0
    assert err.startswith("HTTP was left out: this needs the package 'uvicorn', which is not installed; pip install")
    assert "HTTP" not in out
    assert "predict_into" in out


def test_a_folder_that_cannot_be_served_is_measured_in_process(command, film, tmp_path):
    """The folder of a calibrated model has another name than the model."""
    folder = film.write(tmp_path)
    folder.parent.rename(tmp_path / "mine")
    code, out, err = command("serve", "bench", tmp_path / "mine", "--seconds", "0.1")
    assert code == 0
    assert err.startswith("HTTP was left out: the server did not start: ")
    assert "predict_into" in out
    assert "position, mm" in out


def test_a_model_that_is_not_there(command):
    code, out, err = command("serve", "bench", "nowhere", "--seconds", "0.1")
    assert (code, out) == (2, "")
    assert err.startswith("ModelError: ")


def test_a_secret_of_the_environment_is_not_for_its_server(command, monkeypatch):
    monkeypatch.setenv("ISOCHARGE_TOKEN", "0123456789abcdef0123456789abcdef")
    code, out, err = command("serve", "bench", "--seconds", "0.1")
    assert code == 0, err
    assert "HTTP, JSON, 16 connections" in out


def test_the_server_is_asked_for_the_version_that_is_measured(command, film, make_film, tmp_path):
    version = film.write(tmp_path)
    (version.parent / "config.pbtxt").unlink()
    make_film(4).write(tmp_path, version=2)  # would refuse three charges
    code, out, err = command("serve", "bench", version, "--seconds", "0.1")
    assert (code, err) == (0, "")
    assert "linear/1" in out


def test_a_time_without_end_is_refused(command):
    code, out, err = command("serve", "bench", "--seconds", "inf")
    assert (code, out) == (2, "")
    assert "--seconds" in err
