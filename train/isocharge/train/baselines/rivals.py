"""The methods of the comparison, a line each."""

from collections.abc import Sequence
from math import comb
from typing import Any

from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.linear_model import Ridge
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, PolynomialFeatures

from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.learned import RULERS, AfterLinear, SubsetProcess, on_logarithms, stretched
from isocharge.train.baselines.linear_band import LinearBand
from isocharge.train.baselines.rival import FittingTask, Rival
from isocharge.train.baselines.table import AffineTable
from isocharge.train.baselines.triangulation import Triangulate

GAUSS_NEWTON, POLYNOMIAL, TABLE = "Gauss-Newton", "polynomial ridge", "lookup table, interpolated"
BOOSTING, LINEAR_BAND = "gradient boosting", "linear band"

DEGREES, MOST_TERMS = (4, 6, 8, 10, 12), 500
"""Candidates for the polynomial's degree, and its monomials at most; more bring nothing under noise and cost time."""

SKLEARN, KD_TREE, NUMPY = "scikit-learn", "SciPy KD-tree", "NumPy"


def rivals(task: FittingTask, charge_map: ChargeMap | None = None) -> list[Rival]:
    """Every method but networks; without a charge map those that need none."""
    domain, rows, quick = task.domain, len(task.train), task.quick
    ruler = FunctionTransformer(stretched, kw_args=RULERS[0])
    rulers = {"regressor__ruler__kw_args": RULERS[1:2] if quick else RULERS}
    trees = HistGradientBoostingRegressor(max_iter=30 if quick else 250, early_stopping=False, random_state=task.seed)
    process = SubsetProcess(300 if quick else 2000, 150 if quick else 500, task.seed)
    return [
        *(triangulations(charge_map) if charge_map else ()),
        Rival(LINEAR_BAND, "paper", KD_TREE, LinearBand(domain.radius), 0, {"degree": (6, 10, 14)}),
        Rival("lookup table, nearest entry", "paper", SKLEARN, on_logarithms(domain, entry=KNeighborsRegressor(1))),
        Rival(
            TABLE,
            "paper",
            KD_TREE,
            on_logarithms(domain, ruler=ruler, table=AffineTable()),
            5,
            {**rulers, "regressor__table__neighbours": (64, 128)},
        ),
        Rival(
            "k-nearest neighbours",
            "learnt",
            SKLEARN,
            on_logarithms(domain, ruler=ruler, near=AfterLinear(KNeighborsRegressor())),
            5,
            {**rulers, "regressor__near__regressor__n_neighbors": [k for k in (16, 32, 64) if k <= rows]},
        ),
        polynomial_ridge(task),
        Rival(
            BOOSTING,
            "learnt",
            SKLEARN,
            on_logarithms(domain, trees=AfterLinear(MultiOutputRegressor(trees))),
            3,
            {"regressor__trees__regressor__estimator__max_leaf_nodes": (31, 63)},
        ),
        Rival("Gaussian process", "learnt", SKLEARN, on_logarithms(domain, process=process), 1),
        gauss_newton(task),
    ]


def triangulations(charge_map: ChargeMap) -> list[Rival]:
    """The paper's method, with the force unknown and given."""
    choice = "contours of the simulated charges"
    return [
        Rival("triangulation", "paper", NUMPY, Triangulate(charge_map), choice=choice),
        Rival(
            "triangulation, force given",
            "paper",
            NUMPY,
            Triangulate(charge_map, given_force=True),
            given_force=True,
            choice=choice,
        ),
    ]


def polynomial_ridge(task: FittingTask) -> Rival:
    """All monomials up to a degree, of logarithms held within [-1, 1]: a high degree explodes beyond what it saw."""
    n_electrode, copies = task.train.charge.shape[1], 5
    few = [degree for degree in range(1, DEGREES[-1] + 1) if comb(n_electrode + degree, degree) <= MOST_TERMS]
    regressor = on_logarithms(
        task.domain,
        box=MinMaxScaler((-1.0, 1.0), clip=True),
        monomials=PolynomialFeatures(),
        ridge=Ridge(solver="cholesky"),
    )
    candidates: dict[str, Sequence[Any]] = {
        "regressor__monomials__degree": [degree for degree in DEGREES if degree in few][-2:] or few[-1:],
        "regressor__ridge__alpha": [share * copies * len(task.train) for share in (1e-11, 1e-8)],
    }
    return Rival(POLYNOMIAL, "learnt", SKLEARN, regressor, copies, candidates)


def gauss_newton(task: FittingTask) -> Rival:
    """The search on a series that is fitted to the presses."""
    return Rival(GAUSS_NEWTON, "fitted map", NUMPY, GaussNewton(task.domain, task.noise, seed=task.seed))
