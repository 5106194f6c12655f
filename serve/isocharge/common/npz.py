"""Reader for npz files that may come from an untrusted source.

An npz file is a zip archive with one entry in NumPy's npy format for each array. The sizes and the compression methods
that the archive declares are checked before NumPy reads any array. A small file can therefore not cause the allocation
of much memory. Arrays that contain pickled Python objects are refused.
"""

import io
import zipfile
from collections.abc import Mapping

import numpy as np

from isocharge.common.arrays import Array

MAX_UNPACKED_BYTES = 64 << 20
"""Largest total size of the arrays of a file, bytes."""

COMPRESSION_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods that are accepted. NumPy writes no others."""


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
                if entry.compress_type not in COMPRESSION_METHODS:
                    raise ValueError(f"an array has the compression method {entry.compress_type}")
            # An entry that is longer than declared is read only up to its declared length, and fails its checksum.
            unpacked_bytes = sum(entry.file_size for entry in archive.infolist())
        if unpacked_bytes > MAX_UNPACKED_BYTES:
            raise ValueError(f"the arrays unpack to more than {MAX_UNPACKED_BYTES} bytes")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: np.asarray(content) for name, content in arrays.items()}
    except Exception as error:  # zipfile, zlib and NumPy raise many types of exceptions for damaged files
        raise ValueError(str(error) or type(error).__name__) from error


def finite_array(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...]) -> Array:
    """Check the shape and the values of an array of a file, and return the array as float64.

    Args:
        arrays: Arrays of the file, by name.
        name: Name of the array.
        shape: Expected shape. The length None stands for any length of at least one.

    Raises:
        ValueError: If the array is missing, has another shape, or contains values that are not finite real numbers.
    """
    if name not in arrays:
        raise ValueError(f"the array {name!r} is missing")
    array = arrays[name]
    if array.dtype.kind not in "fiu":  # floating-point numbers, signed and unsigned integers
        raise ValueError(f"{name}: expected real numbers, got an array of {array.dtype}")
    is_fitting = array.ndim == len(shape) and all(
        length > 0 and expected in (None, length) for length, expected in zip(array.shape, shape, strict=True)
    )
    if not is_fitting:
        lengths = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: expected an array of shape ({lengths}), got {array.shape}")
    values = array.astype(np.float64)
    is_finite = np.isfinite(values)
    if not is_finite.all():
        first_wrong_value = values[~is_finite][0]
        raise ValueError(f"{name}: expected finite numbers, got {first_wrong_value}")
    return values


def finite_number(arrays: Mapping[str, np.ndarray], name: str) -> float:
    """Return the value of an array that contains a single number and has no dimensions.

    Args:
        arrays: Arrays of the file, by name.
        name: Name of the array.

    Raises:
        ValueError: If the array is missing, has dimensions, or does not contain a finite real number.
    """
    return float(finite_array(arrays, name, ()))
