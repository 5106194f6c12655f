"""Reader for npz files that may come from an untrusted source.

An npz file is a zip archive. The archive contains one entry in NumPy's npy format for each array. The declared sizes,
the compression method and the size of the LZMA dictionary are checked before any entry is decompressed. A small file
can therefore not cause the allocation of much memory. Arrays that contain pickled Python objects are refused.
"""

import io
import lzma
import math
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping

import numpy as np

from isocharge.common.arrays import Array

MAX_UNPACKED_BYTES = 64 << 20
"""Largest total size of the arrays of a file, bytes."""

MAX_ENTRIES = 1000
"""Largest number of arrays in a file."""

MAX_HEADER_CHARACTERS = 4096
"""Longest header of an array, characters."""

PREAMBLE_BYTES = 16
"""Upper limit for the number of bytes before the header of an array: mark, version and length of the header."""

MAX_LZMA_DICTIONARY_BYTES = 16 << 20
"""Largest dictionary of an entry that is compressed with LZMA, bytes. The default of Python is 8 MiB."""

READ_BYTES = 4096
"""Number of bytes that are requested in one call, because a decompressor may return far more than was requested."""

COMPRESSION_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)
"""Compression methods that are accepted. NumPy and this project use no others."""

_LOCAL_HEADER = struct.Struct("<26xHH")
"""Header of an entry. Of its fields, only the lengths of the name and of the extra field are read."""

_LZMA_PROPERTIES = struct.Struct("<HHBI")
"""First bytes of an LZMA entry: version, length of the properties, a byte of options, and size of the dictionary."""

DAMAGED_FILE_ERRORS = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    RuntimeError,
    NotImplementedError,
    struct.error,
    zipfile.BadZipFile,
    lzma.LZMAError,
    zlib.error,
    MemoryError,
)
"""Exceptions that NumPy, zipfile and the code that uses the arrays raise for damaged files."""


