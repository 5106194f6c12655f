"""Conversion of values for JSON. NaN and infinity become None, because JSON cannot represent these numbers."""

import math

import numpy as np


def finite_or_none(value: float | None) -> float | None:
    """Convert a number to a float, or to None if the number is NaN, infinite or None."""
    if value is None or not math.isfinite(value):
        return None
    return float(value)


def plain_values(value: object) -> object:
    """Convert a value to a value that `json.dumps(..., allow_nan=False)` accepts.

    Arrays and tuples become lists. NumPy numbers become Python numbers. Numbers that are not finite become None. The
    keys of dictionaries become texts. The items of lists and dictionaries are converted in the same way.

    Args:
        value: Number, text, truth value, None, array, tuple, list or dictionary.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()  # a list for an array, and a Python number for a NumPy number
    if isinstance(value, dict):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    if isinstance(value, float):
        return finite_or_none(value)
    return value
