"""A network for all films as it is used: folded for one film, and written as a plain served model of it."""

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import check_target, write_model
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import misfit_noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.films.conditional_network import ConditionalWeights
from isocharge.train.films.film_presses import draw_contacts, film_charge
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.fit import FilmsFit
from isocharge.train.release.evaluate import measure_errors
from isocharge.train.release.export import export_onnx
from isocharge.train.release.folding import FoldedLayers, FoldedNetwork, answer_units
from isocharge.train.release.graph_check import check_graph, disk_polygon

PRESSES = 1000
"""Fresh presses on which a film's model is measured and compared with its graph."""

Card = Callable[[ModelMetadata], str]
"""The text of a card, from what the model says about itself."""


@dataclass(frozen=True)
class FilmsModel:
    """What is needed for a model of any film of a prior; no torch in it.

    Attributes:
        family: Forward maps of the films.
        scaling: Exact scales and context of films; holds prior and domain.
        mean: Of the logarithms of the charges (pC) with the exact scales divided out, shape (n_electrode,).
        whitening: Shape (n_electrode, n_electrode).
        contact: Weights of the contact network.
        misfit: Weights of the misfit network.
        noise: Noise of the training.
        sha256: Checksum of the file that it was read from, or "".
    """

    family: FilmFamily
    scaling: FilmScaling
    mean: Array
    whitening: Array
    contact: ConditionalWeights
    misfit: ConditionalWeights
    noise: NoiseModel
    sha256: str = ""

    @classmethod
    def of(cls, fit: FilmsFit, noise: NoiseModel) -> "FilmsModel":
        """What a training gave, in full precision."""
        inputs = fit.inputs
        contact, misfit = ConditionalWeights(fit.contact), ConditionalWeights(fit.misfit)
        return cls(fit.family, inputs.scaling, inputs.mean, inputs.whitening, contact, misfit, noise)

    @property
    def prior(self) -> FilmPrior:
        """The films: the sensor as described, the probe, and how far films spread."""
        return self.scaling.prior

    @property
    def domain(self) -> ContactDomain:
        """The contacts that the network knows."""
        return self.scaling.domain

    def fold(self, parameters: Array) -> FoldedNetwork:
        """The plain network of one film, parameters as in `FilmPrior`, shape (n_parameter,); some milliseconds.

        Raises:
            InputError: If there are not as many finite parameters as the prior names.
        """
        parameters = np.asarray(parameters, dtype=float)
        if parameters.shape != (len(self.prior.names),) or not np.isfinite(parameters).all():
            raise InputError(
                f"film: expected {len(self.prior.names)} finite parameters ({', '.join(self.prior.names)}), got "
                f"{parameters.tolist()}"
            )
        context = self.scaling.context(parameters)
        perceptrons = [weights.plain(context) for weights in (self.contact, self.misfit)]
        logs_mean = self.mean + self.scaling.log_charge_scale(parameters)
        typical = 2.0 ** np.round(logs_mean / np.log(2.0))
        turn, offset = self.scaling.turn(parameters), self.scaling.offset(parameters)
        units = answer_units(self.domain, turn, offset, self.mean.size)
        return FoldedNetwork(FoldedLayers.of(perceptrons, self.whitening, logs_mean - np.log(typical), units), typical)


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
    widen: tuple[float, float] = (1.0, 1.0),
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
        widen: Factors on the deviations of position and force, for what is not known of the film.

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
    network = films.fold(parameters).widened(*widen)
    presses = fresh_presses(films, parameters, PRESSES)
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
