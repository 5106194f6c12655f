"""Outputs by the form of their target, those of other packages among them."""

import csv
import re
import sys
from contextlib import nullcontext
from itertools import repeat
from pathlib import Path
from types import SimpleNamespace

import pytest

from boards import interrupt
from isocharge.common.errors import InputError, OutputError, OutputExists, PluginError
from isocharge.serve.outputs.output import OutputContext, OutputKind
from isocharge.serve.outputs.targets import Outputs, output_kind

ELECTRODES = ("A", "B")

live_and_replayed = pytest.mark.parametrize("is_live", [True, False])


def context(**changes):
    return OutputContext(**({"electrodes": ELECTRODES} | changes))


@pytest.mark.parametrize(
    ("target", "form"),
    [
        ("json", "json"),
        ("csv", "csv"),
        ("a/touch.jsonl", "FILE.jsonl"),
        ("touch.csv", "FILE.csv"),
        ("touch.mcap", "FILE.mcap"),
        ("touch.ros2.mcap", "FILE.ros2.mcap"),
        ("udp://127.0.0.1:9870", "udp://HOST:PORT"),
        ("udp://127.0.0.1:9870/x.csv", "udp://HOST:PORT"),
    ],
)
def test_form_of_a_target_chooses_the_output(target, form):
    assert output_kind(target).form == form


@pytest.mark.parametrize(
    ("targets", "message"),
    [
        *(
            ([target], r"expected one of the forms json, csv, FILE\.jsonl")
            for target in (
                "touch.txt",
                "",
                "tcp://127.0.0.1:9",
                "JSON",
                "touch",
                "mqtt://h/x.csv",
                "s3://h/x.ros2.mcap",
            )
        ),
        (["json", "csv"], "at most one on standard output"),
    ],
)
def test_wrong_targets_are_refused(targets, message):
    with pytest.raises(InputError, match=message):
        Outputs(targets, context())


@live_and_replayed
def test_same_records_go_to_every_output(record, tmp_path, is_live):
    records = [record(seq=number, charge_pC={"A": 1.0, "B": 2.0}) for number in range(50)]
    printed = []
    json_path, csv_path = tmp_path / "touch.jsonl", tmp_path / "touch.csv"
    targets = ["json", str(json_path), str(csv_path)]
    with Outputs(targets, context(is_live=is_live, write_stdout=printed.append)) as outputs:
        for one in records:
            outputs.write(one)
    text = "".join(one.to_json() + "\n" for one in records)
    assert ("".join(printed), json_path.read_text("utf-8")) == (text, text)
    with csv_path.open(newline="") as file:
        assert [int(row["seq"]) for row in csv.DictReader(file)] == list(range(50))
    assert outputs.not_written == {}


@live_and_replayed
def test_a_stream_that_is_stopped_keeps_its_files_and_a_replay_leaves_none(record, tmp_path, is_live):
    names = ["a.jsonl", "b.csv", "c.mcap"]
    outputs = Outputs([str(tmp_path / name) for name in names], context(is_live=is_live)).__enter__()
    outputs.write(record())
    outputs.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert sorted(path.name for path in tmp_path.iterdir()) == (names if is_live else [])
    assert outputs.has_incomplete_file != is_live


@live_and_replayed
@pytest.mark.parametrize(
    ("name", "message"),
    [("b.csv", r"b\.csv is already there"), ("no/a.csv", r"a\.csv cannot be written: No such")],
)
def test_file_that_exists_or_has_no_folder_is_an_error_and_nothing_else_is_left(tmp_path, name, message, is_live):
    (tmp_path / "b.csv").write_text("mine")
    targets = [str(tmp_path / "a.jsonl"), str(tmp_path / name)]
    with pytest.raises((OutputError, OutputExists), match=message), Outputs(targets, context(is_live=is_live)):
        pass
    assert (tmp_path / "b.csv").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["b.csv"]


def raise_error(*_):
    raise RuntimeError("not open")


def added(write=lambda _: None, close=lambda: None):
    """Return an output of another package."""
    return SimpleNamespace(write=write, close=close)


@pytest.fixture
def add_kind(monkeypatch):
    """Return a function that adds a kind of output, as an installed package does."""

    def add(accepts, opened):
        kind = OutputKind(form="added", accepts=accepts, open=lambda *_: opened)
        entry_point = SimpleNamespace(name="mine", value="mine:KIND", load=lambda: kind)
        monkeypatch.setattr("isocharge.serve.outputs.targets.entry_points", lambda group: [entry_point])  # noqa: ARG005

    return add


@pytest.fixture
def failing(add_kind):
    """An output that fails at once."""
    add_kind("broken".__eq__, added(raise_error, raise_error))


@live_and_replayed
def test_added_output_that_cannot_be_closed_spoils_no_other_output(record, tmp_path, add_kind, caplog, is_live):
    add_kind("mine".__eq__, added(close=raise_error))
    path = tmp_path / "touch.jsonl"
    outputs = Outputs([str(path), "mine"], context(is_live=is_live)).__enter__()
    outputs.write(record())
    message = "mine: the output mine:KIND failed (RuntimeError: not open)"
    with nullcontext() if is_live else pytest.raises(PluginError, match=re.escape(message)):
        outputs.__exit__(None, None, None)
    assert (message in caplog.text) == is_live
    assert path.read_text("utf-8") == record().to_json() + "\n"


def test_ctrl_c_while_an_output_closes_spoils_no_other_output(record, tmp_path, add_kind):
    add_kind("mine".__eq__, added(close=interrupt))
    path = tmp_path / "touch.jsonl"
    outputs = Outputs([str(path), "mine"], context()).__enter__()
    outputs.write(record())
    with pytest.raises(KeyboardInterrupt):
        outputs.__exit__(None, None, None)
    assert path.read_text("utf-8") == record().to_json() + "\n"
    assert outputs.not_written == {"mine": None}  # the command must not report success


@live_and_replayed
def test_full_disk_below_standard_output_is_an_error_with_the_target(record, is_live):
    """The error is raised only once, so that a command can print its summary after it has closed the outputs."""
    with Path("/dev/full").open("wb", buffering=0) as full:
        properties = context(is_live=is_live, write_stdout=lambda text: full.write(text.encode()))
        outputs = Outputs(["json"], properties).__enter__()
        with pytest.raises(OutputError, match="json cannot be written: No space left on device"):
            any(map(outputs.write, repeat(record())))  # until the error
        outputs.close()


@pytest.mark.usefixtures("failing")
def test_output_that_fails_does_not_end_the_live_stream(record, caplog):
    printed = []
    targets = ["json", "broken"]
    with Outputs(targets, context(is_live=True, write_stdout=printed.append)) as outputs:
        for number in range(100):
            outputs.write(record(seq=number))
    assert len(printed) == 100
    assert outputs.not_written == {"broken": None}
    assert "stopped (broken: the output mine:KIND failed (RuntimeError: not open); correct or uninsta" in caplog.text


@pytest.mark.parametrize(
    "load", [raise_error, sys.exit, object, lambda: OutputKind("added", bool, lambda *_: added(raise_error))]
)
def test_added_output_that_fails_is_an_error_with_its_entry_point(record, monkeypatch, load):
    find = lambda group: [SimpleNamespace(value="mine:KIND", load=load)]  # noqa: ARG005, E731
    monkeypatch.setattr("isocharge.serve.outputs.targets.entry_points", find)
    message = r"a\.x: the output mine:KIND failed \(.+\); correct or uninstall its package"
    with pytest.raises(PluginError, match=message), Outputs(["a.x"], context()) as outputs:
        outputs.write(record())
