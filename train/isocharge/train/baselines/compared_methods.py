"""The methods that a report compares: regressors with the interface of scikit-learn, from charges to contacts."""

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
from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.simulate import ChargeMap, Domain, NoiseModel
from isocharge.train.baselines.gauss_newton import GaussNewton
from isocharge.train.baselines.learned import AXIS_SCALES, ResidualRegressor, SubsetProcess, on_logarithms, scale_axes
from isocharge.train.baselines.paper import AffineTable, LinearBand, Triangulate
from isocharge.train.data.presses import LabelledPresses

Kind = Literal["paper", "learnt", "fitted map", "network"]
"""Kind of a method. Each kind has a colour in pictures."""

FIRST_COPY_SEED = 1000
"""Seed of the noise on the first copy of the training presses, relative to the seed of the task."""

VALIDATION_SEED = 999
"""Seed of the noise on the validation presses, relative to the seed of the task."""


class GivenMethod(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """A method that is not fitted to presses."""

    def fit(self, charge: Array, contact: Array) -> Self:
        """Return the unchanged method. The presses are not used."""
        del charge, contact
        return self


class Regressor(Protocol):
    """Interface of the methods. A method also derives from scikit-learn's `BaseEstimator`, so that it can be cloned."""

    def fit(self, charge: Array, contact: Array) -> Any:
        """Fit the method to presses.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            DatasetError: If the method cannot be fitted to these presses.
        """

    def predict(self, charge: Array) -> Array:
        """Estimate contacts, shape (n, 3), mm and N; NaN where the method has no answer."""


@dataclass(frozen=True)
class FittingTask:
    """Training presses, validation presses and conditions for the fits of all methods.

    Attributes:
        train: Presses for training, measured or without noise.
        validation: Presses at other positions, for the choice of parameters.
        domain: Contacts that can occur: uniform over a disk, log-uniform in force.
        noise: Noise of the charges in use.
        seed: Seed of noise and subsets.
        quick: Whether to use only the first candidate of the parameters and one copy with noise, for a trial.
    """

    train: LabelledPresses
    validation: LabelledPresses
    domain: Domain
    noise: NoiseModel
    seed: int = 0
    quick: bool = False

    def presses(self, copies: int) -> LabelledPresses:
        """Return copies of the training presses with different noise; a quick task has only one copy.

        Args:
            copies: Number of copies; 0 for the presses without noise. Measured presses are returned as they are.
        """
        if self.train.measured or copies == 0:
            return self.train
        count = 1 if self.quick else copies
        first_seed = self.seed + FIRST_COPY_SEED
        contact = np.tile(self.train.contact, (count, 1))
        charge = np.concatenate([self.train.noisy(self.noise, first_seed + copy) for copy in range(count)])
        return LabelledPresses(contact, charge)

    @cached_property
    def validation_charge(self) -> Array:
        """Charges of the validation presses with noise, shape (n, n_electrode), pC."""
        if self.validation.measured:
            return self.validation.charge
        return self.validation.noisy(self.noise, self.seed + VALIDATION_SEED)


@dataclass(frozen=True)
class ComparedMethod:
    """A method of the comparison, with everything that is needed to fit it.

    Attributes:
        name: Name in tables and pictures.
        kind: Kind of the method, which determines the colour in pictures.
        computed_by: Library that computes the method.
        regressor: The method; not fitted before `fit`.
        copies: Number of noisy copies of the presses to which the method is fitted; 0 for presses without noise.
        candidates: Candidate values of the parameters of the method, by the name of the parameter. The values with the
            smallest error on the validation presses are used.
        given_force: Whether the method gets the true force in addition to the charges. No sensor measures this force.
        choice: The chosen parameters in words, and how they were chosen; empty before `fit`.
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
        """Return the inputs of the method.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            force: True forces, shape (n,), N.

        Returns:
            The charges; with the force as an additional last column if `given_force` is set.
        """
        return np.column_stack([charge, force]) if self.given_force else charge

    def fit(self, task: FittingTask) -> "ComparedMethod":
        """Fit the method with each candidate, and return the fit with the smallest error on the validation presses.

        Args:
            task: Presses for the fit and for the validation.

        Returns:
            The fitted method, with a text about the chosen parameters.

        Raises:
            DatasetError: If the method cannot be fitted to these presses.
        """
        presses = task.presses(self.copies)
        true_contact = task.validation.contact
        validation_inputs = self.inputs(task.validation_charge, true_contact[:, 2])  # with the true force if it is used
        parameter_sets = list(ParameterGrid(dict(self.candidates)))
        if task.quick:
            parameter_sets = parameter_sets[:1]

        regressors = []
        errors_mm = []
        for parameters in parameter_sets:
            regressor = clone(self.regressor).set_params(**parameters)
            regressor.fit(presses.charge, presses.contact)
            estimate = regressor.predict(validation_inputs)
            regressors.append(regressor)
            errors_mm.append(rms(position_error(estimate, true_contact)))
        best_index = int(np.argmin(errors_mm))

        # The text that describes the chosen parameters
        descriptions = [describe_parameter(name, value) for name, value in parameter_sets[best_index].items()]
        noise_word = "noisy" if self.copies else "clean"
        descriptions.append(f"{len(presses)} {noise_word} presses")
        if len(parameter_sets) > 1:
            best_error_mm = errors_mm[best_index]
            descriptions.append(f"best of {len(parameter_sets)} by validation ({best_error_mm:.3f} mm rms)")
        return replace(self, regressor=regressors[best_index], choice=self.choice or ", ".join(descriptions))


def describe_parameter(name: str, value: object) -> str:
    """Return a text that describes a parameter of a pipeline.

    Args:
        name: Name of the parameter, after the names of the steps: "step__parameter".
        value: Value of the parameter. A mapping contains factors by the names of axes.

    Example:
        >>> describe_parameter("regressor__neighbours", 8)
        'neighbours 8'
    """
    if isinstance(value, Mapping):
        return ", ".join(f"{axis} axis x {factor:g}" for axis, factor in value.items())
    if isinstance(value, int | float):
        _, _, short_name = name.rpartition("__")
        return f"{short_name} {value:g}"
    return f"{name} {value}"


GAUSS_NEWTON = "Gauss-Newton"
"""Name of the maximum a posteriori estimate by the Gauss-Newton method (`GaussNewton`)."""

POLYNOMIAL = "polynomial ridge"
"""Name of the ridge regression on monomials (`polynomial_ridge`)."""

TABLE = "lookup table, interpolated"
"""Name of the lookup table with affine maps (`AffineTable`)."""

BOOSTING = "gradient boosting"
"""Name of the gradient boosting of regression trees."""

LINEAR_BAND = "linear band"
"""Name of the method that assumes charges proportional to the force (`LinearBand`)."""

POLYNOMIAL_DEGREES = (4, 6, 8, 10, 12)
"""Candidates for the degree of the polynomial."""

MAX_MONOMIALS = 500
"""Largest number of monomials of the polynomial. More monomials take longer and do not reduce the error under noise."""

SKLEARN = "scikit-learn"
"""Name in tables of the library that computes most methods."""

KD_TREE = "SciPy KD-tree"
"""Name in tables of the library part that finds nearest neighbours."""

NUMPY = "NumPy"
"""Name in tables of the library that computes methods without another library."""


def compared_methods(task: FittingTask, charge_map: ChargeMap | None = None) -> list[ComparedMethod]:
    """Return all compared methods except the networks.

    Args:
        task: Presses and conditions.
        charge_map: Map for the methods that need one; None to leave these methods out.
    """
    domain = task.domain
    return [
        *_triangulations(charge_map),
        ComparedMethod(LINEAR_BAND, "paper", KD_TREE, LinearBand(domain.radius), candidates={"degree": (6, 10, 14)}),
        ComparedMethod(
            "lookup table, nearest entry", "paper", SKLEARN, on_logarithms(domain, entry=KNeighborsRegressor(1))
        ),
        _interpolated_table(task),
        _nearest_neighbours(task),
        polynomial_ridge(task),
        _gradient_boosting(task),
        _gaussian_process(task),
        ComparedMethod(GAUSS_NEWTON, "fitted map", NUMPY, GaussNewton(domain, task.noise, seed=task.seed)),
    ]


def polynomial_ridge(task: FittingTask) -> ComparedMethod:
    """Return ridge regression on all monomials up to a degree.

    The logarithms are clipped to the range of the training presses, because a polynomial of high degree grows fast
    beyond it. The two largest degrees of `POLYNOMIAL_DEGREES` with at most `MAX_MONOMIALS` monomials are compared.

    Args:
        task: Presses for the fit.
    """
    n_electrode = task.train.charge.shape[1]
    copies = 5
    # A polynomial of n variables up to the degree d has "n + d choose d" monomials.
    allowed_degrees = [
        degree
        for degree in range(1, max(POLYNOMIAL_DEGREES) + 1)
        if comb(n_electrode + degree, degree) <= MAX_MONOMIALS
    ]
    degrees = [degree for degree in POLYNOMIAL_DEGREES if degree in allowed_degrees][-2:]
    if not degrees:
        degrees = [max(allowed_degrees)]

    regressor = on_logarithms(
        task.domain,
        box=MinMaxScaler((-1.0, 1.0), clip=True),
        monomials=PolynomialFeatures(),
        ridge=Ridge(solver="cholesky"),
    )
    # The penalty is proportional to the number of presses, as the sum of the squared errors is.
    penalties = [penalty_per_press * copies * len(task.train) for penalty_per_press in (1e-11, 1e-8)]
    candidates: dict[str, Sequence[Any]] = {
        "regressor__monomials__degree": degrees,
        "regressor__ridge__alpha": penalties,
    }
    return ComparedMethod(POLYNOMIAL, "learnt", SKLEARN, regressor, copies=copies, candidates=candidates)


def _triangulations(charge_map: ChargeMap | None) -> list[ComparedMethod]:
    """Return triangulation without and with the true force. The result is empty if there is no charge map.

    Args:
        charge_map: Simulated map from contacts to charges; None if there is none.
    """
    if charge_map is None:
        return []
    choice = "contours of the simulated charges"
    without_force = Triangulate(charge_map)
    with_force = Triangulate(charge_map, given_force=True)
    return [
        ComparedMethod("triangulation", "paper", NUMPY, without_force, choice=choice),
        ComparedMethod("triangulation, force given", "paper", NUMPY, with_force, given_force=True, choice=choice),
    ]


def _scaled_axes() -> FunctionTransformer:
    """Return the transformer that scales the principal axes before distances are computed."""
    return FunctionTransformer(scale_axes, kw_args=AXIS_SCALES[0])


def _axis_scale_candidates(task: FittingTask) -> dict[str, Sequence[Any]]:
    """Return the candidates for the factors of the principal axes; a quick task has only one candidate."""
    candidates = AXIS_SCALES[1:2] if task.quick else AXIS_SCALES
    return {"regressor__scales__kw_args": candidates}


def _interpolated_table(task: FittingTask) -> ComparedMethod:
    """Return the lookup table with affine maps."""
    regressor = on_logarithms(task.domain, scales=_scaled_axes(), table=AffineTable())
    candidates = _axis_scale_candidates(task) | {"regressor__table__neighbours": (64, 128)}
    return ComparedMethod(TABLE, "paper", KD_TREE, regressor, copies=5, candidates=candidates)


def _nearest_neighbours(task: FittingTask) -> ComparedMethod:
    """Return a regressor that adds the mean residual of the nearest neighbours to a linear regression.

    Args:
        task: Presses and conditions for the fit.
    """
    neighbours = ResidualRegressor(KNeighborsRegressor())
    regressor = on_logarithms(task.domain, scales=_scaled_axes(), near=neighbours)
    counts = [count for count in (16, 32, 64) if count <= len(task.train)]
    candidates = _axis_scale_candidates(task) | {"regressor__near__regressor__n_neighbors": counts}
    return ComparedMethod("k-nearest neighbours", "learnt", SKLEARN, regressor, copies=5, candidates=candidates)


def _gradient_boosting(task: FittingTask) -> ComparedMethod:
    """Return gradient boosting of regression trees on the residuals of a linear regression.

    Args:
        task: Conditions of the fit: the domain, the seed, and whether fewer trees suffice.
    """
    iterations = 30 if task.quick else 250
    trees = HistGradientBoostingRegressor(max_iter=iterations, early_stopping=False, random_state=task.seed)
    regressor = on_logarithms(task.domain, trees=ResidualRegressor(MultiOutputRegressor(trees)))
    candidates = {"regressor__trees__regressor__estimator__max_leaf_nodes": (31, 63)}
    return ComparedMethod(BOOSTING, "learnt", SKLEARN, regressor, copies=3, candidates=candidates)


def _gaussian_process(task: FittingTask) -> ComparedMethod:
    """Return a Gaussian process on a subset of the presses."""
    points, kernel_points = (300, 150) if task.quick else (2000, 500)
    process = SubsetProcess(points, kernel_points, task.seed)
    regressor = on_logarithms(task.domain, process=process)
    return ComparedMethod("Gaussian process", "learnt", SKLEARN, regressor, copies=1)
