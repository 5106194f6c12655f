"""The network for all films that fits a sensor: looked up by its electrodes, not by its name."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError, SceneError, SensorError
from isocharge.serve.model.repository import find_model, model_names, repositories
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.train.calibration.calibrate import CalibrationScene, EarlierFilm
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.films.films_file import FILE, read_films
from isocharge.train.films.films_model import FilmsModel


@dataclass(frozen=True)
class SensorFilms:
    """What a sensor is calibrated with.

    Attributes:
        films: The network for all films, with their forward maps.
        described: What the sensor's file says, as the prior of its calibration.
    """

    films: FilmsModel
    described: EarlierFilm

    @property
    def scene(self) -> CalibrationScene:
        """The scene of a calibration."""
        return CalibrationScene(FilmCharges(self.films.prior, self.films.family), self.films.domain, self.films.noise)


def films_for(sensor: Sensor, probe: Probe, models: Path | None = None) -> SensorFilms:
    """The network for all films of a sensor's layout.

    Args:
        sensor: Its electrodes, radius and readout must be those of a network's; everything else may differ within the
            spread of its films.
        probe: What presses; it must be round, and its radius within the spread as well.
        models: Folder of models that is searched first.

    Raises:
        SceneError: If the probe is not round.
        ModelError: If no network was trained for this layout; the message says how to train one.
    """
    if not isinstance(probe, Circle):
        raise SceneError(
            f"probe {probe.notation}: expected a round one, such as circle:1.0, for its radius is calibrated as well"
        )
    reasons = []
    for folder in _candidates(models, sensor.name):
        films = read_films(folder)
        try:
            parameters = films.prior.parameters_of(sensor, probe)
        except SensorError as error:
            reasons.append(f"{folder.parent.name}: {error}")
            continue
        low, high = films.prior.bounds
        outside = (parameters < low) | (parameters > high)
        if outside.any():
            names = ", ".join(np.array(films.prior.names)[outside])
            reasons.append(f"{folder.parent.name}: {names}: farther from its films than it was trained for")
            continue
        return SensorFilms(films, EarlierFilm(_centred(films, parameters), np.eye(parameters.size)))
    raise ModelError(
        f"no network for all films fits the sensor {sensor.name!r} under {probe.notation} "
        f"({'; '.join(reasons) or 'none is installed'}); train one first, once for a layout: "
        f"isocharge train fit --films --sensor SENSOR -o models/{sensor.name}-films"
    )


def _candidates(models: Path | None, name: str) -> list[Path]:
    """Version folders with a films file, those named after the sensor first."""
    names = [(root, model) for root in repositories(models) for model in model_names(root)]
    folders = [find_model((root / model).resolve()) for root, model in names]
    with_films = [folder for folder in folders if (folder / FILE).is_file()]
    return sorted(with_films, key=lambda folder: not folder.parent.name.startswith(name))


def _centred(films: FilmsModel, parameters: Array) -> Array:
    """A sensor file that gives no pretension does not say that there is none."""
    if parameters[0] > 0.0:
        return parameters
    centred = parameters.copy()
    centred[0] = films.prior.mean[0]
    return centred
