"""Types of the NumPy arrays in the signatures of functions, and the reader for npz files of untrusted sources.

An npz file is a zip archive with one entry in NumPy's npy format for each array. The sizes and the compression methods
that the archive declares are checked before NumPy reads any array. A small file therefore cannot occupy much memory.
Arrays that contain pickled Python objects are refused.
"""

import io
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.files import MAX_FILE_BYTES

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

LARGEST = float(np.finfo(np.float32).max)
"""Largest number that the tensors of the models can contain: the largest float32 number."""

NPZ_COMPRESSION_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that are accepted in npz files. NumPy writes no others."""


def npz_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Read the arrays of an npz file.

    Args:
        data: Bytes of the file.

    Returns:
        The arrays by name.

    Raises:
        ValueError: If the file is damaged, the arrays are too large, or an array contains Python objects.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for entry in archive.infolist():
                if entry.compress_type not in NPZ_COMPRESSION_METHODS:
                    raise ValueError(f"an array has the compression method {entry.compress_type}")
            # An entry that is longer than declared is read only up to its declared length, and fails its checksum.
            unpacked_bytes = sum(entry.file_size for entry in archive.infolist())
        if unpacked_bytes > MAX_FILE_BYTES:
            raise ValueError(f"the arrays unpack to more than {MAX_FILE_BYTES} bytes")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: np.asarray(content) for name, content in arrays.items()}
    except Exception as error:
        # zipfile, zlib and NumPy raise many types of exceptions for damaged files. All of them, also the two errors
        # above, are raised again as ValueError with the same message.
        raise ValueError(str(error) or type(error).__name__) from error
