"""Release of a trained network as a model folder with an ONNX graph, measured errors, golden vectors and a card."""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import ModelError
from isocharge.common.structs import convert
from isocharge.serve.model.golden import contact_floors
from isocharge.serve.model.metadata import ModelMetadata, ModelNoise
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.measured_sensor import MeasuredSensor, PressedArea
from isocharge.train.model_release.card import model_card
from isocharge.train.model_release.evaluate import evaluate
from isocharge.train.model_release.graph_check import check_graph
from isocharge.train.model_release.onnx_graph import write_graph
from isocharge.train.model_release.unnoticed import unnoticed_presses
from isocharge.train.training.fitted import Fitted

N_CORNERS = 64
"""Number of corners of the polygon that represents a round working area."""

CORNER_TOLERANCE_mm = 2e-3
"""Largest difference between the distances of two corners of a round working area from the origin, mm.

The corners in the metadata are rounded to 0.0001 mm.
"""

CardWriter = Callable[[ModelMetadata, Fitted], str]
"""Function from the metadata and the trained network to the text of the card."""


@dataclass(frozen=True)
class Release:
    """A released model.

    Attributes:
        folder: Version folder of the model.
        metadata: Metadata in the model file, with the measured errors.
    """

    folder: Path
    metadata: ModelMetadata


def release(
    fitted: Fitted,
    folder: Path,
    *,
    version: int = 1,
    command: str = "",
    card: CardWriter = model_card,
) -> Release:
    """Write a trained network as a version of a model.

    Before the files are written, the errors of the network are measured, and the exported graph is compared with the
    network.

    Args:
        fitted: The network.
        folder: Folder of the model, for example `models/NAME`. The name of the folder is the name of the model.
        version: Number of the version folder.
        command: Command that makes this model again, for the card.
        card: Function that writes the card.

    Returns:
        The version folder and the metadata.

    Raises:
        OutputExists: If the version exists.
        ModelError: If the folder holds a model with other electrodes.
        TrainingError: If the exported graph and the network disagree.
    """
    names = fitted.sensor.electrode_names
    check_target(folder, version, names)
    package_versions = {name: installed_version(name) for name in ("isocharge", "numpy", "onnx", "onnxruntime")}
    metadata_without_unnoticed = ModelMetadata(
        name=folder.resolve().name,
        version=version,
        sensor=_sensor_table(fitted),
        electrodes=names,
        working_area_mm=_working_area(fitted.domain),
        probes=fitted.probes,
        force_range_N=fitted.domain.force_range,
        noise=convert(fitted.noise.to_dict(), ModelNoise, "noise of the training", ModelError),
        dataset_sha256=fitted.sha256,
        errors=evaluate(fitted),
        made_with={
            "command": command,
            **package_versions,
            "python": platform.python_version(),
            **fitted.provenance.made_with,
        },
        yield_force_N=fitted.yield_force_N,
    )
    unnoticed = unnoticed_presses(fitted, metadata_without_unnoticed)
    complete_metadata = structs.replace(metadata_without_unnoticed, unnoticed=unnoticed)

    graph = write_graph(fitted.network, complete_metadata.to_props())
    floors = contact_floors(complete_metadata)
    golden_charges = check_graph(graph, fitted.network.outputs, fitted.test, fitted.misfit_noise, floors)
    card_text = card(complete_metadata, fitted)
    version_folder = write_model(folder, graph, complete_metadata, golden_charges, card_text, fitted.provenance.files)
    return Release(version_folder, complete_metadata)


def _sensor_table(fitted: Fitted) -> dict[str, Any]:
    """Return the description of the sensor for the metadata."""
    if isinstance(fitted.sensor, MeasuredSensor):
        return fitted.sensor.to_dict()
    return sensor_to_dict(fitted.sensor)


def _working_area(domain: Domain) -> tuple[tuple[float, float], ...]:
    """Return the corners (x, y) of the working area, mm."""
    if isinstance(domain, PressedArea):
        return domain.corners
    return _disk_polygon(domain.radius)


def _disk_polygon(radius: float) -> tuple[tuple[float, float], ...]:
    """Return the corners (x, y), mm, of a regular polygon around a disk.

    The polygon has `N_CORNERS` corners, and its sides touch the disk. The centre of the disk is the origin.

    Args:
        radius: Radius of the disk, mm.
    """
    angle = 2.0 * np.pi * np.arange(N_CORNERS) / N_CORNERS
    corner_radius = radius / np.cos(np.pi / N_CORNERS)  # `radius` is the distance of the sides from the centre
    corners: Array = np.round(corner_radius * np.stack([np.cos(angle), np.sin(angle)], axis=1), 4)
    return tuple((x, y) for x, y in corners.tolist())


def model_domain(metadata: ModelMetadata) -> Domain:
    """Determine the domain of the contacts for which a model was trained, using its metadata.

    In a model of simulated presses, the working area is a polygon around a disk, whose centre is the origin. For such a
    polygon, the domain is the largest disk in the polygon, with a radius rounded to 0.001 mm. For every other working
    area, the domain is a `PressedArea` with the same corners.

    Args:
        metadata: Metadata of the model.
    """
    corners = np.array(metadata.working_area_mm)

    # The corners of a regular polygon around the origin have equal distances, and so have the centres of its edges.
    edge_centres = 0.5 * (corners + np.roll(corners, -1, axis=0))
    radius = round(float(np.hypot(*edge_centres.T).min()), 3)
    is_disk = len(corners) == N_CORNERS and np.ptp(np.hypot(*corners.T)) < CORNER_TOLERANCE_mm
    if is_disk:
        return Domain(radius, metadata.force_range_N)
    return PressedArea.of_corners(corners, metadata.force_range_N)
