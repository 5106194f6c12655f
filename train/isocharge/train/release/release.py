"""From a dataset to a model folder: train, export, measure the exported file, write card and golden vectors.

A run that was stopped or killed leaves `<name>/<version>.part`; the same call goes on from there and writes the same
model.
"""

import copy
import platform
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from isocharge.common.arrays import Array
from isocharge.common.progress import StageProgress, Warn
from isocharge.common.resumable_run import resume_parts
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate.dataset.shards import Dataset
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.noise import misfit_noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.release.card import model_card
from isocharge.train.release.evaluate import Predict, measure_errors
from isocharge.train.release.export import export_onnx
from isocharge.train.release.folding import fold_network
from isocharge.train.release.graph_check import check_graph, disk_polygon
from isocharge.train.release.measured import MeasuredTest, measured_alarm, measured_errors
from isocharge.train.training.checkpoint import Checkpoint
from isocharge.train.training.config import FitConfig
from isocharge.train.training.fit import Fit, fit_network
from isocharge.train.training.teacher import Teacher


@dataclass(frozen=True)
class Release:
    """A model that was written.

    Attributes:
        folder: Its version folder.
        metadata: What the file says about itself, measured errors included.
    """

    folder: Path
    metadata: ModelMetadata


def train_model(
    dataset: Dataset,
    folder: Path,
    config: FitConfig | None = None,
    *,
    command: str = "",
    version: int = 1,
    fresh: bool = False,
    test: MeasuredTest | None = None,
    teacher: Teacher | None = None,
    progress: StageProgress | None = None,
    warn: Warn = warnings.warn,
) -> Release:
    """Train a model on a dataset and write it. Killed and called again with the same arguments, it goes on.

    Args:
        dataset: Clean charges, or measured ones.
        folder: The model's folder, `models/NAME`; the name is the model's.
        config: Sizes, steps, seed; the defaults if absent.
        command: How to make this model again, for the card.
        version: Number of the version folder.
        fresh: Throw away what an earlier run left.
        test: Measured presses to measure the errors on; those held out of a measured dataset if absent, and for a
            simulated one its held-out presses with noise.
        teacher: A model whose answers are learned; the presses' contacts if absent.
        progress: Called with steps done, all steps, and a text with the loss and errors.
        warn: Called where the map folds, and about damaged parts of an earlier run.

    Returns:
        Where it is and how well it does.

    Raises:
        OutputExists: If the version exists, or an unfinished run of other settings; checked before the work begins.
        DatasetError: If the dataset cannot train an inverse.
        TrainingError: If training fails, or the exported file and the network disagree.
    """
    check_target(folder, version, dataset.sensor.electrode_names)
    config = config or FitConfig()
    with resume_parts(folder / str(version), _identity(dataset, config, teacher), fresh=fresh, warn=warn) as draft:
        fit = fit_network(dataset, config, progress, checkpoint=Checkpoint(draft), teacher=teacher, warn=warn)
        test = test or (MeasuredTest(fit.held) if fit.measured else None)
        about = _metadata(fit, dataset, folder.resolve().name, version, command, test)
        if teacher:
            about = replace(about, made_with={**about.made_with, "teacher": teacher.label})
        graph = export_onnx(fold_network(fit.network), about.to_props())
        golden = check_graph(graph, _in_double(fit), fit.held, misfit_noise(noise_model(fit.config.training.noise)))
        further = test.further if test else {}
        written = write_model(folder, graph, about, golden, model_card(about, fit, test), further)
    return Release(written, about)


def _identity(dataset: Dataset, config: FitConfig, teacher: Teacher | None) -> dict[str, Any]:
    """All that decides about the weights."""
    return {
        "dataset_sha256": dataset.sha256,
        "noise": noise_model(config.training.noise).to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
        **({"teacher_sha256": teacher.sha256} if teacher else {}),
    }


def predict_with(fit: Fit) -> Predict:
    """The trained network as a plain function of charges."""

    def predict(charge_pC: Array) -> tuple[Array, Array, Array]:
        with torch.no_grad():
            contact, std, misfit = fit.network(torch.tensor(charge_pC).float())
        return contact.double().numpy(), std.double().numpy(), misfit.double().numpy()

    return predict


def _in_double(fit: Fit) -> Predict:
    """The trained network in double precision."""
    network = copy.deepcopy(fit.network).double()

    def predict(charge_pC: Array) -> tuple[Array, Array, Array]:
        with torch.no_grad():
            contact, std, misfit = network(torch.tensor(charge_pC).double())
        return contact.numpy(), std.numpy(), misfit.numpy()

    return predict


def _errors(fit: Fit, dataset: Dataset, test: MeasuredTest | None) -> Mapping[str, float]:
    """Errors on measured presses where there are some; the misfit's alarm then comes from the presses trained on."""
    predict = predict_with(fit)
    if fit.measured:
        inside = np.hypot(dataset.samples.x_mm, dataset.samples.y_mm) <= fit.network.domain.radius_mm
        alarm = measured_alarm(predict, LabelledPresses.of(dataset.samples)[inside])
        return {**measured_errors(predict, (test or MeasuredTest(fit.held)).held), **alarm}
    simulated = measure_errors(predict, fit.held, noise_model(fit.config.training.noise))
    if test is None:
        return simulated
    alarms = {name: value for name, value in simulated.items() if name.startswith(("misfit_", "found_"))}
    return {**measured_errors(predict, test.held), **alarms}


def _metadata(
    fit: Fit, dataset: Dataset, name: str, version: int, command: str, test: MeasuredTest | None
) -> ModelMetadata:
    noise = noise_model(fit.config.training.noise)
    packages = {package.__name__: package.__version__ for package in (np, onnx, onnxruntime, torch)}
    return ModelMetadata(
        name=name,
        version=version,
        sensor=sensor_to_dict(dataset.sensor),
        electrodes=dataset.sensor.electrode_names,
        working_area_mm=disk_polygon(fit.network.domain),
        probes=tuple(sorted({str(probe) for probe in dataset.samples.probe})),
        force_range_N=fit.network.domain.force_range_N,
        noise=noise.to_dict(),
        dataset_sha256=dataset.sha256,
        errors=_errors(fit, dataset, test),
        made_with={
            "command": command,
            "config": fit.config.to_dict(),
            "isocharge": metadata.version("isocharge"),
            "python": platform.python_version(),
            **packages,
            **({"cautions": list(fit.cautions)} if fit.cautions else {}),
            **(test.made_with if test else {}),
        },
    )
