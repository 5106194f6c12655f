"""From a dataset to a model folder: train, export, measure the exported file, write card and golden vectors."""

import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from isocharge.errors import TrainingError
from isocharge.serve.metadata import ModelMetadata
from isocharge.serve.model import check_target, write_model
from isocharge.serve.session import open_session, run
from isocharge.simulate.arrays import Array
from isocharge.simulate.dataset import Dataset
from isocharge.simulate.noise import noise_model
from isocharge.simulate.sensor_file import sensor_to_dict
from isocharge.train.charge_field import Domain
from isocharge.train.config import FitConfig
from isocharge.train.evaluate import Predict, measure_errors, noisy_charges
from isocharge.train.export import export_onnx
from isocharge.train.fit import Fit, Progress, fit_network

GOLDEN = 64
"""Golden vectors per model: half clean, a quarter noisy, a quarter absurd."""

CORNERS = 64
"""Corners of the polygon that stands for a round working area."""

AGREEMENT = {
    "contact": (np.array([1.0, 1.0, 0.1]), 1e-5),
    "contact_std": (np.array([1.0, 1.0, 0.1]), 1e-5),
    "misfit": (np.array([1.0]), 1e-4),
}
"""By output: unit below which differences count absolutely, and how far file and network may be apart (float32)."""


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
    progress: Progress | None = None,
) -> Release:
    """Train a model on a dataset and write it.

    Args:
        dataset: Clean charges.
        folder: The model's folder, `models/NAME`; the name is the model's.
        config: Sizes, steps, seed; the defaults if absent.
        command: How to make this model again, for the card.
        version: Number of the version folder.
        progress: Told about steps and loss.

    Returns:
        Where it is and how well it does.

    Raises:
        OutputExists: If the version is already there; checked before the work begins.
        DatasetError: If the dataset cannot train an inverse.
        TrainingError: If training fails, or the exported file and the network disagree.
    """
    check_target(folder, version, dataset.sensor.electrode_names)
    config = config or FitConfig()
    fit = fit_network(dataset, config, progress)
    metadata = _metadata(fit, dataset, folder.resolve().name, version, command)
    graph = export_onnx(fit.network, metadata.to_props())
    golden = _golden_charges(fit)
    _compare(graph, fit, golden)
    return Release(write_model(folder, graph, metadata, golden, model_card(metadata, fit)), metadata)


def predict_with(fit: Fit) -> Predict:
    """The trained network as a plain function of charges."""

    def predict(charge_pC: Array) -> tuple[Array, Array, Array]:
        with torch.no_grad():
            contact, std, misfit = fit.network(torch.tensor(charge_pC).float())
        return contact.double().numpy(), std.double().numpy(), misfit.double().numpy()

    return predict


def _metadata(fit: Fit, dataset: Dataset, name: str, version: int, command: str) -> ModelMetadata:
    noise = noise_model(fit.config.training.noise)
    packages = {package.__name__: package.__version__ for package in (np, onnx, onnxruntime, torch)}
    return ModelMetadata(
        name=name,
        version=version,
        sensor=sensor_to_dict(dataset.sensor),
        electrodes=dataset.sensor.electrode_names,
        working_area_mm=_polygon(fit.field.domain),
        probes=tuple(sorted({str(probe) for probe in dataset.samples.probe})),
        force_range_N=fit.field.domain.force_range_N,
        noise=noise.to_dict(),
        dataset_sha256=dataset.sha256,
        errors=measure_errors(predict_with(fit), fit.held, noise),
        made_with={
            "command": command,
            "config": fit.config.to_dict(),
            "isocharge": metadata.version("isocharge"),
            "python": platform.python_version(),
            **packages,
        },
    )


