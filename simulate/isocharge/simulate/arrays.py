"""The array type of public signatures: float64 unless a docstring says otherwise."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Float64 array; each docstring gives shape, unit and sign."""

Integers = NDArray[np.intp]
"""Array of indices."""

Booleans = NDArray[np.bool_]
"""Array of truths, often of rows to take."""

Complexes = NDArray[np.complex128]
"""Points of the plane as x + iy."""
