"""Reading of npz files from untrusted sources, compared with files that NumPy and zipfile write."""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from isocharge.common.arrays import npz_arrays

MEBIBYTE = 1 << 20


def npz(compressed=True, **arrays):
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


@given(
    st_numpy.arrays(
        st.sampled_from(["f8", "f4", "i2", "u1", ">f8", "U5", "c16", "bool"]),
        st_numpy.array_shapes(min_dims=0, max_dims=4, max_side=5),
    ),
    st.booleans(),
    st.booleans(),
)
def test_arrays_are_those_that_numpy_wrote(array, compressed, is_fortran):
    array = np.asarray(array, order="F" if is_fortran else "C")
    read = npz_arrays(npz(compressed, a=array))["a"]
    assert read.dtype == array.dtype
    np.testing.assert_array_equal(read, array)


def test_bomb_is_refused_before_it_is_unpacked():
    data = npz(a=np.zeros(160 * MEBIBYTE // 8))
    assert len(data) < MEBIBYTE
    tracemalloc.start()
    with pytest.raises(ValueError, match="the arrays unpack to more than 67108864 bytes"):
        npz_arrays(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * MEBIBYTE


def entry(content, name="a.npy", method=zipfile.ZIP_DEFLATED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        archive.writestr(name, content)
    return bytearray(file.getvalue())


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_entry_longer_than_the_archive_declares_is_refused():
    content = npy(np.zeros(MEBIBYTE))
    data = entry(content)
    size = struct.pack("<I", len(content))
    assert data.count(size) == 2
    with pytest.raises(ValueError, match=r"EOF|CRC|Overlapped|reading array data"):
        npz_arrays(bytes(data.replace(size, struct.pack("<I", 200))))


def with_header(text):
    """Return an npy file with a given header."""
    header = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(16)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000,)}"), "allocate|EOF"),
        (with_header("{'descr': '<f8', 'fortran_order': False, 'shape': (-2, -1)}"), "unknown dimension"),
        (with_header("{'descr': '|O', 'fortran_order': False, 'shape': (2,)}"), "Object arrays cannot be loaded"),
        (with_header("__import__('os')"), "malformed"),
        (npy(np.array([{}], dtype=object)), "Object arrays cannot be loaded"),
    ],
    ids=["too long", "negative shape", "objects", "code", "pickle"],
)
def test_entry_that_is_no_array_of_numbers_is_refused(content, reason):
    with pytest.raises(ValueError, match=reason):
        npz_arrays(bytes(entry(content)))


def test_compression_method_that_numpy_does_not_write_is_refused():
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with pytest.raises(ValueError, match=f"an array has the compression method {method}"):
            npz_arrays(bytes(entry(npy(np.zeros(1)), method=method)))
