"""Metadata survive the way into an ONNX file and back, and wrong ones are refused with the reason."""

import json

import pytest

from isocharge.errors import ModelError
from isocharge.serve import ModelMetadata

WHERE = "models/linear/1/model.onnx"


def test_props_round_trip(film):
    metadata = film.metadata()
    assert ModelMetadata.from_props(metadata.to_props(), WHERE) == metadata


def test_every_prop_is_json(film):
    props = film.metadata().to_props()
    assert json.loads(props["electrodes"]) == ["A", "B", "C"]
    assert json.loads(props["format_version"]) == 1


def test_foreign_props_are_left_alone(film):
    props = film.metadata().to_props() | {"author": "not JSON"}
    assert ModelMetadata.from_props(props, WHERE) == film.metadata()


def test_label_and_frame(film):
    assert (film.metadata().label, film.metadata().frame_id) == ("linear/1", "linear-film")


def test_other_format_version(film):
    props = film.metadata().to_props() | {"format_version": "2"}
    with pytest.raises(ModelError) as caught:
        ModelMetadata.from_props(props, WHERE)
    assert str(caught.value) == (
        f"{WHERE}: metadata format 2 is not supported (this version reads 1); export it again or upgrade isocharge"
    )


@pytest.mark.parametrize(
    "key", ["format_version", "name", "sensor", "electrodes", "working_area_mm", "errors", "made_with"]
)
def test_missing_key_is_named(film, key):
    props = film.metadata().to_props()
    del props[key]
    with pytest.raises(ModelError, match=f"{WHERE}: the metadata has no '{key}'"):
        ModelMetadata.from_props(props, WHERE)


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("name", '""', "expected a text, got ''"),
        ("version", "0", "expected a whole number from 1, got 0"),
        ("version", "true", "got True"),
        ("sensor", "{}", "expected a text, got None"),
        ("electrodes", '["A", "A"]', "electrode names that differ"),
        ("electrodes", "[]", "a list of texts"),
        ("working_area_mm", "[[0, 0], [1, 0]]", "at least three points"),
        ("working_area_mm", "[[0, 0], [1, 0], [1]]", "two numbers"),
        ("force_range_N", "[2.0, 0.05]", "a smaller and a larger number"),
        ("errors", '{"position_mm": NaN}', "a finite number, got nan"),
        ("probes", '"circle:1.0"', "a list of texts"),
        ("noise", "{", "Expecting property name"),
    ],
)
def test_wrong_value_is_shown(film, key, text, said):
    with pytest.raises(ModelError, match=rf"{WHERE}: metadata '{key}': .*{said}"):
        ModelMetadata.from_props(film.metadata().to_props() | {key: text}, WHERE)


@pytest.mark.parametrize("value", [{"median_mm": float("nan")}, {"median_mm": object()}])
def test_what_is_not_json_is_not_written(film, value):
    with pytest.raises(ModelError, match="'errors': expected a JSON value"):
        film.metadata(errors=value).to_props()
