"""Parquet files of presses: what other programs write is read as the same CSV is, and the rest is refused at once."""

import os
from decimal import Decimal

import numpy as np
import pyarrow
import pytest
from pyarrow.parquet import ParquetFile, write_table

from isocharge.common.errors import ChargeError, PressError
from isocharge.serve import read_presses
from isocharge.serve.prediction.table import read_charge_file
from isocharge.serve.presses.measured_presses import read_press_list

NAMES = ("A", "B", "C")

COLUMNS = {
    "x_mm": [1.0, 2.0, None],
    "y_mm": [3.0, 4.0, None],
    "force_N": [0.5, 1.0, 2.0],
    "A": [100.5, None, 3.0],
    "B": [-1.0, 2.0, 3.0],
    "C": [1.0, 2.0, 3.0],
}
CSV = "x_mm,y_mm,force_N,A,B,C\n1,3,0.5,100.5,-1,1\n2,4,1,,2,2\n,,2,3,3,3\n"


@pytest.fixture
def write(tmp_path):
    """Write columns, with some of them replaced, as `p.parquet`, and return the path."""

    def write(**changes):
        write_table(pyarrow.table(COLUMNS | changes), tmp_path / "p.parquet")
        return tmp_path / "p.parquet"

    return write


@pytest.fixture
def expected(tmp_path):
    """The same presses from CSV."""
    (tmp_path / "p.csv").write_text(CSV)
    return read_presses(tmp_path / "p.csv", NAMES)


@pytest.mark.parametrize(
    "column",
    [
        pyarrow.array([1, -2, None], pyarrow.int8()),
        pyarrow.array([1, 2, 2**53 - 1], pyarrow.uint64()),
        pyarrow.array([1.5, -0.25, None], pyarrow.float16()),
        pyarrow.array([1.5, 1.5, -0.25]).dictionary_encode(),
        pyarrow.array([Decimal("0.1"), Decimal("-1234567.25"), None], pyarrow.decimal128(38, 10)),
    ],
    ids=lambda column: str(column.type),
)
def test_numbers_of_every_type_are_exact(write, column):
    """Python rounds an integer and a decimal to the nearest float64."""
    charge = read_presses(write(A=column), NAMES).charge_pC[:, 0]
    given = [np.nan if value is None else float(value) for value in column.to_pylist()]
    np.testing.assert_array_equal(charge, given)


def test_ignored_columns_may_have_any_type(write, expected):
    presses = read_presses(write(more=pyarrow.array([{"A": 1, "B": None}, None, {}])), NAMES)
    np.testing.assert_equal(presses.columns, expected.columns)
    assert (presses.ignored, presses.lines, presses.row_noun) == (("more",), (1, 2, 3), "row")


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (["1", "2", "3"], r"column 'B': expected numbers \(a charge in pC\), got a column of type string; convert it"),
        (pyarrow.array([1, 2, 3], pyarrow.timestamp("us")), "column 'B': .* got a column of type timestamp"),
        ([1.0, 2.0, -np.inf], "row 3, column 'B': expected a charge in pC, got -inf"),
        ([1.0, 1e39, 3.0], r"row 2, column 'B': expected a charge in pC, got 1e\+39"),
    ],
)
def test_a_column_of_another_type_is_refused(write, column, message):
    with pytest.raises(PressError, match=rf"p\.parquet, {message}"):
        read_presses(write(B=column), NAMES)


def test_charges_and_lists_of_presses(write, caplog):
    path = write(A=[1.0, 2.0, 3.0])
    np.testing.assert_array_equal(read_charge_file(path, ("B", "A")), [[-1, 1], [2, 2], [3, 3]])
    assert caplog.messages == [f"{path}: ignored columns: ['x_mm', 'y_mm', 'force_N', 'C']"]
    with pytest.raises(ChargeError, match=r"p\.parquet, row 2, column 'A': expected a charge in pC, got an empty cell"):
        read_charge_file(write(), NAMES)
    np.testing.assert_array_equal(read_press_list(path), [[1, 3, 0.5], [2, 4, 1], [np.nan, np.nan, 2]])


# Limits


def test_long_text_that_is_repeated_is_not_decoded(tmp_path):
    """A small file whose ignored column has 5 GB of text."""
    count = 50_000
    table = pyarrow.table(dict.fromkeys(("force_N", *NAMES), np.ones(count)))
    text = pyarrow.DictionaryArray.from_arrays(np.zeros(count, np.int32), ["x" * 100_000])
    write_table(table.append_column("note", text), tmp_path / "bomb.parquet", compression="zstd")
    assert (tmp_path / "bomb.parquet").stat().st_size < 10_000
    pool = pyarrow.proxy_memory_pool(pyarrow.default_memory_pool())
    earlier_pool = pyarrow.default_memory_pool()
    pyarrow.set_memory_pool(pool)
    try:
        assert len(read_presses(tmp_path / "bomb.parquet", NAMES)) == count
    finally:
        pyarrow.set_memory_pool(earlier_pool)
    assert pool.max_memory() < 10e6


def test_parquet_with_too_many_rows_is_refused(tmp_path, monkeypatch):
    """They are counted in the metadata."""
    one = pyarrow.array(np.ones(1_000_001))
    write_table(pyarrow.table(dict.fromkeys(("force_N", *NAMES), one)), tmp_path / "long.parquet")
    monkeypatch.setattr(ParquetFile, "read", None)
    with pytest.raises(
        PressError, match=r"long\.parquet: expected at most 1,000,000 presses, got more; split the file"
    ):
        read_presses(tmp_path / "long.parquet", NAMES)


# What is not Parquet


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"cannot be read \(No such file or directory\); expected a Parquet file"),
        (b"", "not a Parquet file"),
        (b"PAR1" + b"\xff\xff\xff\x7f" + b"PAR1", "not a Parquet file, or a damaged one"),
        ("pipe", r"cannot be read \(not a regular file\); expected a Parquet file"),
    ],
)
@pytest.mark.parametrize("read", [read_presses, read_charge_file])
def test_files_that_are_not_parquet_are_refused(read, content, message, tmp_path):
    if content == "pipe":
        os.mkfifo(tmp_path / "p.parquet")
    elif content is not None:
        (tmp_path / "p.parquet").write_bytes(content)
    with pytest.raises((PressError, ChargeError), match=message) as caught:
        read(tmp_path / "p.parquet", NAMES)
    assert str(caught.value).startswith(str(tmp_path / "p.parquet"))
