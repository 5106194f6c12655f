"""The declaration of the record, and the forms that are derived from it."""

import json
import re

import jsonschema_rs
import numpy as np
import pytest
from msgspec import structs

from isocharge.serve.record.formats import record_schema
from isocharge.serve.record.record import (
    RECORD_FIELDS,
    FollowedFilm,
    OtherContact,
    TrackedContact,
)

TRACKED = TrackedContact(1.0, 2.0, 0.5, 0.01, 0.02, 0.001, 3.0, 0.0, 0.25)


def test_json_has_the_fields_of_tracking_and_film_after_the_others(contract, record):
    film = FollowedFilm(0.71234567, 0.05, 12)
    other = OtherContact(5.0, -1.0, 1.0, 0.25)
    tracked_record = record(sections=("track", "follow"), tracked=TRACKED, event="slide", other=other, film=film)
    written = json.loads(tracked_record.to_json())
    assert [*written] == [*contract, "tracked", "event", "other", "film"]
    assert (written["tracked"], written["event"]) == (structs.asdict(TRACKED), "slide")
    assert written["other"] == structs.asdict(other)
    assert written["film"] == {"pretension_MPa": 0.712346, "pretension_std_MPa": 0.05, "touches": 12}


def test_numpy_numbers_are_written_as_numbers(record):
    assert record(timestamp=np.float64(1.25)).to_json().startswith('{"timestamp": 1.25, ')


def test_record_that_is_not_a_number_has_no_json(record):
    with pytest.raises(ValueError, match="not JSON compliant"):
        record(misfit=float("nan")).to_json()


def test_schema_refuses_missing_and_wrong_values_and_accepts_null_only_where_a_value_may_be_unknown(record, contract):
    validator = jsonschema_rs.Draft7Validator(record_schema(("A", "B")))
    values = json.loads(record().to_json())
    for field in RECORD_FIELDS:
        if field.name in contract:
            assert validator.is_valid(values | {field.name: None}) == field.may_be_null, field.name
            assert not validator.is_valid(values | {field.name: [1.0]}), field.name
            assert not validator.is_valid({name: values[name] for name in contract if name != field.name}), field.name


def test_table_of_the_documentation_has_every_field_with_its_meaning(pytestconfig):
    page = (pytestconfig.rootpath / "serve/docs/record.md").read_text("utf-8")
    table = page.partition("## All fields")[2].partition("\n## ")[0]
    rows = dict(re.findall(r"^\| `([\w.]+)` \| .*? \| .*? \| (.*) \|$", table, re.MULTILINE))
    for field in RECORD_FIELDS:
        named_fields = {field.name: field} | {f"{field.name}.{part.name}": part for part in field.parts}
        for name, each in named_fields.items():
            assert rows[name].startswith(each.meaning), name
