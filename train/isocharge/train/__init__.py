"""Training of small networks that compute contacts from charges, and calibration of films with measured presses.

A network is trained on a dataset. A trained network is released as a folder that contains an ONNX model and a model
card. Each function in the example can be used on its own. The public names are imported when they are first used,
because the import of PyTorch takes long.

Example:

    from isocharge.simulate import read_dataset
    from isocharge.train import evaluate, fit, release

    fitted = fit(read_dataset(Path("presses")))
    print(evaluate(fitted))
    release(fitted, Path("models/mine"))
"""

from typing import TYPE_CHECKING

from isocharge.common.errors import lazy_names, require

with require("train"):
    import scipy  # noqa: F401 (all modules need it; the error names the extra)

if TYPE_CHECKING:  # each `as` marks a public name (PEP 484); isort would split the statements
    # isort: off
    from isocharge.train.calibration.calibrate import calibrate as calibrate
    from isocharge.train.calibration.contact_error import ProposedPress as ProposedPress, next_presses as next_presses
    from isocharge.train.calibration.film_estimate import FilmEstimate as FilmEstimate
    from isocharge.train.calibration.folder import read_earlier as read_earlier, write_calibration as write_calibration
    from isocharge.train.calibration.problem import CalibrationProblem as CalibrationProblem
    from isocharge.train.calibration.result import CalibrationResult as CalibrationResult
    from isocharge.train.calibration.session import PressSession as PressSession
    from isocharge.train.data.presses import LabelledPresses as LabelledPresses
    from isocharge.train.model_release.evaluate import evaluate as evaluate
    from isocharge.train.model_release.release import Release as Release, release as release
    from isocharge.train.training.config import (
        FitConfig as FitConfig,
        NetworkConfig as NetworkConfig,
        TrainingConfig as TrainingConfig,
        load_config as load_config,
    )
    from isocharge.train.training.cross_fit import fit_presses as fit_presses
    from isocharge.train.training.fit import Fitted as Fitted, fit as fit
    from isocharge.train.training.training_data import TrainingData as TrainingData
else:  # hidden from type checkers, which would otherwise accept every misspelt name
    __getattr__, __dir__, __all__ = lazy_names(__name__, "train")

__version__: str
