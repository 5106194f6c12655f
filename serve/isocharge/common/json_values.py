"""Conversion of values for JSON. NaN and infinity become None, because JSON cannot represent these numbers."""

import math
from typing import Any

import msgspec


def finite_or_none(value: float | None) -> float | None:
    """Convert a number to a float, or to None if the number is NaN, infinite or None."""
    if value is None or not math.isfinite(value):
        return None
    return float(value)


def plain_values(value: object) -> Any:
    """Convert a value to a value that `json.dumps(..., allow_nan=False)` accepts.

    Arrays and tuples become lists. NumPy numbers become Python numbers. Numbers that are not finite become None. The
    keys of dictionaries become texts. The items of lists and dictionaries are converted in the same way.

    Args:
        value: Number, text, truth value, None, array, tuple, list or dictionary.
    """
    # msgspec calls `enc_hook` for arrays and for NumPy numbers, and writes null for numbers that are not finite.
    return msgspec.json.decode(msgspec.json.encode(value, enc_hook=lambda item: item.tolist()))
