"""Public names of `isocharge.train` whose import also imports PyTorch. They are imported when they are first used."""

from isocharge.train.films.fit import FilmsConfig as FilmsConfig
from isocharge.train.films.fit import fit_films as fit_films
from isocharge.train.films.release import release_films as release_films
from isocharge.train.model_release.student import StudentCase as StudentCase
from isocharge.train.model_release.student import student_config as student_config
from isocharge.train.model_release.student import student_data as student_data
from isocharge.train.rig.rig_data import Rig as Rig
from isocharge.train.rig.rig_data import rig_data as rig_data
from isocharge.train.training.cross_fit import fit_presses as fit_presses
from isocharge.train.training.fit import fit as fit
from isocharge.train.training.source import Teacher as Teacher
from isocharge.train.training.source import TrainingData as TrainingData
