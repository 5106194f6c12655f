"""Numbers for JSON, which has no notation for NaN and infinity: None takes their place."""

import math

import numpy as np


def finite_or_none(value: float | None) -> float | None:
    """The number as a plain float; None if it is NaN, infinite or absent."""
    return float(value) if value is not None and math.isfinite(value) else None


def plain_values(value: object) -> object:
    """A value that `json.dumps(..., allow_nan=False)` writes.

    Keys become texts, arrays and tuples lists, NumPy's numbers Python's, and numbers that are not finite None.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item) for item in value]
    return finite_or_none(value) if isinstance(value, float) else value
