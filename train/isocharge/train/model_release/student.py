"""Training data and settings of a student, which is a small network that learns the answers of a model.

A student has the same inputs and outputs as the model. It has only about 5,000 weights and biases, so it fits into the
flash memory of a microcontroller. The student learns the contacts that the model estimates. Like the model, it learns
its standard deviations from its own errors, and the misfit from exact distances between charges.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, ModelError
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.predictor import Predictor
from isocharge.simulate import Dataset, Domain, Probe, Sensor, parse_probe
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train.model_release.evaluate import HELD_PRESSES
from isocharge.train.model_release.release import model_domain
from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig
from isocharge.train.training.source import Teacher, TrainingData


def student_config(weights: Literal["float32", "int8"] = "float32") -> FitConfig:
    """Return the settings of a student.

    Args:
        weights: Number type of the weights between hidden layers.
    """
    return FitConfig(
        network=NetworkConfig(hidden=(30, 30), misfit_hidden=(34, 34), weights=weights),
        training=TrainingConfig(steps=16_000, misfit_steps=24_000, misfit_charges=80_000),
    )


@dataclass(frozen=True)
class StudentCase:
    """Sensor, probes and contacts of a model.

    These values determine the distribution of the presses in the training of the model. More presses with this
    distribution can therefore be simulated.

    Attributes:
        sensor: Sensor of the model.
        probes: Probes of the model.
        domain: Working area and forces of the model.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: Domain

    @classmethod
    def of(cls, metadata: ModelMetadata) -> "StudentCase":
        """Read the sensor, the probes and the contacts of a model from its metadata.

        Raises:
            ModelError: If the model was trained on measured presses, which cannot be simulated.
        """
        if HELD_PRESSES in metadata.errors:
            raise ModelError(
                f"{metadata.label} was trained on measured presses, and simulated presses of its sensor are not like "
                "those; distil a model of simulated presses, such as one of 'isocharge train calibrate'"
            )
        probes = tuple(parse_probe(notation) for notation in metadata.probes)
        return cls(sensor_from_dict(dict(metadata.sensor)), probes, model_domain(metadata))


def student_data(model: Path, dataset: Dataset) -> TrainingData:
    """Return the training data of a student: presses, and the answers of a model to the charges of the presses.

    Args:
        model: Version folder of the model.
        dataset: Simulated presses without noise on the sensor of the model, such as a sweep over its `StudentCase`.

    Raises:
        DatasetError: If the presses were made on another sensor, or if a network cannot be trained on the dataset.
    """
    predictor = Predictor(model)
    metadata = predictor.metadata
    if sensor_to_dict(dataset.sensor) != dict(metadata.sensor):
        raise DatasetError(
            f"expected presses on the sensor of the model {metadata.label}, {metadata.sensor['name']!r}, got presses "
            f"on {dataset.sensor.name!r}; simulate them on the model's own sensor"
        )

    def estimate(charge: Array) -> Array:
        """Return estimated contacts (x, y, F), shape (n, 3), mm and N."""
        answers = predictor.predict_batch(charge)
        return np.stack([answers.x_mm, answers.y_mm, answers.force_N], axis=1).astype(float)

    return replace(TrainingData.of(dataset), teacher=Teacher(metadata.label, estimate))
