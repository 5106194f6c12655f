"""The report as a whole: built once, small, through the command; and what it refuses."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isocharge.cli.main import main
from isocharge.common.errors import DatasetError, ModelError, OutputExists
from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, run_sweep, write_dataset
from isocharge.train.data.domain import inner_radius
from isocharge.train.report import QUICK, write_report

ROOT = Path(__file__).parents[3]
MODEL = ROOT / "models" / "three-25um-biaxial" / "1"
STUDENT = ROOT / "models" / "three-25um-biaxial-student" / "1"
PICTURES = {"latency", "throughput", "memory", "maps", "force", "calibration", "noise", "effects"}


@pytest.fixture(scope="module")
def presses(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "presses"
    return run_sweep(folder, load_sensor("three-25um-biaxial"), (Circle(1e-3),), Sweep(samples=3000))


@pytest.fixture(scope="module")
def report(presses, tmp_path_factory):
    """(folder, record printed by --json, words on stderr)."""
    base = tmp_path_factory.mktemp("report")
    words = [
        "isocharge",
        "train",
        "report",
        str(presses),
        "-o",
        str(base / "out"),
        "--model",
        str(MODEL),
        "--student",
        str(STUDENT),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ISOCHARGE_CACHE", str(base / "cache"))
        patch.setattr(sys, "argv", [*words, "--quick", "--json"])
        printed = []
        patch.setattr("typer.echo", lambda text, err=False: printed.append((err, text)))
        with pytest.raises(SystemExit) as done:
            main()
    assert not done.value.code, printed
    record = json.loads(next(text for err, text in printed if not err))
    return base / "out", record, [text for err, text in printed if err]


def test_the_files_are_there(report):
    folder, record, _ = report
    assert json.loads((folder / "report.json").read_text("utf-8")) == record
    named = {file for section in record["datasets"] for files in section["pictures"].values() for file in files}
    assert {path.name for path in folder.iterdir()} == named | {"report.json", "report.md"}
    for name in named:
        data = (folder / name).read_bytes()
        assert data.startswith(b"\x89PNG" if name.endswith("png") else b"<?xml")
        assert len(data) > 5000


def test_the_record_has_every_part(report):
    _, record, _ = report
    assert record["format_version"] == 1
    assert all(record["machine"].values())
    assert {"cpu", "cores", "python", "numpy", "scikit-learn", "torch"} <= record["machine"].keys()
    (section,) = record["datasets"]
    assert set(section["pictures"]) == PICTURES
    assert section["limits"]["bayes"]["position_rms_mm"] > 0.05
    assert section["limits"]["cramer_rao"]["position_rms_mm"] > 0.05
    assert {case["group"] for case in section["cases"]} == {"noise", "probe", "gain", "dead electrode"}
    assert len(section["calibration"]["parts"]) == 7
    assert len(section["worst_regions"]) == 8


def test_every_method_is_in_the_table(report):
    folder, record, _ = report
    records = record["datasets"][0]["methods"]
    page = (folder / "report.md").read_text("utf-8")
    names = {entry["name"] for entry in records}
    assert {"released network", "released network, contact only", "network 16-16", "triangulation"} <= names
    assert {"linear band", "lookup table, nearest entry", "lookup table, interpolated", "Gauss-Newton"} <= names
    assert {"k-nearest neighbours", "polynomial ridge", "gradient boosting", "Gaussian process"} <= names
    assert records[0]["form"] == "Predictor"
    (student,) = (entry for entry in records if entry["name"] == "three-25um-biaxial-student")
    assert student["memory_bytes"] < 0.2 * records[0]["memory_bytes"]
    assert student["errors"]["position_rms_mm"] < 1.1 * records[0]["errors"]["position_rms_mm"]
    for entry in records:
        assert f"| {entry['name']}" in page.replace("**", "")
        assert entry["p50_us"] > 0
        assert entry["p95_us"] >= entry["p50_us"]
        assert entry["per_second"] > 0
        assert entry["memory_bytes"] > 0
        assert entry["choice"]
    assert [entry["name"] for entry in records if entry["force_given"]] == ["triangulation, force given"]
    assert any("latency" in entry["best_on"] for entry in records)


def test_no_method_beats_the_limit(report):
    _, record, _ = report
    for entry in record["datasets"][0]["methods"]:
        if not entry["force_given"] and entry["over_bayes"]:
            assert entry["over_bayes"] > 0.98, entry["label"]  # the same 128 presses; a thousand would give 1.00


def test_the_page_and_the_words(report):
    folder, record, words = report
    page = (folder / "report.md").read_text("utf-8")
    for heading in ("# Speed against error", "## three-25um-biaxial", "### Where the errors are", "### Choices"):
        assert heading in page
    assert "figures mean nothing" in page  # it is a quick one
    for sentence in record["datasets"][0]["verdict"]["sentences"]:
        assert sentence in page
        assert any(sentence in said for said in words)
    for files in record["datasets"][0]["pictures"].values():
        assert f"({files[0]})" in page
    assert "isocharge train report" in page
    assert "None" not in page
    assert "nan" not in page


def test_noise_makes_it_worse_and_alarms_ring(report):
    _, record, _ = report
    cases = record["datasets"][0]["cases"]
    noise = [case["errors"]["released network"]["position_rms_mm"] for case in cases if case["group"] == "noise"]
    assert noise == sorted(noise)
    assert all(case["alarms_percent"] > 90 for case in cases if case["group"] == "dead electrode")


def test_an_existing_folder_is_left_alone(presses, tmp_path):
    with pytest.raises(OutputExists):
        write_report(tmp_path, [(read_dataset(presses), MODEL)], QUICK)
    assert list(tmp_path.iterdir()) == []


def test_a_model_of_another_layout(tmp_path, presses):
    dataset = read_dataset(presses)
    other = replace(dataset, sensor=load_sensor("three-25um-uniaxial"))
    with pytest.raises(ModelError, match=r"expected the dataset's sensor 'three-25um-uniaxial'.*another piezo"):
        write_report(tmp_path / "out", [(other, MODEL)], QUICK)
    assert list(tmp_path.iterdir()) == []


def test_presses_that_the_model_does_not_know(tmp_path, presses):
    dataset = read_dataset(presses)
    stronger = replace(dataset.samples, force_N=2.0 * dataset.samples.force_N)
    wider = replace(dataset, samples=stronger, manifest={"solver": dataset.manifest["solver"]})
    with pytest.raises(ModelError, match=r"knows forces from 0.05 to 2 N, the dataset reaches from 0.1001 to 3.996 N"):
        write_report(tmp_path / "out", [(wider, MODEL)], QUICK)


def test_one_position(tmp_path, presses):
    dataset = read_dataset(presses)
    samples = replace(dataset.samples, x_mm=np.ones(3000), y_mm=np.ones(3000))
    with pytest.raises(DatasetError, match="50 positions, got 3000 at 1"):
        write_report(tmp_path / "out", [(replace(dataset, samples=samples), MODEL)], QUICK)


def test_a_dataset_with_nan(tmp_path, presses):
    dataset = read_dataset(presses)
    charge = dataset.samples.charge_pC.copy()
    charge[17, 1] = np.nan
    with pytest.raises(DatasetError, match=r"row 17|sample 17"):
        write_dataset(tmp_path / "bad", dataset.sensor, [replace(dataset.samples, charge_pC=charge)], {})
    broken = replace(dataset, samples=replace(dataset.samples, charge_pC=charge))
    with pytest.raises(DatasetError, match="sample 17"):
        write_report(tmp_path / "out", [(broken, MODEL)], QUICK)


def test_the_disk_in_a_polygon():
    angle = 2.0 * np.pi * np.arange(64) / 64
    radius = 8.0 / np.cos(np.pi / 64)
    assert inner_radius([(radius * np.cos(a), radius * np.sin(a)) for a in angle]) == 8.0
    assert inner_radius([(-1.0, -2.0), (3.0, -2.0), (3.0, 5.0), (-1.0, 5.0)]) == 1.0


def test_as_many_models_as_datasets(presses, tmp_path, monkeypatch, capsys):
    words = ["isocharge", "train", "report", str(presses), "-o", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", [*words, "--model", str(MODEL), "--model", str(MODEL)])
    with pytest.raises(SystemExit) as done:
        main()
    assert done.value.code == 2
    assert "expected one model for each of 1 datasets, got 2" in capsys.readouterr().err
