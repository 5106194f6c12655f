"""The Cramer-Rao limit: the smallest errors of an unbiased estimator of a contact from noisy charges.

With J = d(Q)/d(x, y, ln F, ...) the Fisher information is J' diag(i) J, i what one reading tells about its charge
(`NoiseModel.information`), and the covariance of an unbiased estimate is at least its inverse (Kay 1993, ch. 3).
An estimator that knows the prior may do better where the charges say little: that is the Bayes limit, in train.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.measuring_chain.noise import NoiseModel

SMALLEST = 1e-14
"""Lower bound for the eigenvalues of the scaled Fisher information, dimensionless: smaller ones are rounding errors.
Limits become some 1e7 times larger than the others instead of infinite."""

NOTHING = 1e-60
"""Fisher information below which a parameter counts as unobservable: 1/mm^2 for x and y, dimensionless for ln F."""


@dataclass(frozen=True)
class CramerRao:
    """Cramer-Rao limits of contacts.

    Attributes:
        covariance: Smallest covariance of (x, y, ln F, ...), shape (n, p, p); x and y in mm, ln F dimensionless.
            Nuisances come last, in units of their prior standard deviation.
    """

    covariance: Array

    @property
    def position(self) -> Array:
        """Root of the mean square distance from the true position, shape (n,), mm."""
        return np.asarray(np.sqrt(self.covariance[:, 0, 0] + self.covariance[:, 1, 1]))

    @property
    def force(self) -> Array:
        """Standard deviation of the force over the force, shape (n,)."""
        return np.asarray(np.sqrt(self.covariance[:, 2, 2]))


def cramer_rao(charge: Array, jacobian: Array, noise: NoiseModel, nuisance: Array | None = None) -> CramerRao:
    """Limits from charges and their derivatives.

    Args:
        charge: Charges, shape (n, n_electrode), pC.
        jacobian: d(Q)/d(parameters), shape (n, n_electrode, p); the first three parameters are x, y, ln F.
        noise: Noise of the readings, with white noise above zero.
        nuisance: Change of the charges by one prior standard deviation of each further unknown, such as the probe's
            radius or the pretension, shape (n, n_electrode, n_parameter), pC. Their priors add to the information
            (Van Trees 1968, sec. 2.4.3).
    """
    prior = np.zeros(jacobian.shape[2])
    if nuisance is not None:
        prior = np.concatenate([prior, np.ones(nuisance.shape[2])])
        jacobian = np.concatenate([jacobian, nuisance], axis=2)
    information = np.einsum("nei,ne,nej->nij", jacobian, noise.information(charge), jacobian, optimize=True)
    return CramerRao(_invert(information + np.diag(prior)))


def limits_at(charge_map: ChargeMap, contact: Array, noise: NoiseModel) -> CramerRao:
    """Limits at contacts (x, y, F), shape (n, 3), mm and N."""
    return cramer_rao(*linearised(charge_map, contact), noise)


def _invert(information: Array) -> Array:
    """Inverse of symmetric matrices, shape (n, p, p), with parameters of any scale; singular ones are regularised."""
    size = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), NOTHING))
    both = size[:, :, None] * size[:, None, :]
    values, vectors = np.linalg.eigh(information / both)
    return np.asarray(np.einsum("nik,nk,njk->nij", vectors, 1.0 / np.maximum(values, SMALLEST), vectors) / both)
