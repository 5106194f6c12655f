"""The computed sentences, on made-up methods."""

from isocharge.train.report.measures import Errors, MethodRecord
from isocharge.train.report.verdict import verdict


def method(name, kind, error, p50, per_second=1e5, given=False, answered=1.0):
    errors = Errors(error, error, error, 1.0, 1.0, answered)
    times = {"p50_us": p50, "p95_us": p50, "p50_of_rounds_us": (p50, p50), "per_second": per_second}
    return MethodRecord(name, "NumPy", kind, "", given, errors, None, None, **times, memory_bytes=1, fit_seconds=0.0)


RELEASED = method("released", "network", 0.2, 10.0)


def test_nothing_beats_it():
    said = verdict([RELEASED, method("near", "learnt", 0.21, 5.0), method("far", "learnt", 0.3, 2.0)])
    assert said["both"] == {"latency": [], "throughput": []}
    assert "none of 2 other methods is both faster and more accurate" in said["sentences"][0]
    assert "near (NumPy) (2 times as fast, 5 % more error)" in said["sentences"][0]
    assert "none of 2 other methods is faster" in said["sentences"][1]


def test_what_beats_it_is_named():
    said = verdict([RELEASED, method("better", "paper", 0.19, 4.0, 2e5), method("worse", "paper", 0.3, 4.0)])
    assert said["both"] == {"latency": ["better (NumPy)"], "throughput": ["better (NumPy)"]}
    assert "both faster and more accurate than the released model: 1 of 2 other methods" in said["sentences"][0]
    assert "better (NumPy) (2.5 times as fast, 5 % less error)" in said["sentences"][0]


def test_networks_are_told_apart():
    said = verdict([RELEASED, method("poly", "learnt", 0.3, 20.0), method("small", "network", 0.19, 5.0)])
    assert said["both"]["latency"] == ["small (NumPy)"]
    assert "none of 1 other methods is faster" in said["sentences"][0]
    assert "networks that give the contact alone" in said["sentences"][2]
    assert "small" in said["sentences"][2]


def test_who_is_told_the_force_or_does_not_answer_does_not_compete():
    others = [method("told", "paper", 0.1, 1.0, given=True), method("silent", "paper", 0.1, 1.0, answered=0.9)]
    said = verdict([RELEASED, *others])
    assert said["both"]["latency"] == []
    assert said["sentences"] == []