def _polygon(domain: Domain) -> tuple[tuple[float, float], ...]:
    """The working area as a polygon that just contains the disk."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    radius = domain.radius_mm / np.cos(np.pi / CORNERS)
    return tuple(
        (round(float(x), 4), round(float(y), 4))
        for x, y in zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)
    )


def _golden_charges(fit: Fit) -> np.ndarray:
    """Charges for the golden vectors, float32, shape (GOLDEN, n_electrode)."""
    spread = np.linspace(0, len(fit.held) - 1, GOLDEN // 2).astype(int)
    clean = fit.held[spread]
    half = clean[np.arange(0, len(clean), 2)]
    noisy = noisy_charges(half, noise_model(fit.config.training.noise), seed=2)
    absurd = half.charge_pC * np.geomspace(1e-3, 1e3, len(half))[:, None]
    absurd[0], absurd[1] = 0.0, -absurd[1]
    return np.concatenate([clean.charge_pC, noisy, absurd]).astype(np.float32)


def _compare(graph: bytes, fit: Fit, charge_pC: np.ndarray) -> None:
    """The file must answer as the network does."""
    answers = run(open_session(graph, "the exported graph"), charge_pC)
    for mine, (name, theirs) in zip(predict_with(fit)(charge_pC), answers.items(), strict=True):
        unit, limit = AGREEMENT[name]
        apart = float(np.max(np.abs(mine - theirs) / np.maximum(np.abs(mine), unit)))
        if not apart <= limit:
            raise TrainingError(f"the exported graph disagrees with the network on {name}: {apart:.2g} > {limit:g}")


def model_card(metadata: ModelMetadata, fit: Fit) -> str:
    """The model card."""
    errors, (low, high), noise = metadata.errors, metadata.force_range_N, metadata.noise
    electrodes = ", ".join(metadata.electrodes)
    return f"""# {metadata.name}, version {metadata.version}

Touch charges of the sensor `{metadata.sensor["name"]}` in, place and force of one press out.

| | |
|---|---|
| input | `charge_pC`, float32 [n, {len(metadata.electrodes)}], touch charges of {electrodes} in pC |
| outputs | `contact` (x_mm, y_mm, force_N), `contact_std` (one standard deviation of each), `misfit` |
| working area | within {fit.field.domain.radius_mm:g} mm of the centre |
| forces | {low:g} to {high:g} N |
| probes | {", ".join(metadata.probes)} |
| trained for the noise | {noise["name"]}: {noise["white_pC"]:g} pC and {100 * float(noise["gain"]):g} % |

## Measured on {len(fit.held)} presses that training never saw

Forces log-uniform, positions uniform over the working area.

| error | with that noise | clean charges |
|---|---|---|
| position, median | {errors["position_median_mm"]:g} mm | {errors["clean_position_median_mm"]:g} mm |
| position, rms | {errors["position_rms_mm"]:g} mm | |
| position, 95 % | {errors["position_p95_mm"]:g} mm | {errors["clean_position_p95_mm"]:g} mm |
| force, median | {errors["force_median_percent"]:g} % | |
| force, rms | {errors["force_rms_percent"]:g} % | |
| coverage of the 68 % intervals | {100 * errors["coverage_68"]:.3g} % | |
| coverage of the 95 % intervals | {100 * errors["coverage_95"]:.3g} % | |

The misfit is the distance, in units of the noise, of the charges from the nearest single contact that the model knows:
the smallest of four tries, so rather too large than too small, above all within half a millimetre of the edge of the
working area. 1 % of good presses exceed {errors["misfit_p99"]:g}, 0.1 % exceed {errors["misfit_p999"]:g}.
{_what_misfit_sees(metadata)}

## Limits

- The truth behind these figures is the simulator, not a film. On a real film, pretension and gains that
  nobody has measured matter more.
- One press at a time. Outside the working area and forces the answer is finite and wrong; the misfit is then large in
  many cases, not in all.
- The deviations hold for the noise named above; gains that are off by 1 % add more than all of it.

## Make it again

```bash
{metadata.made_with["command"] or "(made by a program, see metadata)"}
```
"""


def _what_misfit_sees(metadata: ModelMetadata) -> str:
    if len(metadata.electrodes) == 3:
        return (
            "Three charges and three unknowns: nearly every triple fits some contact, so it sees only what leads out\n"
            "of the working area or the forces."
        )
    return "Charges that disagree with each other (a wrong gain, a dead electrode, two presses) raise it."
