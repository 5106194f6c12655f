"""Headers and encodings of other programs: the message names the column to rename, or the encoding to save in."""

import io
import time

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, PressError
from isocharge.serve import read_charges, read_presses
from isocharge.serve.prediction.table import read_charge_file
from isocharge.serve.presses.measured_presses import read_press_list

NAMES = ("A", "B", "C")
ROW = "1,2,3,4,5,6\n"


@pytest.fixture
def write(tmp_path):
    """Write text or bytes as `presses.csv` and return the path."""

    def write(text):
        path = tmp_path / "presses.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "x_mm,y_mm,force_N,a,b,c",
            "missing: 'A', 'B', 'C'; column 'a' differs from electrode 'A' only by case: rename it to 'A'; column 'b'",
        ),
        ("x_mm,y_mm,force_N,Ladung A [pC],B,C", r"missing: 'A'; rename 'Ladung A \[pC\]' to 'A'"),
        ("x_mm,y_mm,force_N,Ladung A,Ladung B,Ladung C", "rename 'Ladung A' to 'A'; rename 'Ladung B' to 'B'; rename"),
        ("x_mm,y_mm,force_N,A,B,Charge_c_pC", "missing: 'C'; rename 'Charge_c_pC' to 'C'"),
        ("x_mm,y_mm,force_N,A (nC),B,C", r"column 'A \(nC\)' is in nC: convert it to pC and rename it to 'A'"),
        ("x_mm,y_mm,Kraft [N],A,B,C", r"got the header .*; rename 'Kraft \[N\]' to 'force_N'; or remove"),
        ("x_mm,y_mm,Síla (N),A,B,C", r"rename 'Síla \(N\)' to 'force_N'"),
        ("x_mm,y_mm,F_N,A,B,C", "rename 'F_N' to 'force_N'"),
        ("x_mm,y_mm,Kraft [mN],A,B,C", r"column 'Kraft \[mN\]' is in mN: convert it to N and rename it to 'force_N'"),
        ("Position x [mm],y [mm],force_N,A,B,C", r"rename 'Position x \[mm\]' to 'x_mm'; rename 'y \[mm\]' to 'y_mm'"),
        ("x,y,force_N,A,B,C", "rename 'x' to 'x_mm'; rename 'y' to 'y_mm'"),
        ("x_cm,y_mm,force_N,A,B,C", "column 'x_cm' is in cm: convert it to mm"),
        ("x_mm y_mm force_N A B C,C", "missing: 'A', 'B'$"),
        (
            "X_MM,y_mm,Force_N,A,B,C",
            "column 'X_MM' differs from column 'x_mm' only by case: rename it to 'x_mm'; column",
        ),
        ("x [mm],y [mm],Kraft [N],a,b,c", "missing: .*rename 'Kraft .N.' to 'force_N'; column 'a' differs"),
        ("x_mm,y_mm,Force_STD,A,B,C", "column 'Force_STD' differs from column 'force_std' only by case"),
    ],
)
def test_similar_header_names_the_column_to_rename(write, header, message):
    with pytest.raises(PressError, match=message) as caught:
        read_presses(write(f"{header}\n{ROW}"), NAMES)
    assert "expected a header with x_mm, y_mm, force_N and the electrodes" in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "header",
    [
        "t,note,force_N,A,B,C",
        "Fx,Raumtemperatur [°C],force_N,A,B,C",
        "a note,Charge sum [pC],force_N,A,B,C",
        "x,force [N],force_N,A,B,C,x_mm,y_mm",
        "max [mm],Name,force_N,A,B,C",
    ],
)
def test_other_columns_are_ignored(write, header):
    count = len(header.split(","))
    presses = read_presses(write(f"{header}\n" + ",".join("123456789"[:count]) + "\n"), NAMES)
    assert presses.charge_pC.tolist() == [[4.0, 5.0, 6.0]]


def test_header_with_a_very_long_name_is_checked_fast(write):
    name = "x" + " " * 30_000 + "]"
    before = time.process_time()
    with pytest.raises(PressError, match="missing: 'A'"):
        read_presses(write(f"{name},y_mm,force_N,B,C,D\n{ROW}"), NAMES)
    assert time.process_time() - before < 1.0


