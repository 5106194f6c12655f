"""From a sensor to a released network for all its films: train, measure, write the folder.

A run that was stopped or killed leaves `<name>/<version>.part`; the same call goes on from there.
"""

import warnings
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from isocharge.common.arrays import Array
from isocharge.common.progress import StageProgress, Warn
from isocharge.common.resumable_run import resume_parts
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.films.card import films_card
from isocharge.train.films.config import FilmsConfig
from isocharge.train.films.films_file import FILE, films_bytes, films_from_bytes
from isocharge.train.films.films_model import PRESSES, FilmsModel, fresh_presses, write_film_model
from isocharge.train.films.fit import FilmsFit, fit_films
from isocharge.train.films.measure import FreshFilms, films_errors, fresh_films
from isocharge.train.release.evaluate import measure_errors
from isocharge.train.release.release import Release
from isocharge.train.training.checkpoint import Checkpoint


def train_films(
    prior: FilmPrior,
    folder: Path,
    config: FilmsConfig | None = None,
    *,
    command: str = "",
    version: int = 1,
    fresh: bool = False,
    map_jobs: JobMap = map,
    progress: StageProgress | None = None,
    warn: Warn = warnings.warn,
) -> Release:
    """Train a network for all films of a prior and write it. Killed and called again, it goes on.

    Args:
        prior: The sensor as described, the probe, and how far films spread.
        folder: The model's folder, `models/NAME`; the name is the model's.
        config: Radius, sizes, steps, seed; the defaults if absent.
        command: How to make this model again, for the card.
        version: Number of the version folder.
        fresh: Throw away what an earlier run left.
        map_jobs: Runs solves, presses and searches, in this process by default.
        progress: Called with steps done, all steps, and a text with the loss.
        warn: Called about damaged parts of an earlier run.

    Returns:
        Where it is; the errors of its metadata are those of films that it is told.

    Raises:
        OutputExists: If the version exists, or an unfinished run of other settings; checked before the work begins.
        SceneError, SolveError: If some presses cannot exist or be solved.
        TrainingError: If training fails, or an exported file and the network disagree.
    """
    check_target(folder, version, prior.sensor.electrode_names)
    config = config or FilmsConfig()
    with resume_parts(folder / str(version), _identity(prior, config), fresh=fresh, warn=warn) as draft:
        fit = fit_films(prior, config, map_jobs=map_jobs, checkpoint=Checkpoint(draft), progress=progress)
        return write_films(fit, folder, command=command, version=version)


def write_films(fit: FilmsFit, folder: Path, *, command: str = "", version: int = 1) -> Release:
    """Measure trained weights as the file gives them back, and write the model folder.

    Raises:
        OutputExists: If the version exists.
        TrainingError: If an exported file and the network disagree.
    """
    data = films_bytes(FilmsModel.of(fit, noise_model(fit.config.noise)))
    films = films_from_bytes(data, FILE)
    measured = _Measured.of(films)
    written: list[ModelMetadata] = []

    def card(about: ModelMetadata) -> str:
        written.append(about)
        return films_card(films, about, measured.known, measured.unknown, measured.exact, measured.text)

    place = write_film_model(
        films,
        measured.parameters,
        folder,
        card=card,
        version=version,
        errors=measured.exact,
        made_with={
            "command": command,
            "config": fit.config.to_dict(),
            "films": dict(measured.known),
            "numpy": np.__version__,
            "torch": torch.__version__,
        },
        further={FILE: data},
    )
    return Release(place, written[0])


@dataclass(frozen=True)
class _Measured:
    """The film that `model.onnx` assumes, and errors.

    Attributes:
        parameters: Of that film, shape (n_parameter,).
        text: That film in words.
        known: Errors on fresh films that the network is told.
        unknown: Errors on the same films if that film is assumed.
        exact: Errors on that film.
    """

    parameters: Array
    text: str
    known: dict[str, float]
    unknown: dict[str, float]
    exact: dict[str, float]

    @classmethod
    def of(cls, films: FilmsModel) -> "_Measured":
        """The film with the lower error on fresh films of: the described one, and the mean of the prior."""
        drawn: FreshFilms = fresh_films(films)
        choices = [(films.prior.described, "as described"), (films.prior.mean, "in the middle of all")]
        tried = [(dict(films_errors(films, drawn, parameters)), parameters, word) for parameters, word in choices]
        unknown, parameters, word = min(tried, key=lambda entry: entry[0]["position_rms_mm"])
        others = ", ".join(f"{rival}: {errors['position_rms_mm']:g} mm" for errors, _, rival in tried if rival != word)
        text = (
            f"the film {word}, with a pretension of {1e-6 * parameters[0]:g} MPa.\nThat film errs least over all films "
            f"({unknown['position_rms_mm']:g} mm rms; {others})"
        )
        presses = fresh_presses(films, parameters, PRESSES)
        exact = measure_errors(films.fold(parameters).predict, presses, films.noise)
        return cls(parameters, text, dict(films_errors(films, drawn)), unknown, dict(exact))


def _identity(prior: FilmPrior, config: FilmsConfig) -> dict[str, Any]:
    """All that decides about the weights."""
    return {
        "sensor": sensor_to_dict(prior.sensor),
        "probe": prior.probe.notation,
        "spread": asdict(prior.spread),
        "noise": noise_model(config.noise).to_dict(),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
    }
