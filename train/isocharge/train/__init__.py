"""Training: a dataset in, a small network that gives contacts from charges out, as an ONNX model with its card.

A few lines make a model from a dataset.

    from isocharge.simulate import read_dataset
    from isocharge.train import train_model

    release = train_model(read_dataset(Path("presses")), Path("models/mine"))
    print(release.metadata.errors)
"""

from typing import TYPE_CHECKING

from isocharge.common.extras import require
from isocharge.common.versions import version_attribute

with require("train"):
    from isocharge.train.bayes.limit import BayesLimit, Scene, bayes_estimate, bayes_limit
    from isocharge.train.calibration.calibrate import Calibration, CalibrationScene, EarlierFilm, calibrate
    from isocharge.train.calibration.films_for import SensorFilms, films_for
    from isocharge.train.calibration.folder import read_earlier, write_calibration
    from isocharge.train.calibration.next_press import ProposedPress, next_presses
    from isocharge.train.calibration.session import BenchSession
    from isocharge.train.films.config import FilmsConfig
    from isocharge.train.films.films_file import read_films
    from isocharge.train.films.films_model import FilmsModel, write_film_model
    from isocharge.train.films.release import train_films
    from isocharge.train.release.evaluate import measure_errors
    from isocharge.train.release.release import Release, train_model
    from isocharge.train.release.student import TaughtScene, distil_model, student_config
    from isocharge.train.rig.train_rig import Rig, train_rig
    from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig, load_config
    from isocharge.train.training.fit import Fit, fit_network

__all__ = [
    "BayesLimit",
    "BenchSession",
    "Calibration",
    "CalibrationScene",
    "EarlierFilm",
    "FilmsConfig",
    "FilmsModel",
    "Fit",
    "FitConfig",
    "NetworkConfig",
    "ProposedPress",
    "Release",
    "Rig",
    "Scene",
    "SensorFilms",
    "TaughtScene",
    "TrainingConfig",
    "bayes_estimate",
    "bayes_limit",
    "calibrate",
    "distil_model",
    "films_for",
    "fit_network",
    "load_config",
    "measure_errors",
    "next_presses",
    "read_earlier",
    "read_films",
    "student_config",
    "train_films",
    "train_model",
    "train_rig",
    "write_calibration",
    "write_film_model",
]

__version__: str
if not TYPE_CHECKING:  # a type checker would take every misspelt name for a text
    __getattr__ = version_attribute(__name__)
