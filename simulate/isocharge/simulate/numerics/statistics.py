"""Root mean square."""

import numpy as np

from isocharge.common.arrays import Array


def rms(values: Array) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))
