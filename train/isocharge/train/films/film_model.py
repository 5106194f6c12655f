"""A plain served model for one film: the network for all films folded, its graph, errors, golden vectors and card."""

import platform
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.arrays import Array
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.noise import misfit_noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.films.film_presses import draw_contacts, film_charge
from isocharge.train.films.films_model import FilmsModel
from isocharge.train.release.evaluate import measure_errors
from isocharge.train.release.export import export_onnx
from isocharge.train.release.graph_check import check_graph, disk_polygon

PRESSES = 1000
"""Fresh presses on which a film's model is measured and compared with its graph."""

Card = Callable[[ModelMetadata], str]
"""The text of a card, from what the model says about itself."""


def write_film_model(
    films: FilmsModel,
    parameters: Array,
    folder: Path,
    *,
    card: str | Card,
    version: int = 1,
    errors: Mapping[str, float] | None = None,
    made_with: Mapping[str, Any] | None = None,
    further: Mapping[str, bytes] | None = None,
) -> Path:
    """Fold the network for one film and write it as a model, golden vectors included; under a second.

    Args:
        films: The network for all films.
        parameters: Of the film, as in `FilmPrior`, shape (n_parameter,).
        folder: The model's folder; its name is the model's.
        card: Text of the card, or a function that gives it.
        version: Number of the version folder.
        errors: For the metadata; measured on fresh presses of the film if absent.
        made_with: For the metadata, beside the versions of isocharge and Python: the command, for one.
        further: More files for the version folder, by name.

    Returns:
        The version folder.

    Raises:
        OutputExists: If the version exists already.
        ModelError: If the folder holds a model with other electrodes.
        SceneError: If the film is outside the family.
        TrainingError: If graph and network disagree.
    """
    sensor, probe = films.prior.film(parameters)
    check_target(folder, version, sensor.electrode_names)
    network, presses = films.fold(parameters), fresh_presses(films, parameters, PRESSES)
    about = ModelMetadata(
        name=folder.resolve().name,
        version=version,
        sensor=sensor_to_dict(sensor),
        electrodes=sensor.electrode_names,
        working_area_mm=disk_polygon(films.domain),
        probes=(probe.notation,),
        force_range_N=films.domain.force_range_N,
        noise=films.noise.to_dict(),
        dataset_sha256=films.sha256,
        errors=measure_errors(network.predict, presses, films.noise) if errors is None else errors,
        made_with={
            "isocharge": metadata.version("isocharge"),
            "python": platform.python_version(),
            **(made_with or {}),
        },
    )
    graph = export_onnx(network, about.to_props())
    golden = check_graph(graph, network.predict, presses, misfit_noise(films.noise))
    return write_model(folder, graph, about, golden, card if isinstance(card, str) else card(about), further or {})


def fresh_presses(films: FilmsModel, parameters: Array, count: int, seed: int = 11) -> LabelledPresses:
    """Presses of one film, with its forward map's charges."""
    contact = draw_contacts(np.random.default_rng(seed), films.domain, count)
    return LabelledPresses(contact, film_charge(films.prior, films.family, parameters, contact))
