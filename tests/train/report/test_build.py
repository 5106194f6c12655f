"""The report as a whole, built once, small; what it refuses; that it goes on after a kill."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from isocharge.cli.train import report as report_command
from isocharge.common.errors import DatasetError, ModelError, OutputExists
from isocharge.serve import find_model
from isocharge.simulate import Sweep, load_sensor
from isocharge.simulate.dataset.sweep import write_sweep
from isocharge.train.report import QUICK, build, case, write_report
from isocharge.train.report.methods import fit_all

pytestmark = pytest.mark.timeout(900)  # every method and every picture in one fixture

NAME = "three-25um-biaxial"
SMALL = replace(QUICK, presses=128, learn_from=600, steps=30, batch=64, seconds=1e-3, draws=2, limited=64, shapes=())
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
def report(dataset, film, spline, tmp_path_factory):
    """(folder, section of the record, page) of a report that was killed and went on with the limits that it had.

    The film is solved already.
    """
    folder, parts = tmp_path_factory.mktemp("report") / "out", []

    def go_on(settings=SMALL):
        students = [find_model(f"{NAME}-student")]
        return write_report(folder, [(dataset, find_model(NAME))], settings, students=students)

    def fit(*arguments):
        files = (folder.parent / "out.part" / "parts").glob("*.npy")
        parts.append({path.name: path.stat().st_mtime_ns for path in files})
        if len(parts) == 1:
            raise KeyboardInterrupt
        return fit_all(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "fit_all", fit)
        patch.setattr(case, "solve_maps", lambda *_, **__: (film,))
        patch.setattr(build.ChargeSpline, "of", lambda _: spline)
        with pytest.raises(KeyboardInterrupt):
            go_on()
        with pytest.raises(OutputExists, match="other settings"):
            go_on(replace(SMALL, seed=1))
        record = go_on()
    assert parts[0]
    assert parts[1] == parts[0]  # nothing was computed again
    assert json.loads((folder / "report.json").read_text("utf-8")) == json.loads(json.dumps(record))
    (section,) = record["datasets"]
    return folder, section, (folder / "report.md").read_text("utf-8")


def test_the_files_are_whole(report):
    folder, section, page = report
    assert section["pictures"] == {name: [f"{NAME}-{name}.png", f"{NAME}-{name}.svg"] for name in PICTURES}
    named = {file for files in section["pictures"].values() for file in files}
    assert {path.name for path in folder.iterdir()} == named | {"report.json", "report.md"}
    assert all((folder / name).stat().st_size > 5000 for name in named)
    assert all(f"({files[0]})" in page for files in section["pictures"].values())
    assert not {"None", "nan"} & set(page.replace("|", " ").split())


def test_every_method_is_in_the_table_and_none_beats_the_limit(report):
    _, section, page = report
    methods = {entry["name"]: entry for entry in section["methods"]}
    assert set(methods) == METHODS
    for name, entry in methods.items():
        row = rf"^\| {re.escape(name)}.* \| {entry['errors']['position_rms_mm']:.3g} \|"
        assert re.search(row, page.replace("**", ""), re.MULTILINE)
        assert 0.0 < entry["p50_us"] <= entry["p99_us"]
        assert entry["per_second"] > 0.0
        assert entry["choice"]
        if not entry["force_given"] and entry["over_bayes"]:
            assert entry["over_bayes"] > 0.95, name  # the same 64 presses; a thousand would give 1.00
    released, student = section["methods"][0], methods["three-25um-biaxial-student"]
    assert student["memory_bytes"] < 0.2 * released["memory_bytes"]
    assert student["errors"]["position_rms_mm"] < 1.15 * released["errors"]["position_rms_mm"]
    assert any("latency" in entry["best_on"] for entry in methods.values())
    assert all(said in page for said in (*section["verdict"]["sentences"], "every electrode off by 1 % rms"))


def test_noise_makes_it_worse_and_alarms_ring(report):
    cases = report[1]["cases"]
    noise = [case["errors"]["released network"]["position_rms_mm"] for case in cases if case["group"] == "noise"]
    assert noise == sorted(noise)
    assert all(case["alarms_percent"] > 90 for case in cases if case["group"] == "dead electrode")
    levels, coverage = report[1]["calibration"].values()
    assert 0.55 < coverage["x"][levels.index(0.7)] < 0.85


@pytest.mark.slow
def test_the_command_says_and_prints_what_it_measured(film, tmp_path, command):
    """With a probe that the model does not expect."""
    folder = write_sweep(tmp_path / "presses", (film,), Sweep(samples=3000))
    _, out, err = command("train", "report", folder, "-o", tmp_path / "out", "--quick", "--json")
    (section,) = json.loads(out)["datasets"]
    assert {case["group"] for case in section["cases"]} == {"noise", "probe", "gain", "dead electrode"}
    assert all(sentence in err for sentence in section["verdict"]["sentences"])


def test_what_a_report_cannot_judge_is_refused(dataset, tmp_path):
    model, samples, solver = find_model(NAME), dataset.samples, {"solver": dataset.manifest["solver"]}
    stronger = replace(dataset, samples=replace(samples, force_N=2.0 * samples.force_N), manifest=solver)
    beyond = np.arange(len(samples)) % 2  # what the model does not know, at many places
    within_one = replace(samples, x_mm=beyond * (20.0 + samples.x_mm), y_mm=beyond * samples.y_mm)
    for wrong, error, message in [
        (replace(dataset, sensor=load_sensor("three-25um-uniaxial")), ModelError, "with another piezo"),
        (stronger, ModelError, r"knows forces from 0.05 to 2 N, the dataset reaches from 0.1"),
        (
            replace(dataset, samples=within_one, manifest=solver),
            DatasetError,
            f"50 positions, got {SMALL.learn_from} at 1",
        ),
    ]:
        with pytest.raises(error, match=message):
            write_report(tmp_path / "out", [(wrong, model)], SMALL)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputExists):
        write_report(tmp_path, [(dataset, model)], SMALL)


def test_datasets_are_judged_by_the_models_of_their_sensors_unless_others_are_named(
    film, tmp_path, command, refused, monkeypatch
):
    asked, out = [], tmp_path / "out"
    monkeypatch.setattr(
        report_command, "write_report", lambda _, pairs, *__, **___: asked.extend(pairs) or {"datasets": []}
    )
    words = "train", "report", write_sweep(tmp_path / "presses", (film,), Sweep(samples=60)), "-o", out
    assert command(*words) == (0, "", f"{out / 'report.md'}\n")
    assert command(*words, "--model", f"{NAME}-student")[0] == 0
    assert [model for _, model in asked] == [find_model(NAME), find_model(f"{NAME}-student")]
    refused(*words, "--model", NAME, "--model", NAME, said="expected one model for each of 1 datasets, got 2")
