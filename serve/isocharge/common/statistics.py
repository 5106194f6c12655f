"""Statistics of arrays that several packages use."""

import numpy as np

from isocharge.common.arrays import Array


def rms(values: Array) -> float:
    """Compute the root mean square over all elements of an array."""
    return float(np.sqrt(np.mean(np.square(values))))
