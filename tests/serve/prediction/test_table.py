"""CSV of charges in any reasonable dress, and every unreasonable one refused with its line."""

import io
import json

import numpy as np
import pytest

from isocharge.common.errors import ChargeError
from isocharge.serve import Contacts, read_charges, table_records, write_contacts

NAMES = ("A", "B", "C")


def read(text):
    return read_charges(io.StringIO(text, newline=""), NAMES, "presses.csv")


@pytest.mark.parametrize(
    "text",
    [
        "A,B,C\n1,2,3\n4,5,6.5\n",
        "A,B,C\r\n1,2,3\r\n4,5,6.5\r\n\r\n\r\n",
        "C,A,B\n3,1,2\n6.5,4,5",
        "\n A , B,C \n1, 2,3\n,,\n4,5,65e-1\n",
        '"A","B","C"\n"1",2,3\n4,5,6.5\n',
        '# of "today\n\nA,B,C\n1,2,3,,\n  # 7,8,9\n4,5,6.5\n',
    ],
)
def test_charges_are_the_same_from_every_kind_of_csv(text):
    np.testing.assert_array_equal(read(text), [[1, 2, 3], [4, 5, 6.5]])


def test_further_columns_are_ignored_with_a_word():
    words = []
    text = io.StringIO("x_mm,A,B,,C,x_mm\nhere,1,2,?,3,\n")
    np.testing.assert_array_equal(read_charges(text, NAMES, "presses.csv", words.append), [[1, 2, 3]])
    assert words == ["presses.csv: ignored columns: ['x_mm', '', 'x_mm']"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (",".join(f"column {i}" for i in range(2000)), "expected at most 1,000 columns, got 2,000"),
        ("A" * 200_000, "line 1: not CSV text in UTF-8 .field larger"),
        ("A,B," + "x" * 90_000, "missing: 'C'"),
        ("A,B,C\n" + ",".join("1" * 20_000), "line 2: expected 3 cells"),
    ],
)
def test_a_message_stays_short(text, said):
    with pytest.raises(ChargeError, match=said) as caught:
        read(text)
    assert len(str(caught.value)) < 600


def test_charges_of_a_header_alone():
    assert read("A,B,C\n").shape == (0, 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"presses.csv: empty; expected a header with one column for each of the electrodes \('A', 'B', 'C'\)"),
        ("\n\n", "empty"),
        ("A,B\n1,2\n", "missing: 'C'"),
        ("A,B,C,C\n1,2,3,4\n", "repeated: 'C'"),
        ("1,2,3\n4,5,6\n", "missing: 'A', 'B', 'C'"),
        ("A;B;C\n1;2;3\n", r"missing: .*separated by ';': .* with: tr ',;' '\.,' < FILE > NEW\.csv"),
        ("A\tB\tC\n1\t2\t3\n", r"missing: .*separated by '\\t': "),
        ("A,B,C\n1,2,3\n\n4,,6\n", "presses.csv, line 4, column 'B': expected a charge in pC, got an empty cell"),
        ("A,B,C\n1,2,x\n", "line 2, column 'C': expected a charge in pC, got 'x'"),
        ("C,B,A\n1,nan,3\n", "line 2, column 'B': .* got 'nan'"),
        ("A,B,C\n1,2,-inf\n", "line 2, column 'C': .* got '-inf'"),
        ("A,B,C\n1,2,1e39\n", "line 2, column 'C': .* got '1e39'"),
        ("A,B,C\n1,1_0,3\n", "line 2, column 'B': .* got '1_0'"),
        ('A,B,C\n1,"2,5",3\n', "line 2, column 'B': .* got '2,5'; write a decimal point"),
        ("A,B,C\n1,2\n", "line 2: expected 3 cells as in the header, got 2"),
        ("A,B,C\n1,2,3,4\n", "line 2: expected 3 cells as in the header, got 4"),
    ],
)
def test_charges_that_are_refused(text, said):
    with pytest.raises(ChargeError, match=said):
        read(text)


def test_contacts_as_csv_with_flags(film, predictor):
    out = io.StringIO()
    contacts = predictor.predict_batch(film.charge_pC([1.0, 9.0, 9.0], [0.5, 0.0, 0.0], [1.0, 0.25, 99.0]))
    write_contacts(contacts, out, predictor.validity)
    header, *rows = (line.split(",") for line in out.getvalue().splitlines())
    assert header == [*Contacts._fields, "flags"]
    assert [row[-1] for row in rows] == ["", "outside", "outside beyond"]
    assert [float(value) for value in rows[0][:3]] == pytest.approx([1.0, 0.5, 1.0], abs=2e-6)
    assert [row[:-1] for row in rows] == [[f"{value:.6f}" for value in row] for row in np.column_stack(contacts)]


def test_contacts_as_records(film, predictor):
    charges = film.charge_pC([1.0, 9.0], [0.5, 0.0], [1.0, 0.25])
    first, second = (json.loads(record.to_json()) for record in table_records(charges, predictor))
    assert (first["x_mm"], first["contact"], first["flags"]) == (pytest.approx(1.0, abs=2e-6), True, [])
    assert second["flags"] == ["outside"]
    assert first["charge_pC"] == pytest.approx(dict(zip("ABC", charges[0], strict=True)), abs=1e-6)
    assert {key for key, value in first.items() if value is None} == {
        "timestamp", "t_device_us", "seq", "charge_raw_pC", "tare_pC", "latency_us",
    }  # fmt: skip
