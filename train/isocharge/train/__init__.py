"""Training of small networks that compute contacts from charges, and calibration of films with measured presses.

A network is trained on a dataset. It is then released as a folder that contains an ONNX model and a model card. Each
function in the example can be used on its own. The public names are imported when they are first used, because the
import of PyTorch takes long.

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

if TYPE_CHECKING:
    from isocharge.train.calibration.calibrate import calibrate
    from isocharge.train.calibration.contact_error import ProposedPress, next_presses
    from isocharge.train.calibration.film_estimate import FilmEstimate
    from isocharge.train.calibration.folder import read_earlier, write_calibration
    from isocharge.train.calibration.problem import CalibrationProblem
    from isocharge.train.calibration.result import CalibrationResult
    from isocharge.train.calibration.session import PressSession
    from isocharge.train.data.presses import LabelledPresses
    from isocharge.train.model_release.evaluate import evaluate
    from isocharge.train.model_release.release import Release, release
    from isocharge.train.training.config import FitConfig, NetworkConfig, TrainingConfig, load_config
    from isocharge.train.training.cross_fit import fit_presses
    from isocharge.train.training.fit import Fitted, fit
    from isocharge.train.training.training_data import TrainingData
else:  # hidden from type checkers, which would otherwise accept every misspelt name
    __getattr__ = lazy_names(__name__, "train")

__all__ = [
    "CalibrationProblem",
    "CalibrationResult",
    "FilmEstimate",
    "FitConfig",
    "Fitted",
    "LabelledPresses",
    "NetworkConfig",
    "PressSession",
    "ProposedPress",
    "Release",
    "TrainingConfig",
    "TrainingData",
    "calibrate",
    "evaluate",
    "fit",
    "fit_presses",
    "load_config",
    "next_presses",
    "read_earlier",
    "release",
    "write_calibration",
]

__version__: str


def __dir__() -> list[str]:
    """Return the public names, so that tab completion suggests no other names."""
    return list(__all__)
