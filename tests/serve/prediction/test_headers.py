"""Headers and encodings of other programs: the message shows the header and names the column, or the wrong byte."""

import re

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, PressError
from isocharge.serve import read_charges, read_presses
from isocharge.serve.prediction.table import read_charge_file

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
        ("x_mm,y_mm,force_N,Ladung A [pC],B,C", r"got the header \[.*'Ladung A \[pC\]'.*; missing: \['A'\]"),
        ("x_mm,y_mm,force_N,a,B,C", "rename 'a' to 'A' and check its unit, or remove the column; missing"),
        ("x_mm,y_mm,force_N,A [pC],B [pC],C [pC]", r"rename 'A \[pC\]' to 'A'"),
        ("x_mm,y_mm,force_N,A_pC,B_pC,C_pC", "rename 'A_pC' to 'A'"),
        ("x [mm],y_mm,force_N,A,B,C", r"rename 'x \[mm\]' to 'x_mm'"),
        ("x_mm,y_mm,Force (N),A,B,C", r"rename 'Force \(N\)' to 'force_N'"),
        ("x_mm,y_mm,Force_STD,A,B,C", "rename 'Force_STD' to 'force_std'"),
        ("x_m,y_m,force_N,A,B,C", "rename 'x_m' to 'x_mm' and check its unit"),
        ("x_mm,y_mm,force (mN),A,B,C", r"rename 'force \(mN\)' to 'force_N' and check"),
        ("x_mm,y_mm,force_N,A [nC],B,C", r"rename 'A \[nC\]' to 'A' and check"),
    ],
)
def test_similar_header_names_the_column_to_rename(write, header, message):
    with pytest.raises(PressError, match=message) as caught:
        read_presses(write(f"{header}\n{ROW}"), NAMES)
    assert "expected a header with x_mm, y_mm, force_N and the electrodes" in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_headers_where_every_other_column_is_an_electrode(write):
    """A channel may have any name, but not one that stands for position or force."""
    assert read_presses(write("X_N,X_P,Y\n1,2,3")).electrodes == ("X_N", "X_P", "Y")
    assert read_presses(write(f"x_mm,y_mm,force_N,a,f,Ladung [pC]\n{ROW}")).electrodes == ("a", "f", "Ladung [pC]")
    for misspelt, name in (("force [N]", "force_N"), ("Temperature_C", "temperature_C")):
        with pytest.raises(PressError, match=f"rename '{re.escape(misspelt)}' to '{name}' and check"):
            read_presses(write(f"x_mm,y_mm,{misspelt},a,b,c\n{ROW}"))


TEXT = f"# Größe\nx_mm,y_mm,force_N,A,B,C\n{ROW}"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (TEXT.encode("utf-16"), r"presses\.csv, line 1: the byte 0xff is not text in UTF-8: .* iconv -f UTF-16"),
        (TEXT[8:].encode("utf-16-le"), r"line 1: the byte 0x00 is not text in UTF-8: .* iconv -f UTF-16"),
        (TEXT.encode("latin-1"), r"line 1: the byte 0xf6 is not text in UTF-8: .*WINDOWS-1252"),
        (f"{TEXT[8:]}{ROW * 5000}1,2,3,4,5,ü".encode("cp1252"), "line 5003: the byte 0xfc"),
        (b"PK\x03\x04\xff\xff", "the byte 0xff is not text in UTF-8: export the file as CSV in UTF-8"),
    ],
)
@pytest.mark.parametrize("read", [read_presses, read_charge_file])
def test_headers_in_other_encodings_are_refused(write, read, data, message):
    with pytest.raises((PressError, ChargeError), match=message) as caught:
        read(write(data), NAMES)
    assert str(caught.value).count("presses.csv") == 1


def test_two_byte_order_marks_of_utf_8_are_accepted(write):
    path = write(b"\xef\xbb\xbf" * 2 + TEXT.encode())
    assert len(read_presses(path, NAMES)) == 1
    np.testing.assert_array_equal(read_charge_file(path, NAMES), [[4, 5, 6]])
    assert read_charges(["\ufeffA,B,C\n", "1,2,3\n"], NAMES, "text").tolist() == [[1, 2, 3]]
