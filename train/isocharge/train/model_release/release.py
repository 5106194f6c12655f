"""From a fitted network to a model folder: ONNX graph, measured errors, golden vectors, and the card.

The card says what a model is for, what it reaches, what it cannot do, and how to make it again.
"""

import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import ModelError, SceneError, SolveError
from isocharge.common.structs import convert
from isocharge.serve.model.golden import contact_floors
from isocharge.serve.model.metadata import ModelMetadata, ModelNoise
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate import parse_probe
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.simulate.solver.stress_limit import force_within_stress
from isocharge.train.data.measured_sensor import MeasuredSensor, PressedArea
from isocharge.train.model_release.evaluate import evaluate
from isocharge.train.model_release.graph_check import check_graph
from isocharge.train.model_release.measured_card import measured_card, measured_errors
from isocharge.train.model_release.onnx_graph import write_graph
from isocharge.train.training.fitted import Fitted

CORNERS = 64
"""Corners of the polygon that stands for a round working area."""

DISK_TOLERANCE_mm = 2e-3
"""Distance by which the corners of that polygon may differ from their places; they are written to 0.0001 mm."""

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


SIMULATED_TRUTH = """\
- The truth behind these figures is the simulator, not a film. On a real film, pretension and gains that
  nobody has measured matter more.
"""

MEASURED_TRUTH = """\
- The model was fitted to measurements of one film. The errors are those of that film and its rig on the day of the
  measurement; another film, or this one after months, can differ by far more. `isocharge serve check` says so from a
  few presses.
"""

NO_NOISE = """\
The presses as they were measured: no noise was added, and what the rig does not know of places and forces is in the
errors.
"""

LIMITS = """\
- The model assumes one press at a time, inside its working area and its range of forces. The answer to any other press
  is finite and wrong. If the electrodes lie on one circle, most presses far outside the working area look like a press
  inside it: the misfit is then small and the answer carries no flag.
- The deviations hold for the noise named above; gains that are off by 1 % add more than all of it.
"""


HUB_METRICS = {
    "position_median_mm": "position error, median, mm",
    "position_rms_mm": "position error, rms, mm",
    "force_median_percent": "force error, median, %",
    "force_rms_percent": "force error, rms, %",
}
"""Measured errors that model hubs list, and what they are called there."""


def hub_block(metadata: ModelMetadata) -> str:
    """The block of YAML above a card that model hubs read: what kind of model it is, and its measured errors.

    Source: https://huggingface.co/docs/hub/model-cards. No licence is named: whoever publishes a model chooses it.
    """
    metrics = "".join(
        f"""
    - type: {key}
      name: {said}
      value: {metadata.errors[key]:g}"""
        for key, said in HUB_METRICS.items()
        if key in metadata.errors
    )
    name, sensor = json.dumps(metadata.name), json.dumps(str(metadata.sensor["name"]))
    return f"""---
library_name: onnx
pipeline_tag: tabular-regression
tags: [isocharge, tactile-sensing, piezoelectric]
model-index:
- name: {name}
  results:
  - task:
      type: tabular-regression
    dataset:
      name: {sensor}
      type: presses
    metrics:{metrics}
---

"""


def model_card(metadata: ModelMetadata, fitted: Fitted) -> str:
    """The text of `card.md`."""
    if isinstance(fitted.sensor, MeasuredSensor):
        return measured_card(metadata)
    if fitted.test.measured:
        errors, truth = (
            fitted.provenance.card + measured_errors(metadata.errors, "that training never saw", NO_NOISE),
            MEASURED_TRUTH,
        )
    else:
        errors, truth = _errors(metadata.errors, len(fitted.test)), SIMULATED_TRUTH
    cautions = "".join(f"- {caution}.\n" for caution in fitted.cautions)
    return f"""{_interface(metadata, fitted)}
{errors}
{_misfit(metadata, fitted)}
## Limits

{truth}{cautions}{LIMITS}
## Make it again

```bash
{metadata.made_with["command"] or "(made by a program, see metadata)"}
```
"""


def yield_words(metadata: ModelMetadata) -> str:
    """From where on PVDF yields, for the row of the forces; empty where no press of the range makes it."""
    if metadata.yield_force_N is None:
        return ""
    return (
        f"; beyond {metadata.yield_force_N:g} N the film is stressed to more than {DEFAULT_STRESS_LIMIT:g} MPa: PVDF "
        "yields, and a dent stays (flag `stress`)"
    )


def _interface(metadata: ModelMetadata, fitted: Fitted) -> str:
    (low, high), noise, teacher = metadata.force_range_N, metadata.noise, metadata.made_with.get("teacher")
    electrodes = ", ".join(metadata.electrodes)
    taught = f"\nA small network that learned the answers of `{teacher}`." if teacher else ""
    folded = f" (of {fitted.asked.radius:g} mm asked for: beyond, two contacts give the same charges)"
    correlated = ", `contact_correlation` (xy, xF, yF)" if fitted.network.n_angle else ""
    unknown_probe = "; which of them presses is not known to the model" if len(metadata.probes) > 1 else ""
    return f"""# {metadata.name}, version {metadata.version}

Touch charges of the sensor `{metadata.sensor["name"]}` in, place and force of one press out.{taught}

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(metadata.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each){correlated}, `misfit` |
| working area | within {fitted.domain.radius:g} mm of the centre{folded if fitted.asked != fitted.domain else ""} |
| forces | {low:g} to {high:g} N{yield_words(metadata)} |
| probes | {", ".join(metadata.probes)}{unknown_probe} |
| trained for the noise | {noise.name}: {noise.white_pC:g} pC and {100 * noise.gain:g} % |
"""


