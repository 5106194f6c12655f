"""Training: a dataset in, a small network that gives contacts from charges out, as an ONNX model with its card.

    from isocharge.simulate import read_dataset
    from isocharge.train import evaluate, fit, release

    fitted = fit(read_dataset(Path("presses")))
    print(evaluate(fitted))
    release(fitted, Path("models/mine"))

Each of the three works alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from isocharge.common.extras import require
from isocharge.common.versions import version_attribute

with require("train"):
    from isocharge.train.bayes.limit import BayesLimit, BayesProblem, bayes_estimate, bayes_limit
    from isocharge.train.calibration.calibrate import CalibrationResult, calibrate
    from isocharge.train.calibration.contact_error import ProposedPress, next_presses
    from isocharge.train.calibration.folder import read_earlier, write_calibration
    from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
    from isocharge.train.calibration.session import PressSession
    from isocharge.train.data.presses import LabelledPresses
    from isocharge.train.films.films_file import read_films
    from isocharge.train.films.films_model import FilmsModel
    from isocharge.train.model_release.evaluate import evaluate
    from isocharge.train.model_release.release import Release, release
    from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig, load_config
    from isocharge.train.training.fitted import Fitted, Provenance

__all__ = [
    "BayesLimit",
    "BayesProblem",
    "CalibrationProblem",
    "CalibrationResult",
    "FilmEstimate",
    "FilmsConfig",
    "FilmsModel",
    "FitConfig",
    "Fitted",
    "LabelledPresses",
    "NetworkConfig",
    "PressSession",
    "ProposedPress",
    "Provenance",
    "Release",
    "Rig",
    "StudentCase",
    "Teacher",
    "TrainingConfig",
    "TrainingData",
    "bayes_estimate",
    "bayes_limit",
    "calibrate",
    "evaluate",
    "fit",
    "fit_films",
    "fit_presses",
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

if TYPE_CHECKING:
    from isocharge.train.films.fit import FilmsConfig, fit_films
    from isocharge.train.films.release import release_films
    from isocharge.train.model_release.student import StudentCase, student_config, student_data
    from isocharge.train.rig.rig_data import Rig, rig_data
    from isocharge.train.training.cross_fit import fit_presses
    from isocharge.train.training.fit import fit
    from isocharge.train.training.source import Teacher, TrainingData
else:  # a type checker would take every misspelt name for a text
    _LATE = {  # with torch, which takes a second
        "FilmsConfig": "films.fit",
        "fit_films": "films.fit",
        "release_films": "films.release",
        "StudentCase": "model_release.student",
        "student_config": "model_release.student",
        "student_data": "model_release.student",
        "Rig": "rig.rig_data",
        "rig_data": "rig.rig_data",
        "fit_presses": "training.cross_fit",
        "fit": "training.fit",
        "Teacher": "training.source",
        "TrainingData": "training.source",
    }
    _other = version_attribute(__name__)

    def __getattr__(name):
        if name not in _LATE:
            return _other(name)
        with require("train"):
            globals()[name] = getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
        return globals()[name]

    del TYPE_CHECKING
