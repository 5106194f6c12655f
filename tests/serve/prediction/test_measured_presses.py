"""Measured presses: any spreadsheet's file is read, what is wrong is named, and writing loses nothing."""

import csv
import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from isocharge.common.arrays import LARGEST
from isocharge.common.errors import ChargeError, OutputError, PressError
from isocharge.serve import MeasuredPresses, read_charges, read_presses, write_presses
from isocharge.serve.presses import measured_presses
from isocharge.serve.presses.measured_presses import PRESS_RULES, read_press_list
from isocharge.serve.presses.table_file import csv_text

NAMES = ("A", "B", "C")
HEADER = "x_mm,y_mm,force_N,A,B,C"


@pytest.fixture
def write(tmp_path):
    """Write a text, or bytes, as `presses.csv`, and return the path."""

    def write(text):
        path = tmp_path / "presses.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


@pytest.fixture
def read(write):
    """Read a text, or bytes, as a file `presses.csv`."""
    return lambda text, **options: read_presses(write(text), NAMES, **options)


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbfx_mm,y_mm,force_N,A,B,C\r\n1,2,0.5,10,20,30\r\n\r\n",
        b'# rig 7, "left\nx_mm,y_mm,force_N,A,B,C\n\n # dropped,\n1,2,0.5,10,20,30\n',
        b" C , A,B ,force_N, y_mm,x_mm\n30, 10 ,20,5e-1,+2.,1.\n",
        b'"x_mm","y_mm","force_N","A","B","C"\n"1","2",".5","10","20","30"',
        b"x_mm,y_mm,force_N,A,B,C,,\n1,2,0.5,10,20,30,,\n,,,,,,,\n",
        b"day,x_mm,y_mm,force_N,A,B,C\nMonday,1,2,0.5,10,20,30\n",
    ],
)
def test_the_same_press_from_every_kind_of_file(read, text):
    np.testing.assert_equal(read(text).columns, read(f"{HEADER}\n1,2,0.5,10,20,30\n").columns)


def test_a_quoted_cell_may_hold_a_line_that_begins_with_a_hash(read):
    presses = read(f'{HEADER},note\n1,2,3,4,5,6,"first\n# second"\n1,2,3,4,5,7,\n')
    assert presses.charge_pC[:, 2].tolist() == [6.0, 7.0]


def test_without_names_all_other_columns_are_electrodes(read, write):
    presses = read_presses(write("force_N,A,y_mm,x_mm,C\n0.5,10,2,1,30\n"))
    assert (presses.electrodes, presses.charge_pC.tolist(), presses.ignored) == (("A", "C"), [[10.0, 30.0]], ())
    assert presses.of_electrodes(("C", "A"), "mine").charge_pC.tolist() == [[30.0, 10.0]]
    with pytest.raises(PressError, match=r"electrodes \('A', 'B'\) of mine, got \('A', 'C'\); missing: 'B'"):
        presses.of_electrodes(("A", "B"), "mine")
    assert read("day,x_mm,y_mm,note,A,B,C\n1,2,3,a,4,5,6\n").ignored == ("day", "note")


def test_a_list_of_presses_for_a_machine(write):
    path = write("n,x_mm,y_mm,force_N\n1,2,-3,0.5\n2,,,1\n")
    np.testing.assert_array_equal(read_press_list(path), [[2.0, -3.0, 0.5], [np.nan, np.nan, 1.0]])
    with pytest.raises(PressError, match=r"presses\.csv, line 3, column 'force_N': expected a positive force"):
        read_press_list(write("x_mm,y_mm,force_N\n1,1,1\n1,1,-1\n"))


def test_row_of_units_below_the_header_is_ignored(read):
    header = f"{HEADER},force_std,temperature_C".replace(",", ";")
    presses = read(f"{header}\nmm;mm;[N];pC;pC;pC;-;°C\n2;-6;0,2;502,3;244,8;215,8;0,01;21,5\n")
    assert (presses.contact.tolist(), presses.force_std.tolist()) == ([[2.0, -6.0, 0.2]], [0.01])
    assert (presses.charge_pC.tolist(), presses.lines) == ([[502.3, 244.8, 215.8]], (3,))


def test_header_may_be_a_comment(read):
    """`numpy.savetxt` writes such a header."""
    assert read(f"# pad\n# {HEADER}\n1,2,3,4,5,6\n").lines == (3,)