def npz_arrays(data: bytes, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of an npz file.

    Args:
        data: Bytes of the file.
        names: Names of the arrays that are read. If None, all arrays are read.

    Returns:
        The arrays by name.

    Raises:
        ValueError: If an array is missing, the arrays are too large, or an entry is not an array of numbers or text.
        Exception: One of `DAMAGED_FILE_ERRORS`, if the data are damaged.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = _checked_entries(archive)
        selected_names = list(entries) if names is None else list(names)
        missing_names = [name for name in selected_names if name not in entries]
        if missing_names:
            raise ValueError(f"the array {missing_names[0]!r} is missing")

        # Add up the sizes that the archive declares. `_decompress` checks that no entry is longer than declared.
        unpacked_bytes = sum(entries[name].file_size for name in selected_names)
        if unpacked_bytes > MAX_UNPACKED_BYTES:
            raise ValueError(f"the arrays unpack to more than {MAX_UNPACKED_BYTES} bytes")

        arrays = {}
        for name in selected_names:
            if entries[name].compress_type == zipfile.ZIP_LZMA:
                _check_lzma_dictionary(data, entries[name])
            arrays[name] = _parse_npy(_decompress(archive, entries[name]), name)
        return arrays


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
    if not _has_shape(array, shape):
        lengths = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: expected an array of shape ({lengths}), got {array.shape}")
    values = array.astype(np.float64)
    is_finite = np.isfinite(values)
    if not is_finite.all():
        first_wrong_value = values[~is_finite][0]
        raise ValueError(f"{name}: expected finite numbers, got {first_wrong_value}")
    return values


def _has_shape(array: np.ndarray, shape: tuple[int | None, ...]) -> bool:
    """Return whether an array has the expected shape and is not empty.

    Args:
        array: The array.
        shape: Expected shape. The length None stands for any length of at least one.
    """
    if array.ndim != len(shape):
        return False
    return all(length > 0 and expected in (None, length) for length, expected in zip(array.shape, shape, strict=True))


def finite_number(arrays: Mapping[str, np.ndarray], name: str) -> float:
    """Return the value of an array that contains a single number and has no dimensions.

    Args:
        arrays: Arrays of the file, by name.
        name: Name of the array.

    Raises:
        ValueError: If the array is missing, has dimensions, or does not contain a finite real number.
    """
    return float(finite_array(arrays, name, ()))


def text_item(arrays: Mapping[str, np.ndarray], name: str) -> str:
    """Return the value of an array that contains a single text and has no dimensions.

    Args:
        arrays: Arrays of the file, by name.
        name: Name of the array.

    Raises:
        ValueError: If the array is missing or is not a single text.
    """
    if name not in arrays:
        raise ValueError(f"the array {name!r} is missing")
    array = arrays[name]
    is_text = array.dtype.kind == "U"  # Unicode
    if not is_text or array.ndim != 0:
        raise ValueError(f"{name}: expected a text, got an array of {array.dtype} with the shape {array.shape}")
    return str(array.item())


def _checked_entries(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Check the entries of an archive, and return a dictionary from the names of the arrays to the entries.

    Args:
        archive: The npz file.

    Raises:
        ValueError: If there are too many entries, two entries with the same name, or an entry with a compression method
            that is not accepted.
    """
    infos = archive.infolist()
    if len(infos) > MAX_ENTRIES:
        raise ValueError(f"expected at most {MAX_ENTRIES} arrays, got {len(infos)}")
    entries: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.filename.removesuffix(".npy")
        short_name = name[:100]  # for messages, because a name from an untrusted source may be very long
        if name in entries:
            raise ValueError(f"the array {short_name!r} is there twice")
        if info.compress_type not in COMPRESSION_METHODS:
            raise ValueError(f"the array {short_name!r} has the compression method {info.compress_type}")
        entries[name] = info
    return entries


def _check_lzma_dictionary(data: bytes, entry: zipfile.ZipInfo) -> None:
    """Check that the LZMA dictionary of an entry is not too large, because the decompressor allocates its size.

    An entry consists of its header, its name, an extra field and its content. The content of an LZMA entry begins with
    the LZMA properties, which contain the size of the dictionary (APPNOTE.TXT of the zip format, 5.8.8).

    Args:
        data: Bytes of the archive.
        entry: Entry that is compressed with LZMA.

    Raises:
        ValueError: If the dictionary is larger than `MAX_LZMA_DICTIONARY_BYTES`.
    """
    name_length, extra_length = _LOCAL_HEADER.unpack_from(data, entry.header_offset)
    content_offset = entry.header_offset + _LOCAL_HEADER.size + name_length + extra_length
    _version, _length, _options, dictionary_bytes = _LZMA_PROPERTIES.unpack_from(data, content_offset)
    if dictionary_bytes > MAX_LZMA_DICTIONARY_BYTES:
        raise ValueError(
            f"an LZMA dictionary of {dictionary_bytes} bytes; at most {MAX_LZMA_DICTIONARY_BYTES} are accepted"
        )


def _decompress(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytearray:
    """Decompress an entry, and check that the entry is not longer than the archive declares.

    Args:
        archive: The archive that contains the entry.
        entry: The entry.

    Raises:
        ValueError: If the entry is longer than declared. Decompression stops as soon as the declared length is
            exceeded.
    """
    content = bytearray()
    with archive.open(entry) as file:
        while block := file.read(READ_BYTES):
            content += block
            if len(content) > entry.file_size:  # the size that the archive declares
                raise ValueError(f"an entry is longer than the {entry.file_size} bytes that the archive declares")
    return content


def _parse_npy(content: bytearray, name: str) -> np.ndarray:
    """Convert the bytes of an npy file into the array that the file contains. The array shares the memory of the bytes.

    Args:
        content: Bytes of the npy file.
        name: Name of the array, for error messages.

    Raises:
        ValueError: If the version of the npy format is not supported, the array contains Python objects, or the shape
            of the array does not fit the number of bytes.
    """
    # Read the header, which contains the shape, the order of the axes in memory, and the type of the numbers.
    header = io.BytesIO(content[: MAX_HEADER_CHARACTERS + PREAMBLE_BYTES])
    version = np.lib.format.read_magic(header)
    if version == (1, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(header, MAX_HEADER_CHARACTERS)
    elif version == (2, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_2_0(header, MAX_HEADER_CHARACTERS)
    else:
        raise ValueError(f"{name}: version {version} of the npy format is not supported")
    if dtype.hasobject:
        raise ValueError(f"{name}: expected numbers or text, got Python objects")

    # Check that the bytes after the header have exactly the size of an array of this shape. An item of the array is a
    # number or a text.
    header_bytes = header.tell()
    item_bytes = len(content) - header_bytes
    item_count = math.prod(shape)
    has_negative_length = any(length < 0 for length in shape)  # two negative lengths have a positive product
    if has_negative_length or item_count * dtype.itemsize != item_bytes:
        raise ValueError(f"{name}: the shape {shape} of {dtype} does not fit {item_bytes} bytes")

    if item_count == 0:  # `frombuffer` refuses an empty buffer
        return np.empty(shape, dtype)
    array = np.frombuffer(content, dtype=dtype, count=item_count, offset=header_bytes)
    return array.reshape(shape, order="F" if is_fortran else "C")
