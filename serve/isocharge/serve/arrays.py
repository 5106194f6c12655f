"""The array types of public signatures: float64 for computing, float32 for what a model takes and gives."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Float64 array; each docstring gives shape, unit and sign."""

Singles = NDArray[np.float32]
"""Float32 array, the number type of every model tensor."""

Reals = NDArray[np.floating[Any]]
"""Array of either."""

Booleans = NDArray[np.bool_]
"""Array of yes and no."""