def test_headers_where_every_other_column_is_an_electrode(write):
    """A channel may have any name, but not one that stands for position or force."""
    assert read_presses(write(f"x_mm,y_mm,force_N,a,f,Ladung [pC]\n{ROW}")).electrodes == ("a", "f", "Ladung [pC]")
    with pytest.raises(PressError, match=r"rename 'Kraft \[N\]' to 'force_N'; or remove"):
        read_presses(write(f"x_mm,y_mm,Kraft [N],a,b,c\n{ROW}"))


def test_headers_of_charges_alone(write):
    with pytest.raises(ChargeError, match="missing: 'A'; column 'a' differs from electrode 'A' only by case"):
        read_charges(io.StringIO("a,B,C\n1,2,3\n"), NAMES, "stdin")
    assert read_charge_file(write(f"x,y,Kraft,A,B,C\n{ROW}"), NAMES).tolist() == [[4.0, 5.0, 6.0]]


def test_headers_of_a_list_of_presses(write):
    with pytest.raises(PressError, match=r"missing: 'force_N'; rename 'Kraft \[N\]' to 'force_N'"):
        read_press_list(write("x_mm,y_mm,Kraft [N]\n1,2,3\n"))


TEXT = f"# Größe\nx_mm,y_mm,force_N,A,B,C\n{ROW}"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (TEXT.encode("utf-16"), r"presses\.csv: the file is UTF-16: save it as UTF-8, as with: iconv -f UTF-16 -t"),
        (b"\xfe\xff" + TEXT.encode("utf-16-be"), "the file is UTF-16"),
        (TEXT.encode("utf-32"), "the file is UTF-32"),
        (TEXT[8:].encode("utf-16-le"), "null characters: the file seems to be UTF-16 without a byte order mark; save"),
        (TEXT[8:].encode("utf-16-be"), "null characters: the file seems to be UTF-16.* iconv -f UTF-16BE -t UTF-8"),
        (TEXT.encode("latin-1"), r"line 1: the byte 0xf6 is not text in UTF-8: .*iconv -f WINDOWS-1252 -t UTF-8"),
        (f"{TEXT}1,2,3,4,5,ü".encode("cp1252"), "line 1: the byte 0xf6"),
        (f"{TEXT[8:]}1,2,3,4,5,ü".encode("cp1252"), "line 3: the byte 0xfc"),
        (f"{TEXT[8:]}{ROW * 5000}1,2,3,4,5,ü".encode("cp1252"), "line 5003: the byte 0xfc"),
        (b"PK\x03\x04\xff\xff", "a workbook of a spreadsheet or a zip file: save the sheet as CSV"),
        (b"PAR1\x15\x04\x15\xff", "the file is Parquet: rename it so that its name ends in .parquet"),
        (b"\x1f\x8b\x08\x00", "the file is compressed"),
        (b"\x89HDF\r\n\x1a\n\0", "the file is HDF5: write its columns as CSV"),
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64 \0\1IM\0", "the file is a MAT-file of MATLAB: .*writetable"),
        (b"TDSm\x0e\0\0\0i\x12\0\0\n", "the file is TDMS of LabVIEW: write the columns as CSV"),
        (b"abc\0\1\2\0\0", "null characters and is not text: write its columns as CSV"),
    ],
)
@pytest.mark.parametrize("read", [read_presses, read_charge_file])
def test_headers_in_other_encodings_are_refused(write, read, data, message):
    with pytest.raises((PressError, ChargeError), match=message):
        read(write(data), NAMES)


@pytest.mark.parametrize("marks", [1, 2])
def test_a_byte_order_mark_of_utf_8_is_accepted(write, marks):
    path = write(b"\xef\xbb\xbf" * marks + TEXT.encode())
    assert len(read_presses(path, NAMES)) == 1
    np.testing.assert_array_equal(read_charge_file(path, NAMES), [[4, 5, 6]])
    assert read_charges(["\ufeffA,B,C\n", "1,2,3\n"], NAMES, "text").tolist() == [[1, 2, 3]]