def test_default_uncertainty_fills_empty_cells(read):
    presses = read(f"{HEADER},force_std\n1,2,3,4,5,6,0.003\n1,2,3,4,5,6,\n", position_std_mm=0.3, force_std=0.02)
    assert (presses.position_std_mm.tolist(), presses.force_std.tolist()) == ([0.3, 0.3], [0.003, 0.02])
    plain = read(f"{HEADER}\n1,2,3,4,5,6\n")
    assert (plain.position_std_mm.tolist(), plain.force_std.tolist()) == ([0.1], [0.01])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"presses\.csv: empty; expected a header with x_mm, y_mm, force_N and the electrodes \('A', 'B', 'C'\)"),
        (HEADER, "expected one press or more below the header, got none"),
        ("x_mm,y_mm,force_N,A,C\n1,2,3,4,5\n", r"got the header .*; missing: \['B'\]$"),
        (f"{HEADER},B\n1,2,3,4,5,6,7\n", r"got the header .*; repeated: \['B'\]$"),
        ("x_mm,A,B,C\n1,2,3,4\n", "line 2: expected both x_mm and y_mm"),
        (f"{HEADER}\n1,2,3,4,5,6\n1,2,x,4,5,6\n", "line 3, column 'force_N': expected a positive force in N.*got 'x'"),
        (f"{HEADER}\n1,inf,3,4,5,6\n", "line 2, column 'y_mm': expected a position in mm.*got 'inf'"),
        (f"{HEADER}\n1,1e999,3,4,5,6\n", "line 2, column 'y_mm': .*got '1e999'"),
        (f"{HEADER}\nmm,mm,g,pC,pC,pC\n1,2,3,4,5,6\n", "got 'pC'; a row of units may only contain mm, N and pC"),
        (f"{HEADER}\n\n1,2,0,4,5,6\n", "line 3, column 'force_N': expected a positive force in N.*got 0$"),
        (
            f"{HEADER},position_std_mm\n1,2,3,4,5,6,0\n",
            "column 'position_std_mm': expected a positive standard .*got 0$",
        ),
        (f"{HEADER},force_std\n1,2,3,4,5,6,-1\n", "column 'force_std': .*got -1$"),
        (f"{HEADER},force_std\n1,2,3,4,5,6,5\n", r"a positive share of the force up to 1 \(0\.01 is 1 %\), got 5$"),
        (f"{HEADER}\n1,2,3,,,\n", "line 2: expected a charge of one electrode or more, got none; fill it in"),
        (f"{HEADER}\n1,2,3,4,5\n", "line 2: expected 6 cells as in the header, got 5"),
        (f'{HEADER}\n1.5,2,"0,5",4,5,6\n', "column 'force_N': expected .*, got '0,5'; the decimal mark is '.'"),
        (f'{HEADER},note\n1,2,3,4,5,6,"first\n1,2,3,4,5,7,\n', r"line 3: not CSV text \(unexpected end of data\)"),
    ],
)
def test_wrong_press_files_are_refused(read, text, message):
    with pytest.raises(PressError, match=message) as caught:
        read(text)
    assert "presses.csv" in str(caught.value)
    assert len(str(caught.value)) < 600


def test_press_file_with_too_many_presses_is_refused(monkeypatch, read):
    monkeypatch.setattr(measured_presses, "MAX_ROWS", 3)
    assert len(read(HEADER + "\n1,2,3,4,5,6" * 3)) == 3
    with pytest.raises(PressError, match="expected at most 3 presses, got more; split the file"):
        read(HEADER + "\n1,2,3,4,5,6" * 4)


def presses_of(charge_pC, names):
    """Return presses of 1 N at (1, 1) mm with some charges."""
    count = len(charge_pC)
    ones = np.ones(count)
    return MeasuredPresses(np.ones((count, 3)), charge_pC, ones, ones, names, tuple(range(1, count + 1)))


@pytest.mark.parametrize(
    "names",
    [
        (),
        ("A", "A"),
        ("",),
        ("force_N",),
        ("force_std", "A"),
        ("A\nB",),
        (" A",),
        tuple(f"Q{number}" for number in range(996)),
    ],
)
def test_electrodes_that_cannot_be_columns(names):
    with pytest.raises(PressError, match=r"^electrodes: expected 1 to 995 different names"):
        presses_of(np.ones((1, len(names))), names)


@pytest.mark.parametrize("name", ["nowhere.csv", "."])
def test_missing_press_file_is_refused(tmp_path, name):
    with pytest.raises(PressError, match=r"cannot be read .*expected a CSV file of presses"):
        read_presses(tmp_path / name, NAMES)


def test_arrays_of_different_lengths_are_refused():
    ones = np.ones(2)
    with pytest.raises(PressError, match=r"shapes \(\(2, 3\), \(2, 3\), .*, got \(\(2, 3\), \(2, 2\),"):
        MeasuredPresses(np.ones((2, 3)), np.ones((2, 2)), ones, 0.1 * ones, NAMES, (1, 2))


# Headers and encodings of other programs

