"""Types of the NumPy arrays that appear in the signatures of functions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Float64 array. The docstring of each function gives the shape, the unit and the sign."""

Singles = NDArray[np.float32]
"""Float32 array. All tensors of the models have this number type."""

Reals = NDArray[np.floating[Any]]
"""Array of float64 or float32."""

Integers = NDArray[np.intp]
"""Array of indices."""

Booleans = NDArray[np.bool_]
"""Array of truth values, often a mask of rows."""

Complexes = NDArray[np.complex128]
"""Points of the plane as x + iy."""
