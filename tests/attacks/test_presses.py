"""Files of measured presses with faults: Parquet with damaged pages, headers and metadata, and CSV text."""

import numpy as np
import pyarrow
import pytest
from pyarrow.parquet import write_table

from attacks.faults import mutated
from isocharge.serve import read_presses
from isocharge.serve.prediction.table import read_charge_file

NAMES = ("A", "B", "C")

WRITERS = {
    "snappy": {},
    "gzip": {"compression": "gzip", "data_page_version": "2.0"},
    "zstd": {"compression": "zstd", "row_group_size": 7},
    "plain": {"compression": "none", "use_dictionary": False, "write_page_index": True},
    "old": {"version": "1.0", "compression": "brotli", "write_statistics": False},
}
"""Settings with which the intact files are written."""

FAULTS = {
    "anywhere": (4_000, lambda rng, good: mutated(rng, good)),
    "cut": (200, lambda rng, good: good[: rng.randrange(len(good))]),
    "bits": (4_000, lambda rng, good: with_flipped_bits(rng, good, 4, len(good) - 8)),
    "metadata": (6_000, lambda rng, good: with_flipped_bits(rng, good, metadata_start(good), len(good) - 8)),
}
"""Number of inputs, and the function that makes one of them from an intact file."""


def metadata_start(data):
    """Offset of the metadata, whose size is stored before the mark at the end."""
    return len(data) - 8 - int.from_bytes(data[-8:-4], "little")


def with_flipped_bits(rng, good, start, end):
    """Flip one to eight bits between two offsets, so that the structure of the file remains."""
    data = bytearray(good)
    for _ in range(rng.choice((1, 1, 2, 8))):
        data[rng.randrange(start, end)] ^= 1 << rng.randrange(8)
    return bytes(data)


def presses_table():
    """Return 20 presses with unknown values, other types of numbers and a column of text."""
    rng = np.random.default_rng(0)
    columns = {name: rng.uniform(0.1, 2.0, 20) for name in ("x_mm", "y_mm", "force_N", "A")}
    columns["note"] = ["a text", None] * 10
    columns["B"] = pyarrow.array([1, None, 3, 4, 5] * 4, pyarrow.int32())
    columns["C"] = pyarrow.array([1, 2, 3, 4] * 5).cast(pyarrow.decimal128(25, 2))
    return pyarrow.table(columns)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("faults", FAULTS)
def test_parquet_with_faults(writer, faults, tmp_path, attack):
    path = tmp_path / "p.parquet"
    write_table(presses_table(), path, **WRITERS[writer])
    good = path.read_bytes()
    count, make = FAULTS[faults]
    read_presses(path, NAMES)

    def read(data):
        path.write_bytes(data)
        presses = read_presses(path, NAMES)
        assert len(presses) > 0
        assert np.isfinite(presses.charge_pC).any(axis=1).all()

    def read_charges(data):
        path.write_bytes(data)
        assert np.isfinite(read_charge_file(path, ("A",))).all()

    attack(f"presses {writer} {faults}", read, lambda rng: make(rng, good), count)
    attack(f"charges {writer} {faults}", read_charges, lambda rng: make(rng, good), count // 4)


def test_csv_with_faults(tmp_path, attack):
    path = tmp_path / "p.csv"
    good = b'# rig 7\nx_mm,y_mm,force_N,A,B,C,note\n1,2,0.5,10,20,30,"a\n# b"\n,,1,,2e1,30,\n'

    def read(data):
        path.write_bytes(data)
        assert len(read_presses(path, NAMES)) > 0

    read(good)
    attack("presses csv", read, lambda rng: mutated(rng, good), 10_000)
