"""The report as a whole: built once, small, through the command; what it refuses; that it goes on after a kill."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from isocharge.cli.main import main
from isocharge.common.errors import DatasetError, ModelError, OutputExists
from isocharge.serve import find_model
from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, run_sweep
from isocharge.train.report import QUICK, build, write_report

NAME = "three-25um-biaxial"
PICTURES = {"latency", "throughput", "memory", "maps", "force", "calibration", "noise", "effects"}
METHODS = {
    "released network",
    "released network, contact only",
    "three-25um-biaxial-student",
    "three-25um-biaxial-student, contact only",
    "triangulation",
    "triangulation, force given",
    "linear band",
    "lookup table, nearest entry",
    "lookup table, interpolated",
    "k-nearest neighbours",
    "polynomial ridge",
    "gradient boosting",
    "Gaussian process",
    "Gauss-Newton",
    "network 16-16",
}


@pytest.fixture(scope="module")
def presses(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "presses"
    return run_sweep(folder, load_sensor(NAME), (Circle(1.0),), Sweep(samples=3000))


@pytest.fixture(scope="module")
def report(presses, tmp_path_factory):
    """(folder, record printed by --json, text on stderr)."""
    folder, printed = tmp_path_factory.mktemp("report") / "out", []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            sys, "argv", ["isocharge", "train", "report", str(presses), "-o", str(folder), "--quick", "--json"]
        )
        patch.setattr("typer.echo", lambda text, err=False: printed.append((err, text)))
        with pytest.raises(SystemExit) as done:
            main()
    assert not done.value.code, printed
    return folder, json.loads(next(text for err, text in printed if not err)), [text for err, text in printed if err]


def test_the_files_and_the_record_are_whole(report):
    folder, record, _ = report
    assert json.loads((folder / "report.json").read_text("utf-8")) == record
    (section,) = record["datasets"]
    assert set(section["pictures"]) == PICTURES
    named = {file for files in section["pictures"].values() for file in files}
    assert {path.name for path in folder.iterdir()} == named | {"report.json", "report.md"}
    assert all((folder / name).stat().st_size > 5000 for name in named)
    assert {"cpu", "cores", "python", "numpy", "scikit-learn", "torch"} <= record["machine"].keys()
    assert {case["group"] for case in section["cases"]} == {"noise", "probe", "gain", "dead electrode"}
    assert len(section["calibration"]["parts"]) == 7
    assert len(section["worst_regions"]) == 8


def test_every_method_is_in_the_table_and_none_beats_the_limit(report):
    folder, record, said = report
    (section,) = record["datasets"]
    page, methods = (folder / "report.md").read_text("utf-8"), {entry["name"]: entry for entry in section["methods"]}
    assert set(methods) == METHODS
    for name, entry in methods.items():
        assert f"| {name}" in page.replace("**", "")
        assert min(entry["p50_us"], entry["per_second"], entry["memory_bytes"]) > 0
        assert entry["p95_us"] >= entry["p50_us"]
        assert entry["choice"]
        if not entry["force_given"] and entry["over_bayes"]:
            assert entry["over_bayes"] > 0.98, name  # the same 128 presses; a thousand would give 1.00
    released, student = section["methods"][0], methods["three-25um-biaxial-student"]
    assert student["memory_bytes"] < 0.2 * released["memory_bytes"]
    assert student["errors"]["position_rms_mm"] < 1.1 * released["errors"]["position_rms_mm"]
    assert any("latency" in entry["best_on"] for entry in methods.values())
    assert "figures mean nothing" in page  # it is a quick one
    assert not {"None", "nan"} & set(page.replace("|", " ").split())
    for sentence in section["verdict"]["sentences"]:
        assert sentence in page
        assert any(sentence in line for line in said)
    assert all(f"({files[0]})" in page for files in section["pictures"].values())


def test_noise_makes_it_worse_and_alarms_ring(report):
    cases = report[1]["datasets"][0]["cases"]
    noise = [case["errors"]["released network"]["position_rms_mm"] for case in cases if case["group"] == "noise"]
    assert noise == sorted(noise)
    assert all(case["alarms_percent"] > 90 for case in cases if case["group"] == "dead electrode")


def test_a_killed_report_goes_on_with_what_it_solved(presses, tmp_path, monkeypatch):
    subjects, solved = [(read_dataset(presses), find_model(NAME))], []

    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(build, "fit_all", stop)
        with pytest.raises(KeyboardInterrupt):
            write_report(tmp_path / "out", subjects, QUICK)
    kept = sorted((tmp_path / "out.part" / "parts").glob("*.npy"))
    assert kept
    with monkeypatch.context() as patch:
        patch.setattr(build, "fit_all", stop)
        before = [path.stat().st_mtime_ns for path in kept]
        with pytest.raises(KeyboardInterrupt):
            write_report(tmp_path / "out", subjects, QUICK)
        solved = [path.stat().st_mtime_ns for path in kept]
    assert solved == before
    with pytest.raises(OutputExists, match="other settings"):
        write_report(tmp_path / "out", subjects, replace(QUICK, seed=1))


def test_what_a_report_cannot_judge_is_refused(presses, tmp_path):
    dataset, model = read_dataset(presses), find_model(NAME)
    samples, solver = dataset.samples, {"solver": dataset.manifest["solver"]}
    charge = samples.charge_pC.copy()
    charge[17, 1] = np.nan
    stronger = replace(dataset, samples=replace(samples, force_N=2.0 * samples.force_N), manifest=solver)
    one_place = replace(dataset, samples=replace(samples, x_mm=np.ones(3000), y_mm=np.ones(3000)))
    for case, error, message in [
        (replace(dataset, sensor=load_sensor("three-25um-uniaxial")), ModelError, "with another piezo"),
        (stronger, ModelError, r"knows forces from 0.05 to 2 N, the dataset reaches from 0.1001 to 3.996 N"),
        (one_place, DatasetError, "50 positions, got 3000 at 1"),
        (replace(dataset, samples=replace(samples, charge_pC=charge)), DatasetError, "sample 17"),
    ]:
        with pytest.raises(error, match=message):
            write_report(tmp_path / "out", [(case, model)], QUICK)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputExists):
        write_report(tmp_path, [(dataset, model)], QUICK)


def test_as_many_models_as_datasets(presses, tmp_path, command):
    words = ("train", "report", presses, "-o", tmp_path / "out", "--model", NAME, "--model", NAME)
    code, _, err = command(*words)
    assert (code, "expected one model for each of 1 datasets, got 2" in err) == (2, True)
