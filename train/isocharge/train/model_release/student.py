"""Training data and settings of a student: a small network that learns the answers of a model.

A student has the inputs and outputs of the model and about 5,000 weights and biases, so it fits into the flash memory
of a microcontroller. The student learns the contacts and standard deviations that the model estimates. The misfits of
the student and of the model are both trained with distances that were computed exactly.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, ModelError
from isocharge.common.files import sha256_of
from isocharge.serve import ModelMetadata, Predictor
from isocharge.simulate import Dataset, Domain, Probe, Sensor, parse_probe
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train.model_release.evaluate import HELD_PRESSES
from isocharge.train.model_release.release import model_domain
from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig
from isocharge.train.training.source import Teacher, TrainingData


def student_config(weights: Literal["float32", "int8"] = "float32") -> FitConfig:
    """Return the settings of a student.

    Args:
        weights: Form of the weights between hidden layers.
    """
    return FitConfig(
        network=NetworkConfig(hidden=(30, 30), misfit_hidden=(34, 34), weights=weights),
        training=TrainingConfig(steps=16_000, misfit_steps=24_000, misfit_charges=80_000),
    )


@dataclass(frozen=True)
class StudentCase:
    """Sensor, probes and contacts of a model.

    These values define a simulation of presses that are distributed as in the training of the model.

    Attributes:
        sensor: Sensor of the model.
        probes: Probes of the model.
        domain: Working area and forces of the model.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: Domain

    @classmethod
    def of(cls, about: ModelMetadata) -> "StudentCase":
        """Return the case of a model from its metadata.

        Raises:
            ModelError: If the model was trained on measured presses, which cannot be simulated.
        """
        if HELD_PRESSES in about.errors:
            raise ModelError(
                f"{about.label} was trained on measured presses, and simulated presses of its sensor are not like "
                "those; distil a model of simulated presses, such as one of 'isocharge train calibrate'"
            )
        probes = tuple(parse_probe(notation) for notation in about.probes)
        return cls(sensor_from_dict(dict(about.sensor)), probes, model_domain(about))


def student_data(model: Path, dataset: Dataset) -> TrainingData:
    """Return the training data of a student, which are presses and the contacts that a model estimates for them.

    Args:
        model: Version folder of the model.
        dataset: Simulated presses on the model's sensor without noise, such as a sweep over its `StudentCase`.

    Raises:
        DatasetError: If the dataset is of another sensor, or a network cannot be trained on it.
    """
    predictor = Predictor(model)
    about = predictor.metadata
    if sensor_to_dict(dataset.sensor) != dict(about.sensor):
        raise DatasetError(
            f"expected presses on the sensor of the model {about.label}, {about.sensor['name']!r}, got presses on "
            f"{dataset.sensor.name!r}; simulate them on the model's own sensor"
        )

    def answer(charge: Array) -> tuple[Array, Array]:
        """Estimate the contacts (x, y, F) and their standard deviations, each of shape (n, 3), mm and N."""
        answers = predictor.predict_batch(charge)
        contact = np.stack([answers.x_mm, answers.y_mm, answers.force_N], axis=1)
        std = np.stack([answers.x_std_mm, answers.y_std_mm, answers.force_std_N], axis=1)
        return contact.astype(float), std.astype(float)

    checksum = sha256_of((model / "model.onnx").read_bytes())
    return replace(TrainingData.of(dataset), teacher=Teacher(about.label, checksum, answer))
