"""Release of a trained network as a model folder with an ONNX graph, measured errors, golden vectors and a model card.

The card states what the model is for, how large its errors are, what its limits are, and how to make it again.
"""

import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import ModelError
from isocharge.common.structs import convert
from isocharge.serve.model.golden import contact_floors
from isocharge.serve.model.metadata import ModelMetadata, ModelNoise
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.measured_sensor import MeasuredSensor, PressedArea
from isocharge.train.model_release.evaluate import evaluate
from isocharge.train.model_release.graph_check import check_graph
from isocharge.train.model_release.measured_card import measured_card, measured_errors_section
from isocharge.train.model_release.onnx_graph import write_graph
from isocharge.train.model_release.unnoticed import unnoticed_presses, unnoticed_section
from isocharge.train.training.fitted import Fitted

N_CORNERS = 64
"""Number of corners of the polygon that represents a round working area."""

CORNER_TOLERANCE_mm = 2e-3
"""Largest difference between a coordinate of a corner and that of a regular polygon for a round working area, mm.

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


SIMULATED_TRUTH = """\
- These figures compare with the simulator. On a real film, unknown gains and pretension cause larger errors.
"""

MEASURED_TRUTH = """\
- The model was trained on measurements of one film. The errors are those of this film and its rig on the day of the
  measurement. Another film, or the same film after months, can have far larger errors. `isocharge serve check` measures
  them with a few presses.
"""

NO_NOISE = """\
No noise was added to these presses. The errors include those of the places and forces that the rig measured.
"""

LIMITS = """\
- The answer to a press outside the working area or the range of forces, or to several presses at a time, is wrong. It
  carries a flag only if the charges differ enough from those of every press that the model covers.
- The standard deviations are valid for the noise named above, and not for wrong gains.
"""


HUB_METRICS = {
    "position_median_mm": "position error, median, mm",
    "position_rms_mm": "position error, rms, mm",
    "force_median_percent": "force error, median, %",
    "force_rms_percent": "force error, rms, %",
}
"""Names on model hubs of the measured errors that the hubs list, by the name of the error in the metadata."""


def hub_block(metadata: ModelMetadata) -> str:
    """Return the YAML block at the beginning of a card. Model hubs read this block.

    The block states the kind of the model and its measured errors.

    Source: https://huggingface.co/docs/hub/model-cards. The block names no licence, because the publisher of a model
    chooses it.

    Args:
        metadata: Metadata of the model, with its errors.
    """
    metrics = "".join(
        f"""
    - type: {key}
      name: {name}
      value: {metadata.errors[key]:g}"""
        for key, name in HUB_METRICS.items()
        if key in metadata.errors
    )
    model_name = json.dumps(metadata.name)
    sensor_name = json.dumps(str(metadata.sensor["name"]))
    return f"""---
library_name: onnx
pipeline_tag: tabular-regression
tags: [isocharge, tactile-sensing, piezoelectric]
model-index:
- name: {model_name}
  results:
  - task:
      type: tabular-regression
    dataset:
      name: {sensor_name}
      type: presses
    metrics:{metrics}
---

"""


def model_card(metadata: ModelMetadata, fitted: Fitted) -> str:
    """Return the text of `card.md`.

    If the model was trained on measured presses alone, `measured_card` writes the card. In all other cards, the
    sections about the errors and the limits depend on whether the test presses were measured or simulated.

    Args:
        metadata: Metadata of the model.
        fitted: The network, its sensor and its presses.
    """
    if isinstance(fitted.sensor, MeasuredSensor):
        return measured_card(metadata)
    if fitted.test.measured:
        measured_section = measured_errors_section(metadata.errors, "that were not used in the training", NO_NOISE)
        errors_text = fitted.provenance.card + measured_section
        truth_text = MEASURED_TRUTH
    else:
        errors_text = _errors_section(metadata.errors, len(fitted.test))
        truth_text = SIMULATED_TRUTH
    cautions_text = "".join(f"- {caution}.\n" for caution in fitted.cautions)
    return f"""{_interface_section(metadata, fitted)}
{errors_text}
{_misfit_section(metadata, fitted)}
{unnoticed_section(metadata.unnoticed)}## Limits

{truth_text}{cautions_text}{LIMITS}
## Make it again

```bash
{metadata.made_with["command"] or "(made by a program, see metadata)"}
```
"""


def yield_text(metadata: ModelMetadata) -> str:
    """Return a text about the force at which the film yields. The text is empty if the film does not yield.

    The text is the end of the row of the forces in a card. Only forces within the range of the model are considered.

    Args:
        metadata: Metadata of the model.
    """
    if metadata.yield_force_N is None:
        return ""
    return (
        f"; beyond {metadata.yield_force_N:g} N the film is stressed to more than {DEFAULT_STRESS_LIMIT:g} MPa: PVDF "
        "yields (flag `stress`)"
    )


def _interface_section(metadata: ModelMetadata, fitted: Fitted) -> str:
    """Return the section of the card that states the inputs, the outputs and the ranges of validity.

    Args:
        metadata: Metadata of the model.
        fitted: The network and its domain.
    """
    min_force, max_force = metadata.force_range_N
    noise = metadata.noise
    teacher = metadata.made_with.get("teacher")
    electrodes = ", ".join(metadata.electrodes)
    sensor_name = metadata.sensor["name"]
    teacher_text = f"\nThe model is a small network that learned the answers of `{teacher}`." if teacher else ""
    requested = fitted.requested_domain
    domain_text = ""
    if requested != fitted.domain:
        domain_text = f" ({requested.radius:g} mm were requested; farther out two contacts can have the same charges)"
    correlations = ", `contact_correlation` (xy, xF, yF)"
    probe_text = "; the model does not distinguish them" if len(metadata.probes) > 1 else ""
    return f"""# {metadata.name}, version {metadata.version}

