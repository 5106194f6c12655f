"""Arrays of an npz file that somebody else may have made."""

import io
import lzma
import zipfile
import zlib
from collections.abc import Iterable

import numpy as np

MOST_UNPACKED = 64 << 20
"""Most that a file is unpacked to, bytes: far more than any of ours holds."""

LONGEST_HEAD = 4096
"""Longest head of an array, characters."""

PIECE = 4096
"""Bytes unpacked at a time: from one read, a decompressor may make thousands of times as many."""

DAMAGED = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
    lzma.LZMAError,
    zlib.error,
    MemoryError,
)
"""What NumPy, zipfile and whatever is made of the arrays raise over damaged files."""


def npz_arrays(data: bytes, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of an npz file; nothing in it is executed.

    Args:
        data: The file's bytes.
        names: The arrays to read; all if absent.

    Raises:
        ValueError: If they unpack to more than `MOST_UNPACKED` bytes, or are not arrays.
        Exception: Those of `DAMAGED`, over damaged data.
    """
    arrays, left = {}, MOST_UNPACKED
    with zipfile.ZipFile(io.BytesIO(data)) as packed:
        for name in names or (entry.removesuffix(".npy") for entry in packed.namelist()):
            unpacked = bytearray()
            with packed.open(f"{name}.npy") as file:
                while piece := file.read(PIECE):
                    unpacked += piece
                    if len(unpacked) > left:
                        raise ValueError(f"unpacks to more than {MOST_UNPACKED} bytes")
            left -= len(unpacked)
            array = io.BytesIO(unpacked)
            arrays[name] = np.lib.format.read_array(array, allow_pickle=False, max_header_size=LONGEST_HEAD)
    return arrays
