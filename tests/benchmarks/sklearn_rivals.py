"""Regressors of scikit-learn for `bench_fit.py`, with the same transformations of the charges and of the contacts.

The inputs are whitened logarithms of the charges. The targets are x, y and ln F, scaled to [-1, 1].
"""

from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.compose import TransformedTargetRegressor
from sklearn.decomposition import PCA
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.train.data.presses import LOWEST_CHARGE

BATCH = 256
"""Number of presses for which a Gaussian process computes the kernel at a time."""


def log_charge_regressor(domain: Domain, **steps: Any) -> TransformedTargetRegressor:
    """Return a regressor that estimates contacts, shape (n, 3), mm and N, from charges, shape (n, n_electrode), pC.

    The charges are first converted into whitened logarithms, and the targets are the contacts in unit coordinates.

    Args:
        domain: Contacts that can occur.
        steps: Steps of the pipeline by name: transformers of the whitened logarithms, then the regressor.
    """
    logarithms = FunctionTransformer(lambda charge: np.log(np.maximum(charge, LOWEST_CHARGE)))
    pipeline = Pipeline([("logarithms", logarithms), ("whitening", PCA(whiten=True)), *steps.items()])
    return TransformedTargetRegressor(
        pipeline, func=domain.to_unit, inverse_func=domain.to_contact, check_inverse=False
    )


class SubsetProcess(BaseEstimator, RegressorMixin):
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
