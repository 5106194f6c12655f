"""Methods that a report compares: regressors with the interface of scikit-learn that estimate contacts from charges."""

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
from isocharge.train.baselines.learned import (
    AXIS_SCALES,
    ResidualRegressor,
    SubsetProcess,
    log_charge_regressor,
    scale_axes,
)
from isocharge.train.baselines.paper import AffineTable, LinearBand, Triangulate
from isocharge.train.data.presses import LabelledPresses

Kind = Literal["paper", "learnt", "fitted map", "network"]
"""Kind of a method. Each kind has a colour in pictures."""

FIRST_COPY_SEED = 1000
"""Seed of the noise on the first copy of the training presses, relative to the seed of the task."""

VALIDATION_SEED = 999
"""Seed of the noise on the validation presses, relative to the seed of the task."""


class GivenMethod(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Base class of methods that are not fitted to presses."""

    def fit(self, charge: Array, contact: Array) -> Self:
        """Return the unchanged method. The presses are not used."""
        del charge, contact
        return self


class Regressor(Protocol):
    """Interface of all compared methods.

    The methods also derive from `BaseEstimator` of scikit-learn, so that they can be cloned.
    """

    def fit(self, charge: Array, contact: Array) -> Any:
        """Fit the method to presses.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            DatasetError: If the method cannot be fitted to these presses.
        """

    def predict(self, charge: Array) -> Array:
        """Estimate contacts (x, y, F), shape (n, 3), mm and N. Without an estimate, the contact is NaN."""


@dataclass(frozen=True)
class FittingTask:
    """Training presses, validation presses and conditions for the fits of all methods.

    Attributes:
        train: Presses for training. Simulated presses have no noise.
        validation: Presses at other positions, for the choice of parameters.
        domain: Contacts that can occur. Their positions are uniformly distributed over a disk, and their forces are
            log-uniform.
        noise: Noise of the charges when the methods are used.
        seed: Seed of the noise and of random subsets.
        quick: Whether to use only the first candidate of the parameters and only one copy with noise, for a trial run.
    """

    train: LabelledPresses
    validation: LabelledPresses
    domain: Domain
    noise: NoiseModel
    seed: int = 0
    quick: bool = False

    def presses(self, copies: int) -> LabelledPresses:
        """Return the training presses, or several copies of these presses with different noise in each copy.

        Args:
            copies: Number of copies; 0 for the presses without noise. A quick task has at most one copy.

        Returns:
            The presses of all copies, one copy after the other. Measured presses are returned unchanged, because their
            charges already have noise.
        """
        if self.train.measured or copies == 0:
            return self.train
        n_copies = 1 if self.quick else copies  # one copy is enough for a trial run
        charges_of_copies = []
        for copy_index in range(n_copies):
            noise_seed = self.seed + FIRST_COPY_SEED + copy_index
            charges_of_copies.append(self.train.noisy(self.noise, noise_seed))
        contact = np.tile(self.train.contact, (n_copies, 1))  # the contacts of all copies are the same
        return LabelledPresses(contact, np.concatenate(charges_of_copies))

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
        regressor: Regressor that computes the method. It is fitted only in the result of `fit`.
        copies: Number of copies of the presses, each with noise, to which the method is fitted; 0 for presses without
            noise.
        candidates: Candidate values of the parameters of the method, by the name of the parameter. The values with the
            smallest error on the validation presses are used.
        given_force: Whether the inputs of the method contain the true force, which no sensor measures, besides the
            charges.
        choice: Text about the chosen parameters and how they were chosen; empty before `fit` is called.
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
            The charges, shape (n, n_electrode). If `given_force` is set, the force is an additional last column.
        """
        return np.column_stack([charge, force]) if self.given_force else charge

    def fit(self, task: FittingTask) -> "ComparedMethod":
        """Fit the method with each set of candidate parameters, and return the fit with the smallest validation error.

        The validation error is the root mean square of the position errors on the validation presses.

        Args:
            task: Presses for the fit and for the validation.

        Returns:
            A copy of this method with the fitted regressor and with a text about the chosen parameters (`choice`).

        Raises:
            DatasetError: If the method cannot be fitted to these presses.
        """
        presses = task.presses(self.copies)
        true_contact = task.validation.contact
        true_force = true_contact[:, 2]
        validation_inputs = self.inputs(task.validation_charge, true_force)

        # All combinations of the candidates. Without candidates, this is one set without parameters.
        parameter_sets = list(ParameterGrid(dict(self.candidates)))
        if task.quick:
            parameter_sets = parameter_sets[:1]

        fitted_regressors = []
        errors_mm = []
        for parameters in parameter_sets:
            regressor = clone(self.regressor)
            regressor.set_params(**parameters)
            regressor.fit(presses.charge, presses.contact)
            fitted_regressors.append(regressor)
            estimate = regressor.predict(validation_inputs)
            errors_mm.append(rms(position_error(estimate, true_contact)))
        best_index = int(np.argmin(errors_mm))

        choice = self.choice
        if not choice:  # a method without parameters can have a fixed text, which is kept
            choice = self._describe_choice(
                parameter_sets[best_index],
                n_compared=len(parameter_sets),
                validation_error_mm=errors_mm[best_index],
                presses=presses,
            )
        return replace(self, regressor=fitted_regressors[best_index], choice=choice)

    def _describe_choice(
        self, parameters: Mapping[str, Any], *, n_compared: int, validation_error_mm: float, presses: LabelledPresses
    ) -> str:
        """Return a text about the chosen parameters and the presses of the fit.

        Args:
            parameters: The chosen parameters, by name.
            n_compared: Number of sets of parameters that were compared.
            validation_error_mm: Root mean square of the position errors with the chosen parameters, mm.
            presses: Presses to which the method was fitted, including all copies.
        """
        if presses.measured:
            kind_of_presses = "measured"
        elif self.copies:
            kind_of_presses = "noisy"
        else:
            kind_of_presses = "clean"
        descriptions = [describe_parameter(name, value) for name, value in parameters.items()]
        descriptions.append(f"{len(presses)} {kind_of_presses} presses")
        if n_compared > 1:
            descriptions.append(f"best of {n_compared} by validation ({validation_error_mm:.3f} mm rms)")
        return ", ".join(descriptions)


def describe_parameter(name: str, value: object) -> str:
    """Return a text that describes a parameter of a pipeline.

    A pipeline of scikit-learn has several steps, and its parameters have names of the form "step__parameter". The text
    for a number is the last part of the name and the number. The text for a mapping contains only the entries of the
    mapping. The text for any other value is the whole name and the value.

    Args:
        name: Name of the parameter.
        value: Value of the parameter. A mapping contains factors by which axes of the data are scaled, by the name of
            the axis.

    Example:
        >>> describe_parameter("regressor__scales__kw_args", {"force": 0.1, "rest": 0.03})
        'force axis x 0.1, rest axis x 0.03'
        >>> describe_parameter("regressor__neighbours", 8)
        'neighbours 8'
    """
    if isinstance(value, Mapping):
        axis_texts = [f"{axis} axis x {factor:g}" for axis, factor in value.items()]
        return ", ".join(axis_texts)
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
"""Largest number of monomials of the polynomial. More monomials would not reduce the error under noise."""

SKLEARN = "scikit-learn"
"""Name in tables of the library that computes most methods."""

KD_TREE = "SciPy KD-tree"
"""Name in tables of the part of a library that finds nearest neighbours."""

NUMPY = "NumPy"
"""Name in tables of the library that computes the methods that are written with arrays alone."""


def compared_methods(task: FittingTask, charge_map: ChargeMap | None = None) -> list[ComparedMethod]:
    """Return all compared methods except the networks.

    Args:
        task: Presses and conditions of the fits.
        charge_map: Map from contacts to charges for triangulation; None to leave triangulation out.
    """
    domain = task.domain
    linear_band = ComparedMethod(
        name=LINEAR_BAND,
        kind="paper",
        computed_by=KD_TREE,
        regressor=LinearBand(domain.radius),
        candidates={"degree": (6, 10, 14)},
    )
    nearest_entry = ComparedMethod(
        name="lookup table, nearest entry",
        kind="paper",
        computed_by=SKLEARN,
        regressor=log_charge_regressor(domain, nearest_press=KNeighborsRegressor(1)),
    )
    gauss_newton = ComparedMethod(
        name=GAUSS_NEWTON,
        kind="fitted map",
        computed_by=NUMPY,
        regressor=GaussNewton(domain, task.noise, seed=task.seed),
    )
    return [
        *_triangulations(charge_map),
        linear_band,
        nearest_entry,
        _interpolated_table(task),
        _nearest_neighbours(task),
        polynomial_ridge(task),
        _gradient_boosting(task),
        _gaussian_process(task),
        gauss_newton,
    ]


def polynomial_ridge(task: FittingTask) -> ComparedMethod:
    """Return ridge regression on monomials of the logarithms of the charges.

    All monomials up to a certain degree are used. Up to two degrees and two penalties on the coefficients are
    compared. The degrees are the two largest of `POLYNOMIAL_DEGREES` with at most `MAX_MONOMIALS` monomials.

    Args:
        task: Presses for the fit.
    """
    # Choose the degrees. A polynomial of n variables up to the degree d has "n + d choose d" monomials.
    n_electrode = task.train.charge.shape[1]
    allowed_degrees = [
        degree
        for degree in range(1, max(POLYNOMIAL_DEGREES) + 1)
        if comb(n_electrode + degree, degree) <= MAX_MONOMIALS
    ]
    compared_degrees = [degree for degree in POLYNOMIAL_DEGREES if degree in allowed_degrees][-2:]
    if not compared_degrees:  # with many electrodes, even the smallest of `POLYNOMIAL_DEGREES` has too many monomials
        compared_degrees = [max(allowed_degrees)]

    # The logarithms are scaled to [-1, 1] and clipped to the range of the training presses, because a polynomial of
    # high degree grows fast beyond it.
    scaler = MinMaxScaler((-1.0, 1.0), clip=True)
    regressor = log_charge_regressor(
        task.domain, box=scaler, monomials=PolynomialFeatures(), ridge=Ridge(solver="cholesky")
    )

    # The fit uses several copies of the presses with different noise. The penalty is proportional to the number of
    # presses in all copies, as the sum of the squared errors is.
    copies = 5
    penalties = [penalty_per_press * copies * len(task.train) for penalty_per_press in (1e-11, 1e-8)]
    candidates: dict[str, Sequence[Any]] = {
        "regressor__monomials__degree": compared_degrees,
        "regressor__ridge__alpha": penalties,
    }
    return ComparedMethod(
        name=POLYNOMIAL,
        kind="learnt",
        computed_by=SKLEARN,
        regressor=regressor,
        copies=copies,
        candidates=candidates,
    )


def _triangulations(charge_map: ChargeMap | None) -> list[ComparedMethod]:
    """Return two methods: triangulation without the true force, and triangulation with the true force.

    Triangulation intersects the contours of the charges. Without a charge map, there are no contours, and the list is
    empty.

    Args:
        charge_map: Simulated map from contacts to charges; None if there is none.
    """
    if charge_map is None:
        return []
    choice = "contours of the simulated charges"
    without_force = ComparedMethod(
        name="triangulation",
        kind="paper",
        computed_by=NUMPY,
        regressor=Triangulate(charge_map),
        choice=choice,
    )
    with_force = ComparedMethod(
        name="triangulation, force given",
        kind="paper",
        computed_by=NUMPY,
        regressor=Triangulate(charge_map, given_force=True),
        given_force=True,
        choice=choice,
    )
    return [without_force, with_force]


def _scaled_axes() -> FunctionTransformer:
    """Return a transformer that scales the principal axes before distances are computed."""
    return FunctionTransformer(scale_axes, kw_args=AXIS_SCALES[0])


def _axis_scale_candidates(task: FittingTask) -> dict[str, Sequence[Any]]:
    """Return the candidates for the factors of the principal axes, by the name of the parameter.

    A quick task has only one candidate.
    """
    candidates = AXIS_SCALES[1:2] if task.quick else AXIS_SCALES
    return {"regressor__scales__kw_args": candidates}


def _interpolated_table(task: FittingTask) -> ComparedMethod:
    """Return a lookup table with an affine map in each entry, and with candidates for its parameters.

    Args:
        task: Presses and conditions for the fit.
    """
    regressor = log_charge_regressor(task.domain, scales=_scaled_axes(), table=AffineTable())
    candidates = _axis_scale_candidates(task) | {"regressor__table__neighbours": (64, 128)}
    return ComparedMethod(
        name=TABLE, kind="paper", computed_by=KD_TREE, regressor=regressor, copies=5, candidates=candidates
    )


def _nearest_neighbours(task: FittingTask) -> ComparedMethod:
    """Return a regressor that adds the mean residual of the nearest neighbours to a linear regression.

    The neighbours are the presses whose charges are most similar. The number of neighbours and the factors by which the
    principal axes are scaled are chosen among several candidates.

    Args:
        task: Presses and conditions for the fit.
    """
    regressor = log_charge_regressor(task.domain, scales=_scaled_axes(), near=ResidualRegressor(KNeighborsRegressor()))
    neighbour_counts = [count for count in (16, 32, 64) if count <= len(task.train)]  # not more than there are presses
    candidates = _axis_scale_candidates(task) | {"regressor__near__regressor__n_neighbors": neighbour_counts}
    return ComparedMethod(
        name="k-nearest neighbours",
        kind="learnt",
        computed_by=SKLEARN,
        regressor=regressor,
        copies=5,
        candidates=candidates,
    )


def _gradient_boosting(task: FittingTask) -> ComparedMethod:
    """Return gradient boosting of regression trees on the residuals of a linear regression.

    Args:
        task: Conditions of the fit: the domain and the seed. A quick task has fewer trees.
    """
    n_trees = 30 if task.quick else 250
    trees = HistGradientBoostingRegressor(max_iter=n_trees, early_stopping=False, random_state=task.seed)
    trees_for_each_target = MultiOutputRegressor(trees)  # the targets are x, y and the logarithm of the force
    regressor = log_charge_regressor(task.domain, trees=ResidualRegressor(trees_for_each_target))
    # The name of the parameter is its path: the pipeline, its step `trees`, and the regressors within this step.
    candidates = {"regressor__trees__regressor__estimator__max_leaf_nodes": (31, 63)}
    return ComparedMethod(
        name=BOOSTING,
        kind="learnt",
        computed_by=SKLEARN,
        regressor=regressor,
        copies=3,
        candidates=candidates,
    )


def _gaussian_process(task: FittingTask) -> ComparedMethod:
    """Return a Gaussian process on a subset of the presses.

    Args:
        task: Conditions of the fit: the domain and the seed. A quick task has a smaller subset.
    """
    n_presses, n_kernel_presses = (300, 150) if task.quick else (2000, 500)
    process = SubsetProcess(n_presses, n_kernel_presses, task.seed)
    regressor = log_charge_regressor(task.domain, process=process)
    return ComparedMethod(name="Gaussian process", kind="learnt", computed_by=SKLEARN, regressor=regressor, copies=1)
