"""Tests of a whole report: its files, its results, and what it refuses."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from tests.train.measured import measured_presses, with_samples

from isocharge.cli.train import report as report_module
from isocharge.common.errors import DatasetError, ModelError, OutputExists, PressError
from isocharge.serve import find_model
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.model.model_folder import load_model
from isocharge.simulate import Circle, NoiseModel, load_sensor
from isocharge.train.data.contact_errors import contact_error_statistics
from isocharge.train.data.presses import LabelledPresses, dataset_of
from isocharge.train.report import QUICK, evaluation, page, write_report
from isocharge.train.report.evaluation import Method, measure_methods

NAME = "three-25um-biaxial"
SMALL = replace(QUICK, presses=64, seconds=1e-3)
METHODS = {  # further methods may be registered
    f"network `{NAME}/1`",
    "triangulation",
    "least squares, Gauss-Newton",
}


@pytest.fixture(scope="module")
def report(dataset, tmp_path_factory):
    """The folder, the record and the page of a report."""
    folder = tmp_path_factory.mktemp("report") / "out"
    record = write_report(folder, [(dataset, find_model(NAME))], SMALL)
    return folder, record, (folder / "report.md").read_text("utf-8")


def test_folder_contains_one_page_one_picture_and_the_record(report):
    folder, record, text = report
    assert {path.name for path in folder.iterdir()} == {"report.json", "report.md", "speed.png"}
    assert json.loads((folder / "report.json").read_text("utf-8")) == json.loads(json.dumps(record))
    assert (folder / "speed.png").stat().st_size > 5000
    assert text.count("](speed.png)") == 1
    assert not {"None", "nan"} & set(text.replace("|", " ").split())


def test_every_method_is_in_the_table_with_its_error_near_the_cramer_rao_limit(report):
    _, record, text = report
    (section,) = record["datasets"]
    limit = section["limits"]
    # The limit of a press is an rms error. It is no limit of the median of the errors, which is smaller.
    assert f"| {limit['position_rms_mm']:.3g} |  |  | {limit['force_rms_percent']:.3g} |" in text
    methods = {entry["name"]: entry for entry in section["methods"]}
    assert set(methods) >= METHODS
    for name, entry in methods.items():
        errors = entry["errors"]
        assert re.search(
            rf"^\| {NAME} \| {re.escape(name)}.* \| {errors['position_rms_mm']:.3g} \|", text, re.MULTILINE
        )
        assert 0.5 < errors["position_rms_mm"] / limit["position_rms_mm"] < 1.5
        assert entry["single_press_us"] > 0.0


def test_model_is_tested_on_positions_and_with_the_noise_of_its_own_training(dataset):
    metadata = load_model(find_model(NAME)).metadata
    own = dataset.sha256
    for sha256, hold_out, share in (("other", 0.02, 0.1), (own, 0.02, 0.02), (own, 0.5, 0.1), (own, None, 0.1)):
        trained = structs.replace(
            metadata,
            dataset_sha256=sha256,
            made_with={"config": {"training": {"hold_out": hold_out}}} if hold_out else {},
            noise=ModelNoise(name="bench", white_pC=3.0, gain=0.01),
        )
        presses, held_out = evaluation.split_presses(dataset, find_model(NAME), trained)
        assert len(held_out) / (len(held_out) + len(presses)) == pytest.approx(share, abs=0.005)
        assert evaluation.noise_of(trained) == NoiseModel("bench", 3.0, 0.01)


def test_presses_without_an_estimate_are_left_out_of_the_errors():
    truth = np.random.default_rng(2).uniform(0.5, 2.0, (10, 3))
    estimate = truth + 0.1
    estimate[3] = np.nan
    methods = [Method("most", "", lambda _: estimate), Method("none", "", lambda _: np.full((10, 3), np.nan))]
    most, none = measure_methods(methods, LabelledPresses(truth, truth), seconds=1e-4)
    assert most.answered == 0.9
    assert most.errors == contact_error_statistics(np.delete(estimate, 3, 0), np.delete(truth, 3, 0))
    assert (none.answered, none.errors) == (0.0, {})


def section_of(methods, *, is_measured=False, limits=()):
    """Return the section of methods with given errors, each a dictionary, on a film of 48 presses."""
    records = [evaluation.MethodRecord("method", "", 1.0, errors, 8.0) for errors in methods]
    return evaluation.Section("film", is_measured, [], 8.0, (0.05, 2.0), "", "", 48, 12, dict(limits), records, [])


def test_picture_has_a_panel_for_each_dataset_with_the_evaluated_model_as_a_star():
    methods = [{"position_rms_mm": 0.1}, {"position_rms_mm": 0.2}, {}]
    sections = [section_of(methods, limits={"position_rms_mm": 0.05}), section_of(methods)]
    simulated, measured = page.draw_speed(sections).axes
    *points, limit = simulated.lines
    assert [point.get_marker() for point in points] == ["*", "o"]
    assert [point.get_ydata()[0] for point in points] == [0.1, 0.2]
    assert limit.get_ydata()[0] == 0.05
    assert len(measured.lines) == 2


def test_page_does_not_describe_methods_that_are_left_out():
    for count, is_described in ((1, False), (2, True)):
        section = section_of(count * [{"position_rms_mm": 0.1}], is_measured=True)
        text = page.report_page([section], evaluation.QUICK, {}, "")
        assert ("Triangulation" in text) == ("fitted to the other 48 presses" in text) == is_described


def measured(dataset, forces_N):
    """Return 300 measured presses at one place, of which 260 have the second force."""
    contact = np.repeat([[1.0, 1.0, force_N] for force_N in forces_N], [40, 260], axis=0)
    return dataset_of(measured_presses(contact, np.full((300, 3), 500.0)), dataset.sensor, Circle(1.0))


UNSUITABLE = {
    "sensor": (lambda d: replace(d, sensor=load_sensor("three-25um-uniaxial")), NAME, "with another piezo"),
    "order of the electrodes": (
        lambda d: replace(d, sensor=replace(d.sensor, electrodes=d.sensor.electrodes[::-1])),
        NAME,
        "electrodes C, B, A, got a model with another electrodes .A, B, C.;",
    ),
    "forces": (
        lambda d: with_samples(d, force_N=100.0 * d.samples.force_N),
        NAME,
        "of its forces, 0.05 to 2 N, got none among 6000 presses",
    ),
    "forces of measured presses": (lambda d: measured(d, (1.0, 30.0)), NAME, "at least 50 presses .* got 40 of 300"),
}
"""Changes of the dataset, the model, and the message that refuses them."""


@pytest.mark.parametrize(("change", "model", "message"), UNSUITABLE.values(), ids=UNSUITABLE)
def test_unsuitable_datasets_and_models_are_refused(dataset, tmp_path, change, model, message):
    with pytest.raises((ModelError, DatasetError, PressError), match=message):
        write_report(tmp_path / "out", [(change(dataset), find_model(model))], SMALL)
    assert list(tmp_path.iterdir()) == []


def test_model_of_presses_alone_is_not_tested_on_its_own_presses(dataset):
    metadata = structs.replace(load_model(find_model(NAME)).metadata, sensor={"name": "pad"})
    with pytest.raises(ModelError, match="got a model of presses alone, which has learned from all presses"):
        evaluation.check_same_sensor(metadata, measured(dataset, (1.0, 1.0)))


def test_limit_of_an_inaccurate_series_is_left_out_with_the_reason(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "METHOD_BUILDERS", ())
    few = replace(dataset, samples=dataset.samples[np.arange(3_000)])
    record = write_report(tmp_path / "out", [(few, find_model(NAME))], SMALL)
    (section,) = record["datasets"]
    assert section["limits"] == {}
    (reason,) = section["left_out"]
    assert re.match(r"Cramér-Rao limit: .* 24\d\d presses has an error of 0\.\d+ % of a charge", reason)
    assert f"Left out: {reason}." in (tmp_path / "out" / "report.md").read_text("utf-8")
    monkeypatch.setattr(evaluation, "noise_of", lambda _: NoiseModel("larger", 30.0, 0.0))
    assert evaluation.evaluate_dataset(few, find_model(NAME), SMALL).limits


def test_existing_folder_is_refused(dataset, tmp_path):
    with pytest.raises(OutputExists):
        write_report(tmp_path, [(dataset, find_model(NAME))], SMALL)


def test_report_command_takes_the_model_of_the_sensor_unless_another_is_given(
    dataset_folder, tmp_path, command, refused, monkeypatch
):
    out = tmp_path / "out"
    evaluated_models = []

    def record_models(_, subjects, *__, **___):
        evaluated_models.extend(model for _, model in subjects)

    monkeypatch.setattr(report_module, "write_report", record_models)
    words = "train", "report", dataset_folder, "-o", out
    assert command(*words) == (0, "", f"{out / 'report.md'}\n")
    assert command(*words, "--model", f"{NAME}-student")[0] == 0
    assert evaluated_models == [find_model(NAME), find_model(f"{NAME}-student")]
    refused(*words, "--model", NAME, "--model", NAME, message="expected one model for each of 1 datasets, got 2")
    for option, value in (("--sensor", NAME), ("--probe", "circle:2.0")):
        refused(*words, option, value, message=f"contain sensor and probes; leave {option} out")
