"""What scikit-learn knows: regressors behind one transformer of the charges and one of the contacts.

They see whitened logarithms of the charges, a linear map of the log-ratios, which carry the position, and of the mean
logarithm, which carries the force: the first principal axis is the force's, the next two are the position's, and what
is left in a fourth charge is mostly noise. They learn x, y and ln F, scaled to [-1, 1].
"""

from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin, TransformerMixin, clone
from sklearn.compose import TransformedTargetRegressor
from sklearn.decomposition import PCA
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import Pipeline

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.data.channel_noise import BOTH_SIGNS, LEAST_BEND, usual_size
from isocharge.train.data.presses import LOWEST_CHARGE

BATCH = 256
"""Presses whose kernel rows a Gaussian process computes at once."""

RULERS = ({"force": 1.0, "rest": 1.0}, {"force": 0.1, "rest": 0.03}, {"force": 0.03, "rest": 0.03})
"""Candidates for the rulers of near neighbours, `stretched`: along the force the map hardly changes, so neighbours may
be far apart there."""


def on_logarithms(domain: Domain, **steps: Any) -> TransformedTargetRegressor:
    """A regressor from charges (n, n_electrode), pC, to contacts (n, 3), mm and N.

    Args:
        domain: The contacts that can occur.
        steps: Transformers of the whitened logarithms, and the regressor last, by their names in the pipeline.
    """
    pipeline = Pipeline([*whitening().steps, *steps.items()])
    return TransformedTargetRegressor(
        pipeline, func=domain.to_unit, inverse_func=domain.to_contact, check_inverse=False
    )


def whitening() -> Pipeline:
    """From charges (n, n_electrode), pC, to logarithms along their principal axes, each of variance 1."""
    return Pipeline([("logarithms", Logarithms()), ("whitening", PCA(whiten=True))])


class Logarithms(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """ln(max(Q, 1 pC)) of charges, shape (n, n_electrode); asinh(2 Q / usual size) if they have both signs."""

    def fit(self, charge: Array, target: object = None) -> "Logarithms":
        """Noise alone does not make a sign."""
        del target
        signed = (np.mean(charge <= 0.0, axis=0) > BOTH_SIGNS).any()
        self.bend_ = LEAST_BEND * usual_size(charge) if signed else None
        return self

    def transform(self, charge: Array) -> Array:
        """The same shape."""
        if self.bend_ is None:
            return np.asarray(np.log(np.maximum(charge, LOWEST_CHARGE)))
        return np.asarray(np.arcsinh(charge / self.bend_))


def stretched(values: Array, force: float, rest: float) -> Array:
    """Whitened logarithms with the force's axis, and those after the third, times a factor."""
    factors = np.full(values.shape[1], rest)
    factors[:3] = force, 1.0, 1.0
    return np.asarray(values * factors)


class AfterLinear(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """A regressor on what a linear fit leaves: near the force's axis, all that is not linear is small."""

    def __init__(self, regressor: Any) -> None:
        self.regressor = regressor

    def fit(self, values: Array, target: Array) -> "AfterLinear":
        """Both, one after the other."""
        self.linear_, self.regressor_ = LinearRegression().fit(values, target), clone(self.regressor)
        self.regressor_.fit(values, target - self.linear_.predict(values))
        return self

    def predict(self, values: Array) -> Array:
        """Their sum."""
        return np.asarray(self.linear_.predict(values) + self.regressor_.predict(values))


class SubsetProcess(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """A Gaussian process on some of its presses, since its cost grows with them; lengths learned from fewer still.

    Attributes:
        points: Presses that it keeps.
        learned_from: Presses that choose the kernel's lengths, by marginal likelihood.
        seed: Of the choice.
    """

    def __init__(self, points: int = 2000, learned_from: int = 500, seed: int = 0) -> None:
        self.points, self.learned_from, self.seed = points, learned_from, seed

    def fit(self, values: Array, target: Array) -> "SubsetProcess":
        """Kernel, then weights."""
        rows = np.random.default_rng(self.seed).permutation(len(values))[: self.points]
        few, lengths = rows[: self.learned_from], np.full(values.shape[1], 2.0)
        kernel = ConstantKernel(10.0, (1e-2, 1e5)) * RBF(lengths, (0.1, 100.0)) + WhiteKernel(1e-3, (1e-8, 1.0))
        with catch_warnings():
            simplefilter("ignore", ConvergenceWarning)  # a length at its bound is an answer, too
            learned = GaussianProcessRegressor(kernel, normalize_y=True).fit(values[few], target[few])
        self.process_ = GaussianProcessRegressor(learned.kernel_, optimizer=None, normalize_y=True)
        self.process_.fit(values[rows], target[rows])
        return self

    def predict(self, values: Array) -> Array:
        """The posterior mean."""
        parts = [self.process_.predict(values[k : k + BATCH]) for k in range(0, len(values), BATCH)]
        return np.concatenate(parts)
