"""All commands that read a file of presses give the same error messages for the same faults."""

import pyarrow
import pytest
from pyarrow.parquet import write_table

from isocharge.common.defaults import MAX_BATCH
from isocharge.serve import Predictor

COMMANDS = {
    "predict": ("serve", "predict", "four-25um-biaxial"),
    "check": ("serve", "check", "four-25um-biaxial"),
    "calibrate": ("train", "calibrate", "--sensor", "four-25um-biaxial", "-o", "film"),
    "fit alone": ("train", "fit", "-o", "models/pad"),
}
"""Words of the commands, to which the file is appended."""

PRESS = "1,2,0.5,100,200,300,400\n"


@pytest.fixture
def refuses(refused, tmp_path, monkeypatch):
    """Check that a command refuses a file, and that nothing but the file is left."""
    monkeypatch.chdir(tmp_path)

    def check(name, data, message, suffix="csv"):
        (tmp_path / f"p.{suffix}").write_bytes(data)
        refused(*COMMANDS[name], f"p.{suffix}", message=message)
        assert [path.name for path in tmp_path.iterdir()] == [f"p.{suffix}"]

    return check


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_in_utf_16(refuses, name):
    data = f"x_mm,y_mm,force_N,A,B,C,D\n{PRESS}".encode("utf-16")
    refuses(name, data, "p.csv, line 1: the byte 0xff is not text in UTF-8")


def test_presses_of_a_parquet_file_are_named_by_their_rows(command, tmp_path):
    """The check of a film names the presses that do not count by their rows, counted from 1 without a header."""
    contact_columns = {"x_mm": [2.0, 40.0], "y_mm": [0.0, 0.0], "force_N": [0.5, 0.5]}
    columns = contact_columns | {name: [500.0, 500.0] for name in "ABCD"}
    write_table(pyarrow.table(columns), tmp_path / "p.parquet")
    code, out, err = command("serve", "check", "four-25um-biaxial", tmp_path / "p.parquet")
    assert (code, err) == (1, "")
    assert out.split()[:2] == ["each:", "row"]
    assert "(row 2)" in out


def test_a_missing_column_of_a_training_is_named(refuses):
    refuses("fit alone", b"force_N,A,B,C,D\n1,100,200,300,400\n", "add the column 'x_mm', 'y_mm'")


def test_a_long_table_is_predicted_in_pieces(command, tmp_path, monkeypatch):
    """The memory must not grow with the number of presses that the model computes at the same time."""
    predict_batch = Predictor.predict_batch
    sizes = []

    def recorded(self, charge_pC):
        sizes.append(len(charge_pC))
        return predict_batch(self, charge_pC)

    monkeypatch.setattr(Predictor, "predict_batch", recorded)
    header = "A,B,C,D\n"
    (tmp_path / "p.csv").write_text(header + "500,500,500,500\n" * (MAX_BATCH + 1))
    (tmp_path / "empty.csv").write_text(header)
    _, out, _ = command(*COMMANDS["predict"], tmp_path / "p.csv")
    _, out_of_empty, _ = command(*COMMANDS["predict"], tmp_path / "empty.csv")
    assert sizes == [MAX_BATCH, 1, 0]
    names, *rows = out.splitlines()
    assert out_of_empty.splitlines() == [names]
    assert (len(rows), len(set(rows))) == (MAX_BATCH + 1, 1)
