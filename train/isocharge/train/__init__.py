"""Training: a dataset in, a small network that gives contacts from charges out, as an ONNX model with its card.

    from isocharge.simulate import read_dataset
    from isocharge.train import evaluate, fit, release

    fitted = fit(read_dataset(Path("presses")))
    print(evaluate(fitted))
    release(fitted, Path("models/mine"))
"""

from typing import TYPE_CHECKING

from isocharge.common.extras import require
from isocharge.common.versions import version_attribute

with require("train"):
    from isocharge.train.bayes.limit import BayesLimit, BayesProblem, bayes_estimate, bayes_limit
    from isocharge.train.calibration.calibrate import CalibrationProblem, CalibrationResult, EarlierFilm, calibrate
    from isocharge.train.calibration.films_for import SensorFilms, films_for
    from isocharge.train.calibration.folder import read_earlier, write_calibration
    from isocharge.train.calibration.next_press import ProposedPress, next_presses
    from isocharge.train.calibration.session import BenchSession
    from isocharge.train.data.presses import LabelledPresses
    from isocharge.train.films.config import FilmsConfig
    from isocharge.train.films.films_file import read_films
    from isocharge.train.films.films_model import FilmsModel
    from isocharge.train.films.fit import fit_films
    from isocharge.train.films.release import release_films
    from isocharge.train.release.evaluate import evaluate
    from isocharge.train.release.release import Release, release
    from isocharge.train.release.student import StudentCase, student_config, student_data
    from isocharge.train.rig.train_rig import Rig, rig_data
    from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig, load_config
    from isocharge.train.training.fit import Fitted, fit
    from isocharge.train.training.source import Provenance, Teacher, TrainingData

__all__ = [
    "BayesLimit",
    "BayesProblem",
    "BenchSession",
    "CalibrationProblem",
    "CalibrationResult",
    "EarlierFilm",
    "FilmsConfig",
    "FilmsModel",
    "FitConfig",
    "Fitted",
    "LabelledPresses",
    "NetworkConfig",
    "ProposedPress",
    "Provenance",
    "Release",
    "Rig",
    "SensorFilms",
    "StudentCase",
    "Teacher",
    "TrainingConfig",
    "TrainingData",
    "bayes_estimate",
    "bayes_limit",
    "calibrate",
    "evaluate",
    "films_for",
    "fit",
    "fit_films",
    "load_config",
    "next_presses",
    "read_earlier",
    "read_films",
    "release",
    "release_films",
    "rig_data",
    "student_config",
    "student_data",
    "write_calibration",
]

__version__: str
if not TYPE_CHECKING:  # a type checker would take every misspelt name for a text
    __getattr__ = version_attribute(__name__)
