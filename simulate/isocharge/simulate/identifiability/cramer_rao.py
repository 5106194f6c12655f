"""Cramer-Rao limit: the smallest errors of an unbiased estimator of a contact from noisy charges.

Let J = d(Q)/d(x, y, ln F, ...) be the Jacobian, and i the information that one reading provides about its charge
(`NoiseModel.information`). The Fisher information is then J' diag(i) J. The covariance of an unbiased estimate is at
least the inverse of the Fisher information (Kay 1993, chapter 3). An estimator that uses a prior may have smaller
errors where the charges provide little information. The package isocharge.train computes the limit of such estimators,
the Bayes limit.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.measuring_chain.noise import NoiseModel

MIN_EIGENVALUE = 1e-14
"""Lower bound of the eigenvalues of the scaled Fisher information, dimensionless.

Smaller eigenvalues are rounding errors. With this bound, the limits of undetermined parameters are very large instead
of infinite.
"""

MIN_INFORMATION = 1e-60
"""Fisher information below which a parameter counts as unobservable: 1/mm^2 for x and y, dimensionless for ln F."""


@dataclass(frozen=True)
class CramerRao:
    """Cramer-Rao limits of contacts.

    Attributes:
        covariance: Smallest covariance of (x, y, ln F, ...), shape (n, p, p), with x and y in mm and ln F
            dimensionless. Nuisance parameters come last, in units of their prior standard deviation.
    """

    covariance: Array

    @property
    def position(self) -> Array:
        """Root mean square distance of the estimate from the true position, shape (n,), mm."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance[:, 0] + variance[:, 1]))  # x and y

    @property
    def force(self) -> Array:
        """Standard deviation of the force divided by the force, shape (n,), dimensionless."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance[:, 2]))  # ln F


def cramer_rao(charge: Array, jacobian: Array, noise: NoiseModel, nuisance: Array | None = None) -> CramerRao:
    """Compute the Cramer-Rao limits of contacts from charges and their derivatives.

    Args:
        charge: Charges, shape (n, n_electrode), pC.
        jacobian: Derivatives d(Q)/d(parameters), shape (n, n_electrode, p). The first three parameters are x, y and
            ln F.
        noise: Noise of the readings. The white noise must be positive.
        nuisance: Change of the charges by one prior standard deviation of each nuisance parameter, such as the radius
            of the probe or the pretension, shape (n, n_electrode, n_nuisance), pC. The priors of the nuisance
            parameters are added to the information (Van Trees 1968, sec. 2.4.3).

    Returns:
        The limits, from the inverse of the Fisher information J' W J + prior information.
    """
    prior_information = np.zeros(jacobian.shape[2])
    if nuisance is not None:
        # A nuisance parameter in units of its prior standard deviation has the prior information 1.
        prior_information = np.concatenate([prior_information, np.ones(nuisance.shape[2])])
        jacobian = np.concatenate([jacobian, nuisance], axis=2)
    # Sum over the electrodes e, for each press n and each pair of parameters i and j.
    information = np.einsum("nei,ne,nej->nij", jacobian, noise.information(charge), jacobian, optimize=True)
    return CramerRao(_invert(information + np.diag(prior_information)))


def limits_at(charge_map: ChargeMap, contact: Array, noise: NoiseModel) -> CramerRao:
    """Compute the limits for contacts of a charge map.

    Args:
        charge_map: Charges as a function of the contact.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        noise: Noise of the readings. The white noise must be positive.
    """
    charge, jacobian = linearised(charge_map, contact)
    return cramer_rao(charge, jacobian, noise)


def _invert(information: Array) -> Array:
    """Invert information matrices. Singular matrices are regularised.

    The matrices are first scaled to a unit diagonal, because the units of the parameters differ.

    Args:
        information: Symmetric matrices, shape (n, p, p).

    Returns:
        Inverse matrices, shape (n, p, p).
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    parameter_scale = np.sqrt(np.maximum(diagonal, MIN_INFORMATION))  # shape (n, p)
    matrix_scale = parameter_scale[:, :, None] * parameter_scale[:, None, :]
    eigenvalues, eigenvectors = np.linalg.eigh(information / matrix_scale)  # the diagonal of this matrix is 1
    inverse_eigenvalues = 1.0 / np.maximum(eigenvalues, MIN_EIGENVALUE)
    # Inverse V diag(1 / eigenvalues) V' of each matrix n
    scaled_inverse = np.einsum("nik,nk,njk->nij", eigenvectors, inverse_eigenvalues, eigenvectors)
    return np.asarray(scaled_inverse / matrix_scale)
