"""Tests of a whole report: its files, its results, its resumption after an interruption, and what it refuses."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from isocharge.cli.train import report as report_module
from isocharge.common.errors import DatasetError, ModelError, OutputExists
from isocharge.serve import benchmark, find_model
from isocharge.simulate import Sweep, load_sensor
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train.report import QUICK, case, evaluation, write_report
from isocharge.train.report.methods import fit_all

pytestmark = pytest.mark.timeout(900)  # the fixture `report` runs every method and draws every picture

NAME = "three-25um-biaxial"
SMALL = replace(QUICK, presses=128, learn_from=600, steps=30, batch=64, seconds=1e-3, draws=2, limited=64, shapes=())
PICTURES = {"latency", "throughput", "memory", "maps", "force", "calibration", "noise", "effects"}
METHODS = {  # further methods may be registered
    "evaluated model",
    "evaluated model, contact only",
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
def report(dataset, film, spline, tmp_path_factory):
    """The folder, the section of the record and the page of a report that was interrupted and continued.

    The continued report uses the Bayes limit that the interrupted report has saved. The film is not solved again.
    """
    folder = tmp_path_factory.mktemp("report") / "out"
    saved_parts = []

    def write(settings=SMALL):
        students = [find_model(f"{NAME}-student")]
        return write_report(folder, [(dataset, find_model(NAME))], settings, students=students)

    def interrupt_first_fit(*arguments):
        files = (folder.parent / "out.part" / "parts").glob("*.npy")
        saved_parts.append({path.name: path.stat().st_mtime_ns for path in files})
        if len(saved_parts) == 1:
            raise KeyboardInterrupt
        return fit_all(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "fit_all", interrupt_first_fit)
        patch.setattr(benchmark, "ROUNDS", 2)
        patch.setattr(benchmark, "MIN_CALLS", 1)
        patch.setattr(case, "solve_maps", lambda *_, **__: (film,))
        patch.setattr(evaluation.ChargeSpline, "of", lambda _: spline)
        with pytest.raises(KeyboardInterrupt):
            write()
        with pytest.raises(OutputExists, match="other settings"):
            write(replace(SMALL, seed=1))
        record = write()
    parts_at_interruption, parts_after_resumption = saved_parts
    assert parts_at_interruption
    assert parts_after_resumption == parts_at_interruption
    assert json.loads((folder / "report.json").read_text("utf-8")) == json.loads(json.dumps(record))
    (section,) = record["datasets"]
    return folder, section, (folder / "report.md").read_text("utf-8")


def test_folder_contains_record_page_and_all_pictures(report):
    folder, section, page = report
    assert section["pictures"] == {name: [f"{NAME}-{name}.png", f"{NAME}-{name}.svg"] for name in PICTURES}
    picture_files = {file for files in section["pictures"].values() for file in files}
    assert {path.name for path in folder.iterdir()} == picture_files | {"report.json", "report.md"}
    assert all((folder / file).stat().st_size > 5000 for file in picture_files)
    assert all(f"({files[0]})" in page for files in section["pictures"].values())
    assert not {"None", "nan"} & set(page.replace("|", " ").split())


def test_every_method_is_in_the_table_and_none_is_better_than_the_bayes_limit(report):
    _, section, page = report
    methods = {entry["name"]: entry for entry in section["methods"]}
    assert set(methods) >= METHODS
    for name, entry in methods.items():
        row = rf"^\| {re.escape(name)}.* \| {entry['errors']['position_rms_mm']:.3g} \|"
        assert re.search(row, page.replace("**", ""), re.MULTILINE)
        assert 0.0 < entry["p50_us"] <= entry["p99_us"]
        assert entry["per_second"] > 0.0
        assert entry["choice"]
        if not entry["force_given"] and entry["over_bayes"]:
            assert entry["over_bayes"] > 0.95, name  # only 64 presses: the ratio has a statistical error
    assert any("latency" in entry["best_on"] for entry in methods.values())


def test_student_is_small_and_almost_as_accurate_as_its_teacher(report):
    section = report[1]
    methods = {entry["name"]: entry for entry in section["methods"]}
    teacher = methods["evaluated model"]
    student = methods[f"{NAME}-student"]
    assert student["memory_bytes"] < 0.2 * teacher["memory_bytes"]
    assert student["errors"]["position_rms_mm"] < 1.15 * teacher["errors"]["position_rms_mm"]


def test_no_model_is_called_released_because_it_may_be_a_model_of_the_user(report):
    folder, section, page = report
    assert f"evaluated model `{section['model']['label']}`" in page
    assert "released" not in page
    assert "released" not in (folder / "report.json").read_text("utf-8")


def test_page_contains_the_comparison_and_the_assumed_gain_errors(report):
    _, section, page = report
    assert section["verdict"]["sentences"]
    for sentence in section["verdict"]["sentences"]:
        assert sentence in page
    assert "independent errors of 1 % rms for every electrode" in page


def test_errors_grow_with_the_noise_and_dead_electrodes_give_alarms(report):
    results = report[1]["cases"]
    noise_results = [result for result in results if result["group"] == "noise"]
    errors_mm = [result["errors"]["evaluated model"]["position_rms_mm"] for result in noise_results]
    assert errors_mm == sorted(errors_mm)
    dead_electrode_results = [result for result in results if result["group"] == "dead electrode"]
    assert len(dead_electrode_results) == 3
    assert all(result["alarms_percent"] > 90 for result in dead_electrode_results)


def test_coverage_is_near_the_nominal_level(report):
    calibration = report[1]["calibration"]
    index = calibration["levels"].index(0.7)
    assert 0.55 < calibration["coverage"]["x"][index] < 0.85


@pytest.mark.slow
def test_report_command_prints_the_record_and_the_sentences(film, tmp_path, command):
    """The quick settings include a probe for which the model was not trained."""
    folder = write_sweep(tmp_path / "presses", (film,), Sweep(samples=3000))
    _, out, err = command("train", "report", folder, "-o", tmp_path / "out", "--quick", "--json")
    (section,) = json.loads(out)["datasets"]
    assert {result["group"] for result in section["cases"]} == {"noise", "probe", "gain", "dead electrode"}
    assert all(sentence in err for sentence in section["verdict"]["sentences"])


def test_dataset_of_another_sensor_is_refused(dataset, tmp_path):
    other_sensor = replace(dataset, sensor=load_sensor("three-25um-uniaxial"))
    with pytest.raises(ModelError, match="with another piezo"):
        write_report(tmp_path / "out", [(other_sensor, find_model(NAME))], SMALL)
    assert list(tmp_path.iterdir()) == []


def test_dataset_with_larger_forces_than_the_model_is_refused(dataset, tmp_path):
    samples = replace(dataset.samples, force_N=2.0 * dataset.samples.force_N)
    stronger = replace(dataset, samples=samples, manifest={"solver": dataset.manifest["solver"]})
    with pytest.raises(ModelError, match=r"forces from 0.05 to 2 N, for which .* a dataset with forces from 0.1"):
        write_report(tmp_path / "out", [(stronger, find_model(NAME))], SMALL)
    assert list(tmp_path.iterdir()) == []


def test_dataset_with_one_position_in_the_working_area_is_refused(dataset, tmp_path):
    """Every second press is moved to the centre; the others are moved out of the working area of the model."""
    samples = dataset.samples
    is_moved_out = np.arange(len(samples)) % 2
    moved = replace(samples, x_mm=is_moved_out * (20.0 + samples.x_mm), y_mm=is_moved_out * samples.y_mm)
    one_position = replace(dataset, samples=moved, manifest={"solver": dataset.manifest["solver"]})
    with pytest.raises(DatasetError, match=f"50 positions, got {SMALL.learn_from} at 1"):
        write_report(tmp_path / "out", [(one_position, find_model(NAME))], SMALL)
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_refused(dataset, tmp_path):
    with pytest.raises(OutputExists):
        write_report(tmp_path, [(dataset, find_model(NAME))], SMALL)


def test_report_command_takes_the_model_of_the_sensor_unless_another_is_given(
    film, tmp_path, command, refused, monkeypatch
):
    out = tmp_path / "out"
    evaluated_models = []

    def record_models(_, subjects, *__, **___):
        evaluated_models.extend(model for _, model in subjects)
        return {"datasets": []}

    monkeypatch.setattr(report_module, "write_report", record_models)
    words = "train", "report", write_sweep(tmp_path / "presses", (film,), Sweep(samples=60)), "-o", out
    assert command(*words) == (0, "", f"{out / 'report.md'}\n")
    assert command(*words, "--model", f"{NAME}-student")[0] == 0
    assert evaluated_models == [find_model(NAME), find_model(f"{NAME}-student")]
    refused(*words, "--model", NAME, "--model", NAME, message="expected one model for each of 1 datasets, got 2")
