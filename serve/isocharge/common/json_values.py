"""Conversion of values for JSON. NaN and infinity become None, because JSON has no notation for them."""

import math

import numpy as np


def finite_or_none(value: float | None) -> float | None:
    """Convert a number to a float. NaN, infinity and None become None."""
    if value is None or not math.isfinite(value):
        return None
    return float(value)


def plain_values(value: object) -> object:
    """Convert a value so that `json.dumps(..., allow_nan=False)` accepts it.

    Keys become texts. Arrays and tuples become lists. NumPy numbers become Python numbers. Numbers that are not finite
    become None.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()  # a list for an array, and a Python number for a NumPy number
    if isinstance(value, dict):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    return finite_or_none(value) if isinstance(value, float) else value