def _errors(errors: Mapping[str, float], presses: int) -> str:
    return f"""## Measured on {presses} presses that training never saw

Forces log-uniform, positions uniform over the working area.

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


def _misfit(metadata: ModelMetadata, fitted: Fitted) -> str:
    errors, unit, shares = metadata.errors, fitted.misfit_noise, ""
    simulated = "simulated good presses" if fitted.test.measured else "good presses"
    good = "measured presses" if fitted.good.measured else simulated
    of_unit = f" `{unit.name}` (1 pC and 0.2 %)" if unit != fitted.noise else ""
    rare = f",\n0.1 % exceed {errors['misfit_p999']:g}" if "misfit_p999" in errors else ""
    if "found_dead_electrode" in errors:
        gain, dead = (100 * errors[share] for share in ("found_gain_20_percent", "found_dead_electrode"))
        shares = (
            f"Of presses of about 1 N the former finds {gain:.3g} % where one gain\n"
            f"is off by 20 %, and {dead:.3g} % where one electrode is dead."
        )
    sees = "Charges that disagree with each other (a wrong gain, a dead electrode, two presses) raise it."
    if len(metadata.electrodes) == 3:
        sees = (
            "Three charges and three unknowns: nearly every triple fits some contact, so it sees only what leads out\n"
            "of the working area or the forces."
        )
    return f"""\
The misfit is the distance, in units of the noise{of_unit}, of the charges from the nearest single contact that the
model knows; a network gives it, learned from exact searches. 1 % of {good} exceed {errors["misfit_p99"]:g}{rare}.
{sees}
{shares}
"""


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
        sensor=fitted.sensor.to_dict() if isinstance(fitted.sensor, MeasuredSensor) else sensor_to_dict(fitted.sensor),
        electrodes=names,
        working_area_mm=fitted.domain.corners
        if isinstance(fitted.domain, PressedArea)
        else _disk_polygon(fitted.domain.radius),
        probes=fitted.probes,
        force_range_N=fitted.domain.force_range,
        noise=convert(fitted.noise.to_dict(), ModelNoise, "noise of the training", ModelError),
        dataset_sha256=fitted.sha256,
        errors=evaluate(fitted) if errors is None else dict(errors),
        made_with={
            "command": command,
            **{package: metadata.version(package) for package in ("isocharge", "numpy", "onnx", "onnxruntime")},
            "python": platform.python_version(),
            **fitted.provenance.made_with,
        },
        yield_force_N=_yield_force(fitted),
    )
    graph = write_graph(fitted.network, about.to_props())
    golden = check_graph(graph, fitted.network.outputs, fitted.good, fitted.misfit_noise, contact_floors(about))
    text = hub_block(about) + card(about, fitted)
    return Release(write_model(folder, graph, about, golden, text, fitted.provenance.files), about)


def _yield_force(fitted: Fitted) -> float | None:
    """Force beyond which the film yields under the sharpest probe, N; None if no press that the model knows does so."""
    if isinstance(fitted.sensor, MeasuredSensor):
        return None
    low, high = forces = fitted.domain.force_range
    least = high
    for probe in map(parse_probe, fitted.probes):
        try:
            least = min(least, force_within_stress(fitted.sensor.film, probe, DEFAULT_STRESS_LIMIT, forces))
        except SceneError:  # the smallest force is beyond it already
            least = low
        except SolveError:  # nobody knows
            continue
    return round(least, 3) if least < high else None


def _disk_polygon(radius: float) -> tuple[tuple[float, float], ...]:
    """The working area as a polygon that just contains the disk."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    outer = radius / np.cos(np.pi / CORNERS)
    corners: Array = np.round(outer * np.stack([np.cos(angle), np.sin(angle)], axis=1), 4)
    return tuple((x, y) for x, y in corners.tolist())


def model_domain(about: ModelMetadata) -> Domain:
    """Return the contacts that a model was trained for, from its metadata.

    A working area that is the polygon of a disk about the origin, as models of simulated presses have it, gives the
    largest disk in it, to 0.001 mm. Every other working area gives a `PressedArea` with its corners.
    """
    corners = np.array(about.working_area_mm)
    along = np.roll(corners, -1, axis=0) - corners
    distances = np.abs(along[:, 0] * corners[:, 1] - along[:, 1] * corners[:, 0]) / np.hypot(*along.T)
    radius = round(float(distances.min()), 3)
    disk = np.array(_disk_polygon(radius))
    if corners.shape == disk.shape and np.abs(corners - disk).max() < DISK_TOLERANCE_mm:
        return Domain(radius, about.force_range_N)
    return PressedArea.of_corners(corners, about.force_range_N)
