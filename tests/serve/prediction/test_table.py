"""CSV of charges in any reasonable dress, and every unreasonable one refused with its line.

A record is one line of JSON that any parser takes, with the fields of the contract in their order.

The domain check against shapes whose inside is known without it.
"""

import io
import json

import numpy as np
import pytest

from isocharge.common.errors import ChargeError
from isocharge.serve import Contact, Contacts, Predictor, Validity, read_charges, table_records, write_contacts
from isocharge.serve.model.contact import MISFIT_LIMIT, disk_corners, inside_polygon

NAMES = ("A", "B", "C")


@pytest.fixture
def read(tmp_path):
    """Read the charges of a text as a file `presses.csv`."""

    def read(text):
        path = tmp_path / "presses.csv"
        path.write_bytes(text.encode())
        return read_charges(path, NAMES)

    return read


EXPORTS = {
    "Excel in German": "\ufeffx_mm;y_mm;force_N;A;B;C\r\n2;-6;0,2;502,3;244,8;215,8\r\n2;4;0,5;423,2;695,6;507,8\r\n",
    "line with the separator": "sep=;\r\nx_mm;A;B;C\r\n2;502.3;244.8;215.8\r\n2;423.2;695.6;507.8\r\n",
    "tabs": "x_mm\tforce_N\tA\tB\tC\n2\t0.2\t502.3\t244.8\t215.8\n2\t0.5\t423.2\t695.6\t507.8\n",
    "MATLAB writetable": "x_mm|A|B|C\n2|502.3|244.8|215.8\n2|423.2|695.6|507.8\n",
    "LabVIEW with three decimals": "t\tA\tB\tC\n0,000\t502,300\t244,800\t215,800\n1,000\t423,200\t695,600\t507,800\n",
    "LabVIEW measurement": "LabVIEW Measurement\t\nWriter_Version\t2\nDecimal_Separator\t,\n***End_of_Header***\t\n\t\n"
    "Channels\t3\t\t\t\nSamples\t2\t2\t2\t\n***End_of_Header***\t\t\t\t\nX_Value\tA\tB\tC\tComment\n"
    "0,000000\t502,300000\t244,800000\t215,800000\t\n0,001000\t423,200000\t695,600000\t507,800000\t\n",
    "pandas": ",x_mm,A,B,C\n0,2,502.3,244.8,215.8\n1,2,423.2,695.6,507.8\n",
    "pandas with decimal commas": 'A,B,C\n"502,3","244,8","215,8"\n"423,2","695,6","507,8"\n',
    "points and three decimals": "A,B,C\n502.300,244.800,215.800\n423.200,695.600,507.800\n",
    "pandas in German": ";A;B;C\n0;5,023e+02;2,448e+02;2,158e+02\n1;4,232e+02;6,956e+02;5,078e+02\n",
    "units of names, too": "of;t;A;B;C\nname;s;[pC];[pC];[pC]\nP1;0;502,3;244,8;215,8\nP2;1;423,2;695,6;507,8\n",
    "blank lines and comments": '# of "today\n\n A , B,C \n502.3, 244.8,215.8,,\n  # 7,8,9\n,,\n4232e-1,695.6,507.8\n',
    "lines above the header": "Date: 2026-11-25, 10:00\n\nt;A;B;C\n10:00;502,3;244,8;215,8\n10:01;423,2;695,6;507,8\n",
}
"""Exports of other programs that contain the same charges."""


@pytest.mark.parametrize("export", EXPORTS)
def test_charges_are_the_same_from_the_exports_of_other_programs(export, read):
    np.testing.assert_array_equal(read(EXPORTS[export]), [[502.3, 244.8, 215.8], [423.2, 695.6, 507.8]])


