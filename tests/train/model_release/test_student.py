"""A student: small, near its teacher, and refused where it would be no student of it."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from isocharge.common.errors import DatasetError, ModelError
from isocharge.serve import Predictor
from isocharge.simulate import Circle, load_sensor
from isocharge.train import FitConfig, NetworkConfig, StudentCase, TrainingConfig, fit, release, student_data

STUDENT = FitConfig(
    network=NetworkConfig(hidden=(24, 24), misfit_hidden=(16, 16), weights="int8"),
    training=TrainingConfig(steps=400, misfit_steps=50, misfit_charges=1_000, batch=256),
)


@pytest.fixture(scope="module")
def teacher(fitted, tmp_path_factory):
    return release(fitted, tmp_path_factory.mktemp("models") / "teacher")


@pytest.fixture(scope="module")
def student(teacher, dataset, tmp_path_factory):
    return release(fit(student_data(teacher.folder, dataset), STUDENT), tmp_path_factory.mktemp("students") / "small")


def test_it_answers_as_its_teacher_does_and_names_it(teacher, student, dataset):
    charge = dataset.samples.charge_pC[:2_000]
    mine, theirs = (Predictor(model.folder).predict_batch(charge) for model in (student, teacher))
    apart = np.hypot(mine.x_mm - theirs.x_mm, mine.y_mm - theirs.y_mm)
    assert np.median(apart) < 0.15
    assert np.median(np.abs(mine.force_N / theirs.force_N - 1.0)) < 0.01
    wider = np.log(mine.x_std_mm / theirs.x_std_mm)  # by what it knows less well
    assert -0.05 < np.median(wider) < 0.4
    assert student.metadata.made_with["teacher"] == "teacher/1"
    assert "answers of `teacher/1`" in (student.folder / "card.md").read_text()


def test_presses_on_another_sensor_are_refused(teacher, dataset):
    other = replace(dataset, sensor=load_sensor("four-25um-biaxial"))
    with pytest.raises(DatasetError, match="on the sensor of the model teacher/1, 'three-25um-biaxial', got presses"):
        student_data(teacher.folder, other)


def test_its_case_is_what_the_teacher_knows(teacher, dataset):
    case = StudentCase.of(teacher.metadata)
    assert case.sensor == dataset.sensor
    assert case.probes == (Circle(1.0),)
    assert case.domain.radius == pytest.approx(8.0, abs=1e-3)
    assert case.domain.force_range == (0.05, 2.0)
    measured = structs.replace(teacher.metadata, errors={**teacher.metadata.errors, "measured_presses": 40.0})
    with pytest.raises(ModelError, match="teacher/1 was trained on measured presses"):
        StudentCase.of(measured)
