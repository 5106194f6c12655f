"""A record is one line of JSON that any parser takes, with the fields of the contract in their order."""

import json

import pytest


def strictly(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_record_has_the_fields_in_their_order(contract, record):
    assert list(strictly(record().to_json())) == contract


def test_record_is_one_line_of_plain_values(record):
    text = record().to_json()
    assert "\n" not in text
    got = strictly(text)
    assert got["x_mm"] == 1.234568
    assert got["y_mm"] is None
    assert got["charge_pC"] == {"A": 800.0625, "B": None}
    assert got["flags"] == ["gap"]
    assert got["timestamp"] == 1763600000.123457


def test_record_never_holds_nan(record):
    with pytest.raises(ValueError, match="not JSON compliant"):
        record(misfit=float("nan")).to_json()
