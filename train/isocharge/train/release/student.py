"""A small student of a model, for microcontrollers: 6,000 numbers at most, the same inputs and outputs.

The student has two hidden layers instead of three, narrow enough for 40 kB of flash. Its contacts and deviations are
the model's, learned by `training.teacher`; its misfit is learned from exact searches, as the model's was.
"""

import warnings
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, ModelError
from isocharge.common.progress import StageProgress, Warn
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.prediction.predictor import Predictor
from isocharge.simulate import Probe, Sensor, parse_probe
from isocharge.simulate.dataset.shards import Dataset
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train.data.domain import ContactDomain, inner_radius
from isocharge.train.release.measured import HELD_PRESSES
from isocharge.train.release.release import Release, train_model
from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig
from isocharge.train.training.teacher import Teacher

MOST_PARAMETERS = 6_000
"""Weights and biases of a student's graph, zeros between its two perceptrons included."""


def student_config(weights: str = "float32") -> FitConfig:
    """Settings of a student; `weights` is its form, "float32" or "int8"."""
    return FitConfig(
        NetworkConfig((30, 30), (34, 34), weights=weights), TrainingConfig(steps=16_000, misfit_steps=24_000)
    )


@dataclass(frozen=True)
class TaughtScene:
    """What a model knows, so that presses like those it was trained on can be simulated.

    Attributes:
        sensor: Its sensor.
        probes: Its probes.
        domain: Its working area and forces.
    """

    sensor: Sensor
    probes: tuple[Probe, ...]
    domain: ContactDomain

    @classmethod
    def of(cls, about: ModelMetadata) -> "TaughtScene":
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
        domain = ContactDomain(inner_radius(about.working_area_mm), about.force_range_N)
        return cls(sensor_from_dict(dict(about.sensor)), probes, domain)


def distil_model(
    model: Path,
    dataset: Dataset,
    folder: Path,
    config: FitConfig | None = None,
    *,
    command: str = "",
    version: int = 1,
    fresh: bool = False,
    progress: StageProgress | None = None,
    warn: Warn = warnings.warn,
) -> Release:
    """Train a student of a model and write it. Killed and called again with the same arguments, it goes on.

    Args:
        model: The model's version folder.
        dataset: Clean charges of the model's sensor, such as a sweep over its `TaughtScene`.
        folder: The student's folder, `models/NAME`.
        config: Sizes, steps, seed; `student_config()` if absent.
        command, version, fresh, progress, warn: As for `train_model`.

    Raises:
        ModelError: If the student would have more than `MOST_PARAMETERS`.
        DatasetError: If the dataset is of another sensor, or cannot train an inverse.
        OutputExists, TrainingError: As for `train_model`.
    """
    predictor, config = Predictor(model), config or student_config()
    about = predictor.metadata
    if sensor_to_dict(dataset.sensor) != dict(about.sensor):
        raise DatasetError(
            f"expected presses on the sensor of the model {about.label}, {about.sensor['name']!r}, got presses on "
            f"{dataset.sensor.name!r}; simulate them on the model's own sensor"
        )
    _check_size(config.network, len(about.electrodes))
    checksum = sha256((model / "model.onnx").read_bytes()).hexdigest()

    def answer(charge_pC: Array) -> tuple[Array, Array]:
        columns = np.stack(predictor.predict_batch(charge_pC), axis=1).astype(float)
        return columns[:, :3], columns[:, 3:6]

    return train_model(
        dataset,
        folder,
        config,
        command=command,
        version=version,
        fresh=fresh,
        teacher=Teacher(about.label, checksum, answer),
        progress=progress,
        warn=warn,
    )


def parameters(network: NetworkConfig, electrodes: int) -> int:
    """Numbers in the graph of a network whose perceptrons run side by side."""
    widths = [first + second for first, second in zip(network.hidden, network.misfit_hidden, strict=True)]
    answers = 6 + electrodes
    layers = zip([electrodes, *widths], [*widths, answers], strict=True)
    return sum(before * after + after for before, after in layers) + electrodes * answers + electrodes


def _check_size(network: NetworkConfig, electrodes: int) -> None:
    if (count := parameters(network, electrodes)) > MOST_PARAMETERS:
        raise ModelError(
            f"network.hidden: a student has at most {MOST_PARAMETERS} weights and biases, so that it fits a "
            f"microcontroller; {list(network.hidden)} beside {list(network.misfit_hidden)} make {count}; take "
            "narrower layers"
        )