def test_further_columns_are_ignored_with_a_message(caplog, read, tmp_path):
    np.testing.assert_array_equal(read("x_mm,A,B,,C,x_mm\nhere,1,2,?,3,\n"), [[1, 2, 3]])
    assert caplog.messages == [f"{tmp_path / 'presses.csv'}: ignored columns: ['x_mm', '', 'x_mm']"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"presses.csv: empty; expected a header with one column for each of the electrodes \('A', 'B', 'C'\)"),
        ("1,2,3\n4,5,6\n", r"missing: \['A', 'B', 'C'\]"),
        ("date;A;B;C\n28.11;1.064;832;629\n", "every number with the mark '.' may have .*separator of thousands"),
        ("A\tB\tC\n1,064\t832\t629\n", "every number with the mark ',' may have .*separator of thousands"),
        ("A,B,C\nnC,nC,nC\n1,2,3\n", "line 2, column 'A': expected a charge in pC, got 'nC'$"),
        ('A,B,C\n"1,064",832,629\n', "every number with the mark ',' may have .*separator of thousands"),
        ('A,B,C\n832.7,"1,064",1\n', "line 2, column 'B': .*got '1,064'; the decimal mark is '.'"),
        ("A;B;C\n832,7;1.064;1\n", r"column 'B': .*got '1\.064'; the decimal mark is ','"),
        ("A;B;C\n1.064,5;832,7;1\n", r"column 'A': .* got '1\.064,5'"),
        ("pC;nC;pC\nA;B;C\nA;B;C\n1;2;3\n", "line 3, column 'A': expected a charge in pC, got 'A'"),
        ("A;B;C\npC;nC;pC\n1;2;3\n", "line 2, column 'A': expected a charge in pC, got 'pC'"),
        ("A,B,C\n1,2,3\n\n4,,6\n", "presses.csv, line 4, column 'B': expected a charge in pC.*got an empty cell"),
        ("A,B,C\n1,1_0,3\n", "line 2, column 'B': .* got '1_0'"),
        ("A,B,c\n1,2,3\nA,B,C\n4,5,6\n", "rename 'c' to 'C'"),
        ("time,channel,value\n0,A,1\n0,B,2\n", r"got the header \['time', 'channel', 'value'\]"),
        (",".join(f"column {i}" for i in range(2000)), "expected at most 1,000 columns, got 2,000"),
        ("A" * 200_000, "line 1: not CSV text .field larger"),
        ("A,B," + "x" * 90_000, r"missing: \['C'\]"),
        ("A,B,C\n" + ",".join("1" * 20_000), "line 2: expected 3 cells"),
    ],
)
def test_wrong_charge_tables_are_refused_with_a_short_message(text, message, read):
    with pytest.raises(ChargeError, match=message) as caught:
        read(text)
    assert len(str(caught.value)) < 600


def test_rows_of_a_table_become_csv_and_records(film, predictor):
    """The last row does not exceed the noise: it has the force 0, and no position."""
    charge_pC = film.charge_pC([1.0, 9.0, 9.0, 0.0], [0.5, 0.0, 0.0, 0.0], [1.0, 0.25, 99.0, 0.0])
    expected = np.column_stack(predictor.predict_batch(charge_pC)).tolist()
    out = io.StringIO()
    write_contacts(charge_pC, predictor, out)
    header, *rows, untouched = out.getvalue().splitlines()
    assert header == ",".join(Contacts._fields[:7]) + ",flags"
    flags = ["", "outside", "outside beyond", ""]
    for row, values, words in zip(rows, expected, flags, strict=False):
        assert row.split(",") == [*(f"{value:.6f}" for value in values[:7]), words]
    assert untouched == ",,0.000000,,,,,"

    records = [json.loads(record.to_json()) for record in table_records(charge_pC.tolist(), predictor)]
    assert [record["contact"] for record in records] == [True, True, True, False]
    assert [" ".join(record["flags"]) for record in records] == flags
    assert records[1]["charge_pC"] == pytest.approx(dict(zip("ABC", charge_pC[1], strict=True)), abs=1e-6)
    assert [records[1][name] for name in Contacts._fields] == pytest.approx(expected[1], abs=1e-6)
    absent = {"timestamp", "t_device_us", "seq", "charge_raw_pC", "tare_pC", "latency_us"}
    assert {name for name, value in records[0].items() if value is None} == absent
    assert {name for name, value in records[3].items() if value is None} == absent | {*Contacts._fields} - {"force_N"}
    assert records[3]["force_N"] == 0.0


