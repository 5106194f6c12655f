"""Every other way from charges to contacts, behind one interface, for the report on speed against error.

May import: release, training, data.

    from isocharge.train.baselines import PolynomialRidge, FittingTask

    library, plain = PolynomialRidge().fit(task)   # the same polynomial, by scikit-learn and by NumPy
    contact = plain.predict(charge_pC)             # (n, n_electrode) to (n, 3): x_mm, y_mm, force_N
"""

from isocharge.train.baselines.boosting import GradientBoosting
from isocharge.train.baselines.estimator import Estimator, Fitted, FittingTask
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.gaussian_process import GaussianProcess
from isocharge.train.baselines.linear_band import LinearBand
from isocharge.train.baselines.neighbours import NearestNeighbours
from isocharge.train.baselines.networks import Network, ReleasedModel
from isocharge.train.baselines.polynomial import PolynomialRidge
from isocharge.train.baselines.table import InterpolatedTable, NearestEntry
from isocharge.train.baselines.triangulation import Triangulate

__all__ = [
    "Estimator",
    "Fitted",
    "FittingTask",
    "GaussNewton",
    "GaussianProcess",
    "GradientBoosting",
    "InterpolatedTable",
    "LinearBand",
    "NearestEntry",
    "NearestNeighbours",
    "Network",
    "PolynomialRidge",
    "ReleasedModel",
    "Triangulate",
]
