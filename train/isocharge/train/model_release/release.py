"""Release of a trained network as a model folder with an ONNX graph, measured errors, golden vectors and a card."""

import logging
import platform
from dataclasses import dataclass
from importlib.metadata import version as installed_version
from pathlib import Path

import numpy as np
from msgspec import structs

from isocharge.common.contact_domain import Domain
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import ModelError
from isocharge.common.files import StrPath
from isocharge.common.structs import convert
from isocharge.serve.model.contact import MISFIT_LIMIT, disk_corners
from isocharge.serve.model.metadata import ModelMetadata, ModelNoise
from isocharge.serve.model.model_folder import write_model
from isocharge.serve.model.session import contact_floors
from isocharge.train.data.channel_noise import misfit_noise
from isocharge.train.data.measured_sensor import PressedArea
from isocharge.train.model_release.evaluate import evaluate, unnoticed_presses
from isocharge.train.model_release.onnx_graph import check_graph, write_graph
from isocharge.train.training.fit import Fitted

log = logging.getLogger(__name__)

LISTED_ERRORS = {
    "position_median_mm": "position, median | {:g} mm",
    "position_rms_mm": "position, rms | {:g} mm",
    "position_p95_mm": "position, 95 % | {:g} mm",
    "position_p99_mm": "position, 99 % | {:g} mm",
    "clean_position_median_mm": "position without noise, median | {:g} mm",
    "clean_position_p95_mm": "position without noise, 95 % | {:g} mm",
    "force_median_percent": "force, median | {:g} %",
    "force_rms_percent": "force, rms | {:g} %",
    "force_p99_percent": "force, 99 % | {:g} %",
    "coverage_68": "coverage of the 68 % intervals | {:.1%}",
    "coverage_95": "coverage of the 95 % intervals | {:.1%}",
    "misfit_p99": "misfit that 1 % of good presses exceed | {:g}",
    "misfit_p999": "misfit that 0.1 % of good presses exceed | {:g}",
    "found_gain_20_percent": "detected presses of about 1 N with one gain wrong by 20 % | {:.1%}",
    "found_dead_electrode": "detected presses of about 1 N with one dead electrode | {:.1%}",
}
"""Rows of the table of errors by the name of the error in the metadata. Errors that were not measured have no row."""

SIMULATED_TRUTH = (
    "These figures compare with the simulator. On a real film, unknown gains and pretension cause larger errors."
)

MEASURED_TRUTH = (
    "The figures are those of one sensor and its rig on the day of the measurement, and include the errors of the rig. "
    "Another sensor, or the same sensor after months, can have far larger errors. "
    "`isocharge serve check` measures them with a few presses."
)

LIMITS = """\
- The answer to a press outside the working area or the range of forces, or to several presses at a time, is wrong. It
  carries a flag only if the charges differ enough from those of every press that the model covers.
- The standard deviations are valid for the noise named above, and not for wrong gains. The answer is a posterior mean,
  which is close to the middle of the working area where the charges carry little information.
"""


def model_card(metadata: ModelMetadata, fitted: Fitted) -> str:
    """Return the text of `card.md`, which describes a model and its errors for users.

    Args:
        metadata: Metadata of the model.
        fitted: The network, its sensor and its presses.
    """
    # The texts below are inserted into the card. Those of sections and lists end with a line break or are empty.
    electrodes = metadata.electrodes

    truth_text = MEASURED_TRUTH if "measured" in metadata.made_with else SIMULATED_TRUTH
    whites, gains = metadata.noise.for_each_electrode(len(electrodes))
    noise_texts = [f"{white:g} pC and {100 * gain:.3g} %" for white, gain in zip(whites, gains, strict=True)]
    noise_text = noise_texts[0]
    if len(set(noise_texts)) > 1:
        noise_text = "; ".join(f"{name} {text}" for name, text in zip(electrodes, noise_texts, strict=True))
    misfit_text = "It is large if the charges do not belong to one press."
    if len(electrodes) == 3:
        misfit_text = "Three charges nearly always fit some contact."
    # Each text in `LISTED_ERRORS` is a row of the table with a placeholder for the error.
    error_rows = "\n".join(
        f"| {row.format(metadata.errors[name])} |" for name, row in LISTED_ERRORS.items() if name in metadata.errors
    )
    unnoticed_text = f"{metadata.unnoticed.summary}.\n\n" if metadata.unnoticed is not None else ""
    cautions_text = "".join(f"- {caution}.\n" for caution in metadata.made_with.get("cautions", ()))
    return f"""# {metadata.name}, version {metadata.version}

Estimates the position and the force of one press from the charges of the sensor `{metadata.sensor["name"]}`.

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(electrodes)}], touch charges of {", ".join(electrodes)} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each), \
`contact_correlation` (xy, xF, yF), `misfit` |
| working area | {_area_text(fitted)} |
| forces | {_forces_text(metadata)} |
| probes | {", ".join(metadata.probes)} |
| noise `{metadata.noise.name}` | {noise_text} |

{fitted.description}## Errors

The errors are those on {len(fitted.test)} {_presses_text(metadata)}.

| error | |
|---|---|
{error_rows}

The misfit is the distance of the charges from those of the nearest single contact, in units of the noise.
{misfit_text}

{unnoticed_text}## Limits

- {truth_text}
{cautions_text}{LIMITS}
## Make it again

```bash
{metadata.made_with["command"] or "(made by a program, see metadata)"}
```
"""


