"""Conversion of values to JSON. Values without a notation in JSON become null."""

import json

import numpy as np

from isocharge.common.structs import plain_values


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