GOOD = Contact(1.0, -2.0, 0.5, 0.1, 0.1, 0.01, 0.3)


def test_inside_polygon_of_a_notched_square():
    corners = np.array([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4], [0, 0]], dtype=float)
    inside = inside_polygon(np.array([2.0, 2.0, 0.5, 3.5, -1.0]), np.array([0.5, 2.0, 2.0, 2.0, 0.0]), corners)
    assert inside.tolist() == [True, False, True, True, False]


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({}, ()),
        ({"x_mm": 8.1}, ("outside",)),
        ({"force_N": 0.04}, ("outside",)),
        ({"force_N": 0.8}, ()),
        ({"force_N": 0.81}, ("stress",)),
        ({"force_N": 2.1}, ("outside", "stress")),
        ({"misfit": MISFIT_LIMIT * 1.01}, ("misfit",)),
        ({"force_N": 6.1}, ("outside", "beyond", "stress")),
        ({"x_mm": 15.0, "y_mm": -20.0}, ("outside", "beyond")),
        ({"x_mm": 3e38, "force_N": 0.0}, ("outside", "beyond")),
        ({"force_N": 55_088.0, "misfit": 826.0}, ("outside", "beyond", "misfit", "stress")),
    ],
)
def test_flags_outside_beyond_misfit_and_stress(film, changes, flags):
    """The film yields at 0.8 N."""
    validity = Validity.of(film.metadata(yield_force_N=0.8))
    contact = GOOD._replace(**changes)
    assert validity.flags(contact) == flags
    assert validity.batch_flags(Contacts(*np.float32([contact]).T)) == [flags]


def test_only_a_disk_is_described_by_its_radius():
    for step, text in ((1, "up to 8 mm from the centre"), (16, "from (-8.01, -8.01) to (8.01, 8.01) mm")):
        assert Validity(disk_corners(8.0)[::step], (0.05, 2.0)).area_text == text


def test_contacts_as_whole_numbers():
    assert np.asarray(Contacts(*[[1.5]] * 10), int).sum() == 10


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-uniaxial"])
def test_absurd_charges_are_always_flagged(name):
    """Charges of any size and sign: none that no press can give passes as one."""
    predictor, rng = Predictor(name), np.random.default_rng(0)
    size = (20_000, len(predictor.metadata.electrodes))
    charge_pC = 10 ** rng.uniform(-1, 10, size) * rng.choice([1, 1, -1], size)
    charge_pC[:100] = 10 ** rng.uniform(5, 10, (100, 1))  # the same on all electrodes
    flags = predictor.validity.batch_flags(predictor.predict_batch(charge_pC))
    impossible = (charge_pC < 1.0).any(axis=1) | (charge_pC > 1e4).any(axis=1)  # 3,900 pC: 1 N on an electrode
    assert all(words for words, wrong in zip(flags, impossible, strict=True) if wrong)
    assert all("beyond" in words for words in flags[:100])


def test_flags_of_one_contact_equal_those_in_a_batch():
    """One contact takes a short cut where it is well inside; it must not show."""
    rng = np.random.default_rng(0)
    square = Validity(np.array([[-4.0, -3.0], [6.0, -3.0], [6.0, 5.0], [-4.0, 5.0]]), (0.05, 2.0))
    away = Validity(square.corners_mm + 20.0, (0.05, 2.0))
    for x, y, force, misfit in zip(*rng.uniform(-8, 8, (2, 500)), *rng.uniform(0, [[2.5], [6]], (2, 500)), strict=True):
        contact = Contact(x, y, force, 0.1, 0.1, 0.01, misfit)
        for domain in (square, away):
            batch = Contacts(*np.array(contact)[:, np.newaxis])
            assert domain.flags(contact) == domain.batch_flags(batch)[0]
    assert (square.inscribed_radius_squared_mm2, away.inscribed_radius_squared_mm2) == (9.0, 0.0)
