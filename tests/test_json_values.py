"""Conversion of values to JSON. Values without a notation in JSON become null."""

import json

import numpy as np
import pytest

from isocharge.common.json_values import finite_or_none, plain_values


@pytest.mark.parametrize(
    ("value", "expected"),
    [(1.5, 1.5), (0, 0.0), (np.float32(0.5), 0.5), (np.nan, None), (np.inf, None), (-np.inf, None), (None, None)],
)
def test_a_number_that_is_not_finite_is_none(value, expected):
    plain = finite_or_none(value)
    assert plain == expected
    assert type(plain) is type(expected)


def test_nested_values_become_json():
    value = {
        1.0: np.array([[1.0, np.nan], [np.inf, 4.0]]),
        "counts": (np.int64(3), np.bool_(True)),
        "deep": [{"x": np.float64(-np.inf)}, "text", None],
    }
    text = json.dumps(plain_values(value), allow_nan=False)
    assert json.loads(text) == {
        "1.0": [[1.0, None], [None, 4.0]],
        "counts": [3, True],
        "deep": [{"x": None}, "text", None],
    }