Estimates the position and the force of one press from the touch charges of the sensor `{sensor_name}`.{teacher_text}

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(metadata.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each){correlations}, `misfit` |
| working area | within {fitted.domain.radius:g} mm of the centre{domain_text} |
| forces | {min_force:g} to {max_force:g} N{yield_text(metadata)} |
| probes | {", ".join(metadata.probes)}{probe_text} |
| trained for the noise | {noise.name}: {noise.white_pC:g} pC and {100 * noise.gain:g} % |
"""


def _errors_section(errors: Mapping[str, float], n_press: int) -> str:
    """Return the section of the card that lists the errors on simulated presses."""
    return f"""## Errors on {n_press} presses that were not used in the training

The forces are log-uniform, and the positions are uniform over the working area.

| error | with that noise | clean charges |
|---|---|---|
| position, median | {errors["position_median_mm"]:g} mm | {errors["clean_position_median_mm"]:g} mm |
| position, rms | {errors["position_rms_mm"]:g} mm | |
| position, 95 % | {errors["position_p95_mm"]:g} mm | {errors["clean_position_p95_mm"]:g} mm |
| position, 99 % | {errors["position_p99_mm"]:g} mm | |
| force, median | {errors["force_median_percent"]:g} % | |
| force, rms | {errors["force_rms_percent"]:g} % | |
| force, 99 % | {errors["force_p99_percent"]:g} % | |
| coverage of the 68 % intervals | {100 * errors["coverage_68"]:.3g} % | |
| coverage of the 95 % intervals | {100 * errors["coverage_95"]:.3g} % | |
"""


def _misfit_section(metadata: ModelMetadata, fitted: Fitted) -> str:
    """Return the paragraph of the card about the misfit.

    Args:
        metadata: Metadata of the model, with its errors.
        fitted: The network, its noise and its test presses.
    """
    errors = metadata.errors
    noise = fitted.misfit_noise
    # The unit is only named if it is not the noise of the training, which the card has already named.
    unit_text = f" `{noise.name}` (1 pC and 0.2 %)" if noise != fitted.noise else ""
    if fitted.good.measured:
        presses_text = "measured presses"
    elif fitted.test.measured:
        presses_text = "simulated good presses"
    else:
        presses_text = "good presses"
    rare_text = f", 0.1 % exceed {errors['misfit_p999']:g}" if "misfit_p999" in errors else ""
    faults_text = ""
    if "found_dead_electrode" in errors:
        gain_percent = 100 * errors["found_gain_20_percent"]
        dead_percent = 100 * errors["found_dead_electrode"]
        faults_text = (
            f"An alarm at {errors['misfit_p99']:g} finds {gain_percent:.3g} % of the presses of about 1 N with one\n"
            f"gain that is wrong by 20 %, and {dead_percent:.3g} % of those with one dead electrode."
        )
    meaning_text = "It is large if the charges do not belong to one press."
    if len(metadata.electrodes) == 3:
        meaning_text = "Three charges nearly always fit some contact, so it is large only outside the model's range."
    return f"""\
The misfit is the distance of the charges from those of the nearest single contact, in units of the noise{unit_text}.
{meaning_text}
1 % of {presses_text} exceed {errors["misfit_p99"]:g}{rare_text}.
{faults_text}
"""


def release(
    fitted: Fitted,
    folder: Path,
    *,
    version: int = 1,
    command: str = "",
    errors: Mapping[str, float] | None = None,
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
        errors: Errors for the metadata; None to measure them with `evaluate`.
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
        errors=evaluate(fitted) if errors is None else dict(errors),
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
    golden_charges = check_graph(graph, fitted.network.outputs, fitted.good, fitted.misfit_noise, floors)
    card_text = hub_block(complete_metadata) + card(complete_metadata, fitted)
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

    # The distance of an edge from the origin is the cross product of the edge and one of its corners, divided by the
    # length of the edge.
    edges = np.roll(corners, -1, axis=0) - corners
    cross_product = edges[:, 0] * corners[:, 1] - edges[:, 1] * corners[:, 0]
    edge_distance = np.abs(cross_product) / np.hypot(edges[:, 0], edges[:, 1])

    radius = round(float(edge_distance.min()), 3)
    disk_corners = np.array(_disk_polygon(radius))
    is_disk = corners.shape == disk_corners.shape and np.abs(corners - disk_corners).max() < CORNER_TOLERANCE_mm
    if is_disk:
        return Domain(radius, metadata.force_range_N)
    return PressedArea.of_corners(corners, metadata.force_range_N)
