"""A record is one line of JSON that any parser takes, with the fields of the contract in their order."""

import json

import pytest

from isocharge.serve import PredictionRecord

CONTRACT = [
    *("timestamp", "t_device_us", "seq", "x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N", "misfit"),
    *("contact", "charge_pC", "charge_raw_pC", "tare_pC", "flags", "latency_us", "model", "frame_id"),
]


def record(**changes):
    values = dict.fromkeys(CONTRACT) | {
        "contact": True,
        "flags": ("gap",),
        "model": "linear/1",
        "frame_id": "linear-film",
        "x_mm": 1.23456789,
        "charge_pC": {"A": 800.0625, "B": None},
        "timestamp": 1763600000.1234567,
    }
    return PredictionRecord(**(values | changes))


def strictly(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_record_has_the_fields_in_their_order():
    assert list(strictly(record().to_json())) == CONTRACT


def test_record_is_one_line_of_plain_values():
    text = record().to_json()
    assert "\n" not in text
    got = strictly(text)
    assert got["x_mm"] == 1.234568
    assert got["y_mm"] is None
    assert got["charge_pC"] == {"A": 800.0625, "B": None}
    assert got["flags"] == ["gap"]
    assert got["timestamp"] == 1763600000.123457


def test_record_never_holds_nan():
    with pytest.raises(ValueError, match="not JSON compliant"):
        record(misfit=float("nan")).to_json()
