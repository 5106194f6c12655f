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

from isocharge.common.npz import finite_array, finite_number, npz_arrays

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


def test_array_with_a_side_of_zero_is_read():
    assert npz_arrays(npz(a=np.zeros((3, 0))))["a"].shape == (3, 0)


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


ARRAYS = {
    "numbers": np.arange(6).reshape(2, 3),
    "text": np.array("some text"),
    "complex": np.ones(3, complex),
    "dates": np.array(["2026-01-01"], "datetime64[s]"),
    "infinite": np.array([1.0, np.inf]),
    "one": np.array(2.5),
}


def test_checked_arrays_are_float64():
    assert finite_array(ARRAYS, "numbers", (2, None)).tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    assert finite_number(ARRAYS, "one") == 2.5


@pytest.mark.parametrize(
    ("name", "shape", "reason"),
    [
        ("absent", (1,), "the array 'absent' is missing"),
        ("numbers", (2, 4), r"expected an array of shape \(2, 4\), got \(2, 3\)"),
        ("numbers", (None,), r"expected an array of shape \(n\), got \(2, 3\)"),
        ("text", (), "expected real numbers, got an array of <U9"),
        ("complex", (3,), "expected real numbers, got an array of complex128"),
        ("dates", (1,), "expected real numbers, got an array of datetime64"),
        ("infinite", (2,), "expected finite numbers, got inf"),
    ],
)
def test_array_of_another_kind_is_refused(name, shape, reason):
    with pytest.raises(ValueError, match=reason):
        finite_array(ARRAYS, name, shape)


@pytest.mark.parametrize("content", [b"no array", b""])
def test_entry_without_an_array_is_no_number(content):
    with pytest.raises(ValueError, match="a: expected real numbers"):
        finite_number(npz_arrays(bytes(entry(content, name="a"))), "a")