ROW = "1,2,3,4,5,6\n"


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("x_mm,y_mm,force_N,Ladung A [pC],B,C", r"got the header \[.*'Ladung A \[pC\]'.*; missing: \['A'\]"),
        ("x_mm,y_mm,force_N,a,B,C", "rename 'a' to 'A' and check the units, or remove these columns; missing"),
        ("x_mm,y_mm,force_N,A [pC],B [pC],C [pC]", r"rename 'A \[pC\]' to 'A'"),
        ("x_mm,y_mm,Force_STD,A,B,C", "rename 'Force_STD' to 'force_std'"),
        ("x,y,force,A,B,C", "rename 'x' to 'x_mm', 'y' to 'y_mm', 'force' to 'force_N' and check"),
        ("x_um,y_um,force_N,A,B,C", "rename 'x_um' to 'x_mm', 'y_um' to 'y_mm' and check"),
        ("x_mm,y_mm,F [N],A,B,C", r"rename 'F \[N\]' to 'force_N' and check"),
        ("x_mm,y_mm,F_g,A,B,C", "rename 'F_g' to 'force_N' and check"),
        ("x_mm,y_mm,Force (lbf),A,B,C", r"rename 'Force \(lbf\)' to 'force_N' and check"),
    ],
)
def test_similar_header_names_the_column_to_rename(write, header, message):
    with pytest.raises(PressError, match=message) as caught:
        read_presses(write(f"{header}\n{ROW}"), NAMES)
    assert "expected a header with x_mm, y_mm, force_N and the electrodes" in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_headers_where_every_other_column_is_an_electrode(write):
    """A channel may have any name, but not one that stands for position or force."""
    assert read_presses(write("X_P,Y_P,Z\n1,2,3")).electrodes == ("X_P", "Y_P", "Z")
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
        (b"PAR1\x15\x04\x15\x00", r"presses\.csv: expected a CSV file, got a Parquet file; convert it to CSV"),
        (b"PK\x03\x04\xff\xff", "the byte 0xff is not text in UTF-8: export the file as CSV in UTF-8"),
    ],
)
@pytest.mark.parametrize("read", [read_presses, read_charges])
def test_headers_in_other_encodings_are_refused(write, read, data, message):
    with pytest.raises((PressError, ChargeError), match=message) as caught:
        read(write(data), NAMES)
    assert str(caught.value).count("presses.csv") == 1


def test_two_byte_order_marks_of_utf_8_are_accepted(write):
    path = write(b"\xef\xbb\xbf" * 2 + TEXT.encode())
    assert len(read_presses(path, NAMES)) == 1
    np.testing.assert_array_equal(read_charges(path, NAMES), [[4, 5, 6]])


# Round trips

FINITE = st.floats(-LARGEST, LARGEST)
POSITIVE = st.floats(0.0, LARGEST, exclude_min=True)
PRINTABLE = st.characters(codec="utf-8").filter(str.isprintable)
NAME = st.text(PRINTABLE, min_size=1, max_size=8).filter(lambda name: name == name.strip())


@st.composite
def some_presses(draw):
    names = tuple(draw(st.lists(NAME, min_size=1, max_size=4, unique=True)))
    assume(not set(names) & set(PRESS_RULES))
    unknown = st.just(np.nan)
    place = st.one_of(st.tuples(FINITE, FINITE), st.tuples(unknown, unknown))
    row = st.tuples(place, POSITIVE | unknown, st.lists(FINITE | unknown, min_size=len(names), max_size=len(names)))
    rows = [r for r in draw(st.lists(row, min_size=1, max_size=5)) if not np.isnan(r[2]).all()]
    assume(rows)
    stds = [[draw(POSITIVE), draw(st.floats(0.0, 1.0, exclude_min=True))] for _ in rows]
    return MeasuredPresses(
        np.array([[*place, force] for place, force, _ in rows]),
        np.array([charges for *_, charges in rows]),
        *np.array(stds).T,
        names,
        tuple(range(1, len(rows) + 1)),
    )


@given(presses=some_presses())
@settings(derandomize=True, max_examples=40)
def test_written_presses_are_read_back(presses, tmp_path_factory):
    """With the names of the electrodes, and with every other column as an electrode."""
    path = tmp_path_factory.getbasetemp() / "written.csv"
    write_presses(path, presses)
    for read in (read_presses(path, presses.electrodes), read_presses(path)):
        assert read.electrodes == presses.electrodes
        np.testing.assert_equal(read.columns, presses.columns)


def test_presses_that_would_not_be_read_are_not_written(tmp_path, monkeypatch):
    presses = presses_of(np.ones((2, 3)), NAMES)
    path = tmp_path / "p.csv"
    with pytest.raises(PressError, match=r"expected 1 to 1,000,000 presses to write, got 0"):
        write_presses(path, presses[:0])
    monkeypatch.setattr(measured_presses, "MAX_ROWS", 1)
    with pytest.raises(PressError, match=r"expected 1 to 1 presses to write, got 2"):
        write_presses(path, presses)
    assert not path.exists()
    with pytest.raises(OutputError, match=r"nowhere.*cannot be written"):
        write_presses(tmp_path / "nowhere" / "p.csv", presses[:1])


def test_a_charge_that_would_not_be_read_is_refused():
    with pytest.raises(PressError, match=r"^line 1, column 'A': expected a charge in pC, got 1e\+39$"):
        presses_of(np.array([[1e39]]), ("A",))


def test_a_written_file_is_plain_csv(read):
    header, row = csv.reader(csv_text(read(f"{HEADER}\n1,2,,10,,30\n").columns).splitlines())
    assert ",".join(header) == f"{HEADER},position_std_mm,force_std"
    assert ",".join(row) == "1.0,2.0,,10.0,,30.0,0.1,0.01"