def _area_text(fitted: Fitted) -> str:
    """Return a text about the working area."""
    if isinstance(fitted.domain, PressedArea):
        width, height = np.ptp(fitted.domain.corners, axis=0)
        return f"{width:.4g} mm x {height:.4g} mm, the outline of the presses; corners in the metadata"
    return f"within {fitted.domain.radius:g} mm of the centre"


def _forces_text(metadata: ModelMetadata) -> str:
    """Return a text about the range of forces, and about the force at which the film yields."""
    constant_force = metadata.made_with.get("constant_force")  # only if the network always returns the same force
    if constant_force is not None:
        reason = "all presses had this force" if constant_force["is_known"] else "the forces were not measured"
        return (
            f"not estimated: every answer is {constant_force['force_N']:g} N with a standard deviation of "
            f"{100 * constant_force['force_std']:.3g} %, because {reason}"
        )
    min_force, max_force = metadata.force_range_N
    text = f"{min_force:g} to {max_force:g} N"
    if metadata.yield_force_N is not None:
        text += (
            f"; beyond {metadata.yield_force_N:g} N at the centre, the stress exceeds {DEFAULT_STRESS_LIMIT:g} MPa: "
            "PVDF yields (flag `stress`)"
        )
    return text


def _presses_text(metadata: ModelMetadata) -> str:
    """Return a text about the presses on which the errors were measured.

    The text continues a sentence that begins with their number, and has no full stop.
    """
    measured = metadata.made_with.get("measured")
    if measured is not None:
        position_factor, force_factor = measured["std_factors"]
        return (
            f"measured presses at {measured['places']} places, which are in `presses.csv`. They are estimated by "
            f"{measured['folds']} networks, each at the places on which it was not trained. The model learned the mean "
            f"of their answers. The standard deviations were multiplied by {position_factor:g} for positions and "
            f"{force_factor:g} for forces, so that the 68 % intervals contain 68 % of these presses"
        )
    return (
        "simulated presses that were not used in the training, with that noise. The forces are log-uniform, and the "
        "positions are uniform over the working area"
    )


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
    folder: StrPath,
    *,
    version: int = 1,
    command: str = "",
) -> Release:
    """Write a trained network as a version of a model.

    Before the files are written, the errors of the network are measured, and the exported graph is compared with the
    network.

    Args:
        fitted: The network.
        folder: Folder of the model, for example `models/NAME`. The name of the folder is the name of the model.
        version: Number of the version folder.
        command: Command that makes this model again, for the card.

    Returns:
        The version folder and the metadata.

    Raises:
        OutputExists: If the version exists.
        ModelError: If the folder holds a model with other electrodes.
        TrainingError: If the exported graph and the network disagree.
    """
    errors = evaluate(fitted)
    # The reasons in this warning concern only simulated presses.
    if errors["misfit_p999"] > 2.0 * MISFIT_LIMIT and "measured" not in fitted.made_with:
        log.warning(
            "one in a thousand good presses has a misfit above %.3g, because the charges of different probes, "
            "rotations or possible films differ by more than the noise: the flag `misfit` notices only larger faults",
            errors["misfit_p999"],
        )
    packages = ("isocharge", "numpy", "onnx", "onnxruntime", "torch")
    package_versions = {name: installed_version(name) for name in packages}

    # The attribute `unnoticed` states how often the answer to a press outside the working area is wrong and carries no
    # flag. Its computation needs the other metadata.
    draft_metadata = ModelMetadata(
        name=Path(folder).resolve().name,
        version=version,
        sensor=dict(fitted.sensor),
        electrodes=fitted.electrodes,
        working_area_mm=_working_area(fitted.domain),
        probes=fitted.probes,
        force_range_N=fitted.domain.force_range,
        noise=convert(fitted.noise.to_dict(), ModelNoise, "noise of the training", ModelError),
        dataset_sha256=fitted.sha256,  # checksum of the training data
        errors=errors,
        made_with={
            "command": command,
            **package_versions,
            "python": platform.python_version(),
            **fitted.made_with,
        },
        yield_force_N=fitted.yield_force_N,
    )
    unnoticed = unnoticed_presses(fitted, draft_metadata)
    complete_metadata = structs.replace(draft_metadata, unnoticed=unnoticed)

    graph = write_graph(fitted.network, complete_metadata.to_props())
    # Compare the graph with the network. The tolerance of a number below its floor (x, y, force) is that of the floor.
    floors = contact_floors(complete_metadata)
    golden_charges = check_graph(graph, fitted.network.outputs, fitted.test, misfit_noise(fitted.noise), floors)
    card = model_card(complete_metadata, fitted)
    version_folder = write_model(folder, graph, complete_metadata, golden_charges, card, fitted.files)
    return Release(version_folder, complete_metadata)


def _working_area(domain: Domain) -> tuple[tuple[float, float], ...]:
    """Return the corners (x, y) of the working area, mm."""
    if isinstance(domain, PressedArea):
        return domain.corners
    return tuple((x, y) for x, y in disk_corners(domain.radius).round(4).tolist())
