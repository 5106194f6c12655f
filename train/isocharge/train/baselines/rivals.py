"""The methods of the comparison, a line each, behind one interface: a regressor as scikit-learn has them, charges in
and contacts out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import comb
from typing import Any, Literal, Protocol, Self

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.linear_model import Ridge
from sklearn.model_selection import ParameterGrid
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, PolynomialFeatures

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeMap, Domain, NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.learned import RULERS, AfterLinear, SubsetProcess, on_logarithms, stretched
from isocharge.train.baselines.paper import AffineTable, LinearBand, Triangulate
from isocharge.train.data.presses import LabelledPresses, position_error

Kind = Literal["paper", "learnt", "fitted map", "network"]

FIRST_COPY, VALIDATION_COPY = 1000, 999
"""Seeds of the noise, relative to the task's, on training and validation presses."""


class GivenMethod(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """A method that learns nothing from presses."""

    def fit(self, charge: Array, contact: Array) -> Self:
        """It is as it was given."""
        del charge, contact
        return self


class Regressor(Protocol):
    """What is compared; with scikit-learn's `BaseEstimator`, which copies it and sets its parameters."""

    def fit(self, charge: Array, contact: Array) -> Any:
        """Learn from charges, shape (n, n_electrode), pC, and contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            DatasetError: If the presses cannot teach this method.
        """

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3); NaN where the method has no answer."""


@dataclass(frozen=True)
class FittingTask:
    """What methods are fitted for.

    Attributes:
        train: Presses to learn from, clean or measured.
        validation: Presses at other positions, to choose parameters by.
        domain: The contacts that can occur: uniform over a disk, log-uniform in force.
        noise: What will be on the charges.
        seed: Of noise and subsets.
        quick: Take the first candidate and one noisy copy, to try things out.
    """

    train: LabelledPresses
    validation: LabelledPresses
    domain: Domain
    noise: NoiseModel
    seed: int = 0
    quick: bool = False

    def presses(self, copies: int) -> LabelledPresses:
        """Copies of the training presses with fresh noise; measured ones, or those of no copies, as they are."""
        if self.train.measured or not copies:
            return self.train
        count = 1 if self.quick else copies
        charge = [self.train.noisy(self.noise, self.seed + FIRST_COPY + copy) for copy in range(count)]
        return LabelledPresses(np.tile(self.train.contact, (count, 1)), np.concatenate(charge))

    @cached_property
    def validation_charge(self) -> Array:
        """Charges of the validation presses, with noise."""
        if self.validation.measured:
            return self.validation.charge
        return self.validation.noisy(self.noise, self.seed + VALIDATION_COPY)


@dataclass(frozen=True)
class Rival:
    """A method, and how it is fitted at its best.

    Attributes:
        name: In tables and pictures.
        kind: In pictures.
        computed_by: What computes it.
        regressor: Before it is fitted.
        copies: Noisy copies of the presses that it learns from; 0 for clean presses.
        candidates: Values of its parameters, of which validation chooses.
        given_force: Whether it is given the true force behind the charges, which no sensor knows.
        choice: Parameters and how they were chosen; once it is fitted.
    """

    name: str
    kind: Kind
    computed_by: str
    regressor: Regressor
    copies: int = 0
    candidates: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    given_force: bool = False
    choice: str = ""

    def inputs(self, charge: Array, force: Array) -> Array:
        """What it is given of presses, shape (n, n_electrode) or one column more."""
        return np.column_stack([charge, force]) if self.given_force else charge

    def fit(self, task: FittingTask) -> "Rival":
        """Fitted with each of the candidates; the one with the least error on noisy validation presses.

        Raises:
            DatasetError: If the presses cannot teach this method.
        """
        presses = task.presses(self.copies)
        tried = list(ParameterGrid(dict(self.candidates)))[: 1 if task.quick else None]
        fitted = [clone(self.regressor).set_params(**parameters) for parameters in tried]
        errors = []
        for regressor in fitted:
            regressor.fit(presses.charge, presses.contact)
            answers = regressor.predict(self.inputs(task.validation_charge, task.validation.contact[:, 2]))
            errors.append(rms(position_error(answers, task.validation.contact)))
        best = int(np.argmin(errors))
        chosen = [*map(described, tried[best].items()), f"{len(presses)} {'noisy' if self.copies else 'clean'} presses"]
        if len(tried) > 1:
            chosen.append(f"best of {len(tried)} by validation ({errors[best]:.3f} mm rms)")
        return replace(self, regressor=fitted[best], choice=self.choice or ", ".join(chosen))


def described(parameter: tuple[str, object]) -> str:
    """A parameter, name and value, for people; factors of axes by the names of the axes."""
    name, value = parameter
    if isinstance(value, Mapping):
        return ", ".join(f"{axis} axis x {factor:g}" for axis, factor in value.items())
    return f"{name.rpartition('__')[2]} {value:g}" if isinstance(value, int | float) else f"{name} {value}"


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
    triangulations, contours = [], "contours of the simulated charges"
    if charge_map:
        known = Triangulate(charge_map, given_force=True)
        triangulations = [
            Rival("triangulation", "paper", NUMPY, Triangulate(charge_map), choice=contours),
            Rival("triangulation, force given", "paper", NUMPY, known, given_force=True, choice=contours),
        ]
    return [
        *triangulations,
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
        Rival(GAUSS_NEWTON, "fitted map", NUMPY, GaussNewton(domain, task.noise, seed=task.seed)),
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
