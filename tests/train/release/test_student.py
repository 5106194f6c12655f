"""A student: small, near its teacher, and refused where it would be no student of it."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from isocharge.common.errors import DatasetError, ModelError, OutputExists
from isocharge.serve import Predictor, load_model
from isocharge.simulate import Circle, Sweep, load_sensor, read_dataset, run_sweep
from isocharge.train import FitConfig, NetworkConfig, TaughtScene, TrainingConfig, distil_model, train_model
from isocharge.train.release.student import MOST_PARAMETERS, parameters, student_config

SHORT = TrainingConfig(steps=800, misfit_steps=100, misfit_charges=2_000, batch=256)
TEACHER = FitConfig(NetworkConfig((48, 48, 48), (16, 16, 16)), SHORT)
STUDENT = FitConfig(NetworkConfig((24, 24), (16, 16), weights="int8"), SHORT)


@pytest.fixture(scope="module")
def teacher(dataset, tmp_path_factory):
    return train_model(dataset, tmp_path_factory.mktemp("models") / "teacher", TEACHER)


@pytest.fixture(scope="module")
def student(teacher, dataset, tmp_path_factory):
    return distil_model(teacher.folder, dataset, tmp_path_factory.mktemp("students") / "small", STUDENT)


def test_it_answers_as_its_teacher_does(teacher, student, dataset):
    charge_pC = dataset.samples.charge_pC[:2_000]
    mine, theirs = (Predictor(release.folder).predict_batch(charge_pC) for release in (student, teacher))
    apart = np.hypot(mine.x_mm - theirs.x_mm, mine.y_mm - theirs.y_mm)
    assert np.median(apart) < 0.15
    assert np.median(np.abs(mine.force_N / theirs.force_N - 1.0)) < 0.01
    wider = np.log(mine.x_std_mm / theirs.x_std_mm)  # by what it knows less well
    assert -0.05 < np.median(wider) < 0.4


def test_it_says_who_taught_it(student):
    assert load_model(student.folder).metadata.made_with["teacher"] == "teacher/1"
    assert "answers of `teacher/1`" in (student.folder / "card.md").read_text()


@pytest.mark.parametrize("electrodes", [3, 4, 8])
def test_the_size_is_that_of_the_file(electrodes):
    assert parameters(student_config().network, electrodes) <= MOST_PARAMETERS


def test_the_numbers_of_the_file_are_counted(student):
    graph = onnx.load(student.folder / "model.onnx").graph
    floats = [numpy_helper.to_array(each) for each in graph.initializer if each.data_type == onnx.TensorProto.FLOAT]
    layers = sum(each.size for each in floats if each.size > 1)
    assert layers == parameters(STUDENT.network, 3)


def test_a_student_that_is_too_large_is_refused(teacher, dataset, tmp_path):
    large = FitConfig(NetworkConfig((64, 64), (16, 16)), SHORT)
    with pytest.raises(ModelError, match=r"at most 6000 weights and biases.*make 7\d\d\d; take narrower layers"):
        distil_model(teacher.folder, dataset, tmp_path / "large", large)
    assert not (tmp_path / "large").exists()


def test_presses_on_another_sensor_are_refused(teacher, tmp_path):
    other = run_sweep(tmp_path / "presses", load_sensor("four-25um-biaxial"), (Circle(1e-3),), Sweep(samples=500))
    with pytest.raises(DatasetError, match="on the sensor of the model teacher/1, 'three-25um-biaxial', got presses"):
        distil_model(teacher.folder, read_dataset(other), tmp_path / "small", STUDENT)


def test_its_scene_is_what_the_teacher_knows(teacher, dataset):
    scene = TaughtScene.of(teacher.metadata)
    assert scene.sensor == dataset.sensor
    assert scene.probes == (Circle(1e-3),)
    assert scene.domain.radius_mm == pytest.approx(8.0, abs=1e-3)
    assert scene.domain.force_range_N == (0.05, 2.0)


def test_a_version_that_exists_stays(teacher, student, dataset):
    before = (student.folder / "model.onnx").read_bytes()
    with pytest.raises(OutputExists):
        distil_model(teacher.folder, dataset, student.folder.parent, STUDENT)
    assert (student.folder / "model.onnx").read_bytes() == before


def test_presses_of_a_model_of_measured_presses_are_not_simulated(teacher):
    about = load_model(teacher.folder).metadata
    assert TaughtScene.of(about).sensor.name == about.frame_id
    measured = replace(about, errors={**about.errors, "measured_presses": 40.0})
    with pytest.raises(ModelError, match="teacher/1 was trained on measured presses"):
        TaughtScene.of(measured)
