"""From a dataset to a model folder: train, export, measure the exported file, write card and golden vectors.

A run that was stopped or killed leaves `<name>/<version>.part`; the same call goes on from there and writes the same
model.
"""

import copy
import platform
import warnings
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from isocharge.arrays import Array
from isocharge.errors import TrainingError
from isocharge.progress import StageProgress, Warn
from isocharge.resumable_run import resume_parts
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.serve.model.session import open_session, run
from isocharge.simulate.dataset.shards import Dataset
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.domain import HIGHEST_PC, LOWEST_PC, ContactDomain
from isocharge.train.data.noise import misfit_noise, noisy_charges
from isocharge.train.release.card import model_card
from isocharge.train.release.evaluate import Predict, measure_errors
from isocharge.train.release.export import export_onnx
from isocharge.train.training.checkpoint import Checkpoint
from isocharge.train.training.config import FitConfig
from isocharge.train.training.fit import Fit, fit_network

GOLDEN = 64
"""Golden vectors per model: half clean, a quarter noisy, a quarter absurd."""

CORNERS = 64
"""Corners of the polygon that stands for a round working area."""

AGREEMENT = {
    "contact": (np.array([1.0, 1.0, 0.1]), 1e-5),
    "contact_std": (np.array([1.0, 1.0, 0.1]), 1e-5),
    "misfit": (np.array([1.0]), 2e-4),
}
"""By output: unit below which differences count absolutely, and how far file and network may be apart (float32)."""

COMPARED = 10_000
"""Noisy presses on which file and network are compared."""

NEARLY_ALL = 0.999
"""Share of the presses that the limits are for: where charges tell little, a float32 has not the digits."""

ABSURD = 10.0
"""Factor on the limits for all other presses, and for charges that no film gives."""


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
    progress: StageProgress | None = None,
    warn: Warn = warnings.warn,
) -> Release:
    """Train a model on a dataset and write it. Killed and called again with the same arguments, it goes on.

    Args:
        dataset: Clean charges.
        folder: The model's folder, `models/NAME`; the name is the model's.
        config: Sizes, steps, seed; the defaults if absent.
        command: How to make this model again, for the card.
        version: Number of the version folder.
        fresh: Throw away what an earlier run left.
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
    with resume_parts(folder / str(version), _identity(dataset, config), fresh=fresh, warn=warn) as draft:
        fit = fit_network(dataset, config, progress, checkpoint=Checkpoint(draft), warn=warn)
        about = _metadata(fit, dataset, folder.resolve().name, version, command)
        graph = export_onnx(fit.network, about.to_props())
        good, absurd = _golden_charges(fit)
        _check_finite(graph, len(dataset.sensor.electrode_names))
        _compare(graph, fit, absurd, ABSURD)
        _compare(graph, fit, _many_charges(fit), 1.0)
        written = write_model(folder, graph, about, np.concatenate([good, absurd]), model_card(about, fit))
    return Release(written, about)


def _identity(dataset: Dataset, config: FitConfig) -> dict[str, Any]:
    """All that decides about the weights."""
    return {
        "dataset_sha256": dataset.sha256,
        "noise": noise_model(config.training.noise).to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
    }


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
        working_area_mm=_polygon(fit.network.domain),
        probes=tuple(sorted({str(probe) for probe in dataset.samples.probe})),
        force_range_N=fit.network.domain.force_range_N,
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


def _polygon(domain: ContactDomain) -> tuple[tuple[float, float], ...]:
    """The working area as a polygon that just contains the disk."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    radius = domain.radius_mm / np.cos(np.pi / CORNERS)
    return tuple(
        (round(float(x), 4), round(float(y), 4))
        for x, y in zip(radius * np.cos(angle), radius * np.sin(angle), strict=True)
    )


def _golden_charges(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Charges for the golden vectors, float32: GOLDEN * 3 / 4 of presses, and absurd ones, n_electrode each.

    They are chosen where charges tell the position better than the median: where 0.2 % is a millimetre, the last digit
    of a float32 is 3e-5 mm, and no two runtimes agree to the tolerance of golden vectors.
    """
    std = predict_with(fit)(fit.held.charge_pC)[1]
    sure = fit.held[np.flatnonzero(std[:, 0] + std[:, 1] <= np.median(std[:, 0] + std[:, 1]))]
    clean = sure[np.linspace(0, len(sure) - 1, GOLDEN // 2).astype(int)]
    half = clean[np.arange(0, len(clean), 2)]
    noisy = noisy_charges(half, misfit_noise(noise_model(fit.config.training.noise)), seed=2)
    absurd = half.charge_pC * np.geomspace(1e-3, 1e3, len(half))[:, None]
    absurd[0], absurd[1] = 0.0, -absurd[1]
    return np.concatenate([clean.charge_pC, noisy]).astype(np.float32), absurd.astype(np.float32)


def _many_charges(fit: Fit) -> np.ndarray:
    """Noisy charges of held-out presses, float32, shape (COMPARED, n_electrode)."""
    rows = np.arange(COMPARED) % len(fit.held)
    return noisy_charges(fit.held[rows], misfit_noise(noise_model(fit.config.training.noise)), seed=3).astype(
        np.float32
    )


def _check_finite(graph: bytes, n_electrode: int) -> None:
    """The graph goes on straight in the logarithms beyond its presses: its answers must stay finite up to the ends.

    Raises:
        TrainingError: If one does not.
    """
    ends = np.random.default_rng(4).choice([LOWEST_PC, HIGHEST_PC], (COMPARED, n_electrode)).astype(np.float32)
    for name, rows in run(open_session(graph, "the exported graph"), ends).items():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise TrainingError(
                f"the network answers {name} = {rows[bad[0]]} to the charges {ends[bad[0]]} pC; expected finite "
                "numbers for any charges: train with more steps or another seed"
            )


def _compare(graph: bytes, fit: Fit, charge_pC: np.ndarray, slack: float) -> None:
    """The file must answer as the network does, which is computed in double precision."""
    answers = run(open_session(graph, "the exported graph"), charge_pC)
    with torch.no_grad():
        exact = [tensor.numpy() for tensor in copy.deepcopy(fit.network).double()(torch.tensor(charge_pC).double())]
    for mine, (name, theirs) in zip(exact, answers.items(), strict=True):
        unit, limit = AGREEMENT[name]
        apart = np.max(np.abs(mine - theirs) / np.maximum(np.abs(mine), unit), axis=1)
        nearly_all, all_of_them = float(np.quantile(apart, NEARLY_ALL)), float(apart.max())
        if not (nearly_all <= slack * limit and all_of_them <= ABSURD * limit):
            raise TrainingError(
                f"the exported graph disagrees with the network on {name}: expected at most {slack * limit:g} for "
                f"{NEARLY_ALL:.1%} of the charges and {ABSURD * limit:g} for all, got {nearly_all:.2g} and "
                f"{all_of_them:.2g}"
            )
