"""Metadata are the same after a round trip through an ONNX file, and wrong ones are refused with the reason."""

import pytest

from isocharge.common.errors import ModelError
from isocharge.serve import ModelMetadata

WHERE = "models/linear/1/model.onnx"


def test_props_round_trip(film):
    metadata = film.metadata()
    assert ModelMetadata.from_props(metadata.to_props(), WHERE) == metadata


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
    with pytest.raises(ModelError, match=f"^{WHERE}: metadata: key '{key}' is missing; export the model again$"):
        ModelMetadata.from_props(props, WHERE)


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("name", '""', "expected letters, digits, '-', '_' and '.', got ''"),
        ("version", "0", "expected a whole number from 1, got 0"),
        ("version", "true", "got True"),
        ("sensor", "{}", "key 'sensor.name' is missing"),
        ("sensor", '{"name": 3}', "sensor.name: expected a text, got 3"),
        ("electrodes", '["A", "A"]', "expected names that differ, got .'A', 'A'"),
        ("electrodes", "[]", r"expected a list of texts, 1 or more, got \[\]"),
        ("working_area_mm", "[[0, 0], [1, 0]]", "expected a list of lists, 3 or more"),
        ("working_area_mm", "[[0, 0], [1, 0], [1]]", r"expected a list of 2 numbers, got \[1\]"),
        ("force_range_N", "[2.0, 0.05]", r"expected a smaller and a larger number, got \[2.0, 0.05\]"),
        ("force_range_N", "[0.05]", "expected a list of 2 numbers"),
        ("errors", '{"position_mm": NaN}', "errors: expected JSON"),
        ("probes", '"circle:1.0"', "expected a list of texts, 1 or more, got 'circle"),
        ("noise", "{", "noise: expected JSON, got '{' "),
        ("noise", "[" * 100_000, "noise: expected JSON"),
    ],
)
def test_wrong_value_is_shown(film, key, text, said):
    with pytest.raises(ModelError, match=rf"^{WHERE}: metadata: (?=.*{key}).*{said}.*; export the model again$"):
        ModelMetadata.from_props(film.metadata().to_props() | {key: text}, WHERE)


@pytest.mark.parametrize("value", [{"median_mm": float("nan")}, {"median_mm": object()}])
def test_what_is_not_json_is_not_written(film, value):
    with pytest.raises(ModelError, match="'errors': expected a JSON value"):
        film.metadata(errors=value).to_props()
