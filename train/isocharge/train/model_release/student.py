"""A small student of a model, for microcontrollers: some 5,000 numbers, the same inputs and outputs.

The student has two hidden layers instead of three, narrow enough for 40 kB of flash. Its contacts and deviations are
the model's; its misfit is learned from exact searches, as the model's was.
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
    """Settings of a student; `weights` is their form."""
    return FitConfig(
        network=NetworkConfig(hidden=(30, 30), misfit_hidden=(34, 34), weights=weights),
        training=TrainingConfig(steps=16_000, misfit_steps=24_000),
    )


@dataclass(frozen=True)
class StudentCase:
    """What a model knows, so that presses like those it was trained on can be simulated.

    Attributes:
        sensor: Its sensor.
        probes: Its probes.
        domain: Its working area and forces.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: Domain

    @classmethod
    def of(cls, about: ModelMetadata) -> "StudentCase":
        """From the model's metadata.

        Raises:
            ModelError: If it was trained on measured presses, which no simulation repeats.
        """
        if HELD_PRESSES in about.errors:
            raise ModelError(
                f"{about.label} was trained on measured presses, and simulated presses of its sensor are not like "
                "those; distil a model of simulated presses, such as one of 'isocharge train calibrate'"
            )
        probes = tuple(parse_probe(notation) for notation in about.probes)
        return cls(sensor_from_dict(dict(about.sensor)), probes, model_domain(about))


def student_data(model: Path, dataset: Dataset) -> TrainingData:
    """What a student is fitted to: presses, and the answers of a model to them.

    Args:
        model: The model's version folder.
        dataset: Clean charges of the model's sensor, such as a sweep over its `StudentCase`.

    Raises:
        DatasetError: If the dataset is of another sensor, or cannot train an inverse.
    """
    predictor = Predictor(model)
    about = predictor.metadata
    if sensor_to_dict(dataset.sensor) != dict(about.sensor):
        raise DatasetError(
            f"expected presses on the sensor of the model {about.label}, {about.sensor['name']!r}, got presses on "
            f"{dataset.sensor.name!r}; simulate them on the model's own sensor"
        )

    def answer(charge: Array) -> tuple[Array, Array]:
        columns = np.stack(predictor.predict_batch(charge), axis=1).astype(float)
        return columns[:, :3], columns[:, 3:6]

    checksum = sha256_of((model / "model.onnx").read_bytes())
    return replace(TrainingData.of(dataset), teacher=Teacher(about.label, checksum, answer))
