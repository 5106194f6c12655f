"""Every other way from charges to contacts, behind one interface, for the report on speed against error.

from isocharge.train.rivals import PolynomialRidge, Task

library, plain = PolynomialRidge().fit(task)   # the same polynomial, by scikit-learn and by NumPy
contact = plain.predict(charge_pC)             # (n, n_electrode) to (n, 3): x_mm, y_mm, force_N
"""

from isocharge.train.rivals.boosting import GradientBoosting
from isocharge.train.rivals.estimator import Estimator, Fitted, Task
from isocharge.train.rivals.gauss_newton import GaussNewton
from isocharge.train.rivals.gaussian_process import GaussianProcess
from isocharge.train.rivals.linear_band import LinearBand
from isocharge.train.rivals.neighbours import NearestNeighbours
from isocharge.train.rivals.networks import Network, ReleasedModel
from isocharge.train.rivals.polynomial import PolynomialRidge
from isocharge.train.rivals.table import InterpolatedTable, NearestEntry
from isocharge.train.rivals.triangulation import Triangulate

__all__ = [
    "Estimator",
    "Fitted",
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
    "Task",
    "Triangulate",
]
