"""Regressors of scikit-learn that all use the same transformations of the charges and of the contacts.

The inputs are whitened logarithms of the charges. The first principal axis is mostly the mean logarithm, which depends
on the force. The next two axes are mostly logarithms of ratios, which depend on the position. With a fourth electrode,
there is a fourth axis, which contains mostly noise. The targets are x, y and ln F, scaled to [-1, 1].
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
from isocharge.train.data.channel_noise import BOTH_SIGNS, MIN_TRANSITION_RATIO, usual_size
from isocharge.train.data.presses import LOWEST_CHARGE

BATCH = 256
"""Number of presses for which a Gaussian process computes the kernel at a time."""

AXIS_SCALES = ({"force": 1.0, "rest": 1.0}, {"force": 0.1, "rest": 0.03}, {"force": 0.03, "rest": 0.03})
"""Candidates for the factors of `scale_axes`. The map is nearly linear along the axis of the force, so neighbours may
be far apart along this axis."""

N_POSITION_AND_FORCE_AXES = 3
"""Number of principal axes that depend mostly on the force and the position."""


def log_charge_regressor(domain: Domain, **steps: Any) -> TransformedTargetRegressor:
    """Return a regressor that estimates contacts, shape (n, 3), mm and N, from charges, shape (n, n_electrode), pC.

    The charges are first converted into whitened logarithms, and the targets are the contacts in unit coordinates.

    Args:
        domain: Contacts that can occur.
        steps: Steps of the pipeline by name: transformers of the whitened logarithms, then the regressor.
    """
    pipeline = Pipeline([*whitening().steps, *steps.items()])
    return TransformedTargetRegressor(
        pipeline, func=domain.to_unit, inverse_func=domain.to_contact, check_inverse=False
    )


def whitening() -> Pipeline:
    """Return a transformer that computes whitened logarithms of charges, shape (n, n_electrode), pC."""
    return Pipeline([("logarithms", Logarithms()), ("whitening", PCA(whiten=True))])


class Logarithms(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Transformer that computes ln(max(Q, 1 pC)), or asinh(2 Q / usual size) if the charges have both signs."""

    def fit(self, charge: Array, target: object = None) -> "Logarithms":
        """Determine whether the charges have both signs and, if they do, compute the scale of the transformation.

        The charges of an electrode have both signs if more than the fraction `BOTH_SIGNS` of them is not positive. A
        smaller fraction can be due to noise alone. If at least one electrode has charges of both signs, the charges of
        all electrodes are transformed to asinh(Q / scale). This function is linear for charges far below the scale and
        logarithmic for charges far above it. Otherwise, the scale is None, and the charges are transformed to
        logarithms.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            target: Not used; it is an argument of every transformer of scikit-learn.

        Returns:
            This transformer.
        """
        del target
        is_not_positive = charge <= 0.0
        not_positive_fraction = is_not_positive.mean(axis=0)  # one value for each electrode
        any_has_both_signs = (not_positive_fraction > BOTH_SIGNS).any()
        self.scale_ = None
        if any_has_both_signs:
            self.scale_ = MIN_TRANSITION_RATIO * usual_size(charge)  # shape (n_electrode,), pC
        return self

    def transform(self, charge: Array) -> Array:
        """Transform charges, shape (n, n_electrode), pC. The result has the same shape."""
        if self.scale_ is None:
            return np.asarray(np.log(np.maximum(charge, LOWEST_CHARGE)))
        return np.asarray(np.arcsinh(charge / self.scale_))


def scale_axes(values: Array, force: float, rest: float) -> Array:
    """Multiply the principal axes of whitened logarithms by factors. The two axes of the position are not changed.

    Args:
        values: Whitened logarithms, shape (n, n_electrode).
        force: Factor of the first axis, which depends mostly on the force.
        rest: Factor of the axes after the third axis, which contain mostly noise.

    Returns:
        Scaled values, shape (n, n_electrode).
    """
    factors = np.full(values.shape[1], rest)
    factors[:N_POSITION_AND_FORCE_AXES] = 1.0
    factors[0] = force
    return np.asarray(values * factors)


class ResidualRegressor(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Sum of a linear regression and a second regressor, which is fitted to the residuals of the linear regression.

    Args:
        regressor: Regressor for the residuals of the linear regression.
    """

    def __init__(self, regressor: Any) -> None:
        self.regressor = regressor

    def fit(self, inputs: Array, target: Array) -> "ResidualRegressor":
        """Fit the linear regression, and then fit a clone of the second regressor to the residuals.

        Args:
            inputs: Inputs, shape (n, n_input).
            target: Targets, shape (n, n_target).

        Returns:
            This estimator.
        """
        self.linear_ = LinearRegression().fit(inputs, target)
        residual = target - self.linear_.predict(inputs)
        self.regressor_ = clone(self.regressor)
        self.regressor_.fit(inputs, residual)
        return self

    def predict(self, inputs: Array) -> Array:
        """Estimate the targets, shape (n, n_target), of inputs of shape (n, n_input)."""
        return np.asarray(self.linear_.predict(inputs) + self.regressor_.predict(inputs))


class SubsetProcess(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Gaussian process that is fitted to a random subset of the presses.

    A subset is used because the time of a fit grows with the third power of the number of presses.

    Args:
        n_presses: Number of presses to which the process is fitted.
        n_kernel_presses: Number of presses to which the parameters of the kernel are fitted, by marginal likelihood.
        seed: Seed of the subset.
    """

    def __init__(self, n_presses: int = 2000, n_kernel_presses: int = 500, seed: int = 0) -> None:
        self.n_presses = n_presses
        self.n_kernel_presses = n_kernel_presses
        self.seed = seed

    def fit(self, inputs: Array, target: Array) -> "SubsetProcess":
        """Fit the kernel to a few presses, and then fit the process with this kernel to more presses.

        The presses are chosen at random. The fit of the kernel evaluates the process many times, so it uses fewer
        presses.

        Args:
            inputs: Inputs of the presses, shape (n, n_input).
            target: Targets of the presses, shape (n, n_target).

        Returns:
            This estimator.
        """
        shuffled_rows = np.random.default_rng(self.seed).permutation(len(inputs))
        process_rows = shuffled_rows[: self.n_presses]
        kernel_rows = process_rows[: self.n_kernel_presses]

        # The covariance of two inputs is the variance times their correlation, which decreases with their distance. The
        # noise is independent for each press. Each part has an initial value, and bounds within which it is fitted.
        n_input = inputs.shape[1]
        variance = ConstantKernel(10.0, (1e-2, 1e5))
        correlation = RBF(np.full(n_input, 2.0), (0.1, 100.0))  # one length scale for each input
        noise = WhiteKernel(1e-3, (1e-8, 1.0))
        kernel = variance * correlation + noise
        with catch_warnings():
            simplefilter("ignore", ConvergenceWarning)  # a fitted value at its bound is acceptable
            kernel_process = GaussianProcessRegressor(kernel, normalize_y=True)
            kernel_process.fit(inputs[kernel_rows], target[kernel_rows])

        # Without an optimiser, the second process uses the fitted kernel as it is.
        self.process_ = GaussianProcessRegressor(kernel_process.kernel_, optimizer=None, normalize_y=True)
        self.process_.fit(inputs[process_rows], target[process_rows])
        return self

    def predict(self, inputs: Array) -> Array:
        """Compute the posterior mean, shape (n, n_target), of inputs of shape (n, n_input)."""
        batches = [self.process_.predict(inputs[first : first + BATCH]) for first in range(0, len(inputs), BATCH)]
        return np.concatenate(batches)
