"""From a fitted network to a model folder: ONNX graph, measured errors, card, golden vectors."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.model_release.card import model_card
from isocharge.train.model_release.evaluate import evaluate
from isocharge.train.model_release.export import check_graph, export_onnx
from isocharge.train.training.fit import Fitted

CORNERS = 64
"""Corners of the polygon that stands for a round working area."""

Card = Callable[[ModelMetadata, Fitted], str]
"""The text of a card, from what the model says about itself and the network."""


@dataclass(frozen=True)
class Release:
    """A model that was written.

    Attributes:
        folder: Its version folder.
        metadata: What the file says about itself, measured errors included.
    """

    folder: Path
    metadata: ModelMetadata


def release(
    fitted: Fitted,
    folder: Path,
    *,
    version: int = 1,
    command: str = "",
    errors: Mapping[str, float] | None = None,
    card: Card = model_card,
) -> Release:
    """Write a fitted network as a version of a model.

    Args:
        fitted: The network.
        folder: The model's folder, `models/NAME`; the name is the model's.
        version: Number of the version folder.
        command: How to make this model again, for the card.
        errors: For the metadata; what `evaluate` measures if absent.
        card: Writes the card.

    Raises:
        OutputExists: If the version exists.
        ModelError: If the folder holds a model with other electrodes.
        TrainingError: If the exported file and the network disagree.
    """
    names = fitted.sensor.electrode_names
    check_target(folder, version, names)
    about = ModelMetadata(
        name=folder.resolve().name,
        version=version,
        sensor=sensor_to_dict(fitted.sensor),
        electrodes=names,
        working_area_mm=_disk_polygon(fitted.domain.radius),
        probes=fitted.probes,
        force_range_N=fitted.domain.force_range,
        noise=fitted.noise.to_dict(),
        dataset_sha256=fitted.sha256,
        errors=evaluate(fitted) if errors is None else dict(errors),
        made_with={
            "command": command,
            **{package: metadata.version(package) for package in ("isocharge", "numpy", "onnx", "onnxruntime")},
            "python": platform.python_version(),
            **fitted.provenance.made_with,
        },
    )
    graph = export_onnx(fitted.network, about.to_props())
    golden = check_graph(graph, fitted.predict, fitted.good, misfit_noise(fitted.noise))
    written = write_model(folder, graph, about, golden, card(about, fitted), fitted.provenance.files)
    return Release(written, about)


def _disk_polygon(radius: float) -> tuple[tuple[float, float], ...]:
    """The working area as a polygon that just contains the disk."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    outer = radius / np.cos(np.pi / CORNERS)
    corners: Array = np.round(outer * np.stack([np.cos(angle), np.sin(angle)], axis=1), 4)
    return tuple((x, y) for x, y in corners.tolist())


def model_domain(about: ModelMetadata) -> Domain:
    """The contacts that a model knows, from its metadata: the largest disk in its working area, to 0.001 mm."""
    corners = np.array(about.working_area_mm)
    along = np.roll(corners, -1, axis=0) - corners
    distances = np.abs(along[:, 0] * corners[:, 1] - along[:, 1] * corners[:, 0]) / np.hypot(*along.T)
    return Domain(round(float(distances.min()), 3), about.force_range_N)
