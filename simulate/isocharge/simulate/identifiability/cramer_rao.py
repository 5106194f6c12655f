"""Cramer-Rao limit: the smallest error with which an unbiased estimator can determine a contact from noisy charges.

Let J = d(Q)/d(x, y, ln F, ...) be the matrix of the derivatives of the charges Q. Let the vector i contain the
information that one reading provides about each charge (`NoiseModel.information`). The Fisher information is the matrix
J' diag(i) J. The covariance of an unbiased estimate is at least the inverse of the Fisher information (Kay 1993,
chapter 3). An estimator that uses a prior distribution may have smaller errors where the charges provide little
information. The errors of such estimators have another lower limit, the Bayes limit.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.noise import NoiseModel


@dataclass(frozen=True)
class CramerRao:
    """Cramer-Rao limits of several contacts.

    Attributes:
        covariance: Smallest covariance matrix of the parameters (x, y, ln F, ...) of each contact, shape (n, p, p). The
            unit of x and y is mm, and ln F is dimensionless. Nuisance parameters come last, in units of their prior
            standard deviation.
    """

    covariance: Array

    @property
    def position(self) -> Array:
        """Smallest root mean square distance between the estimated and the true position, shape (n,), mm."""
        return np.sqrt(self.covariance[:, 0, 0] + self.covariance[:, 1, 1])  # x and y

    @property
    def force(self) -> Array:
        """Smallest standard deviation of the estimated force, relative to the force, shape (n,), dimensionless."""
        return np.sqrt(self.covariance[:, 2, 2])  # ln F


def cramer_rao(charge: Array, jacobian: Array, noise: NoiseModel, nuisance: Array | None = None) -> CramerRao:
    """Compute the Cramer-Rao limits of contacts from charges and their derivatives.

    Args:
        charge: Charges, shape (n, n_electrode), pC.
        jacobian: Derivatives d(Q)/d(parameters), shape (n, n_electrode, p). The first three parameters are x, y and
            ln F.
        noise: Noise of the readings. The white noise must be positive.
        nuisance: Change of the charges if a nuisance parameter, such as the probe radius or the pretension, changes by
            one prior standard deviation, shape (n, n_electrode, n_nuisance), pC. The information of the prior
            distributions of these parameters is added (Van Trees 1968, sec. 2.4.3). None if there are no nuisance
            parameters.

    Returns:
        The limits. The covariance is the inverse of the sum of the Fisher information and the prior information.
    """
    prior_information = np.zeros(jacobian.shape[2])
    if nuisance is not None:
        # A nuisance parameter in units of its prior standard deviation has the prior information 1.
        prior_information = np.concatenate([prior_information, np.ones(nuisance.shape[2])])
        jacobian = np.concatenate([jacobian, nuisance], axis=2)

    # For each press (index n) and each pair of parameters (i and j), sum over the electrodes (e).
    information = np.einsum("nei,ne,nej->nij", jacobian, noise.information(charge), jacobian, optimize=True)
    return CramerRao(_invert(information + np.diag(prior_information)))


def limits_at(charge_map: ChargeMap, contact: Array, noise: NoiseModel) -> CramerRao:
    """Compute the Cramer-Rao limits of contacts by means of a charge map.

    Args:
        charge_map: Map that computes the charges of contacts.
        contact: Contacts (x, y, F) in the domain of the map, shape (n, 3), mm and N.
        noise: Noise of the readings. The white noise must be positive.

    Returns:
        The limits of the three parameters x, y and ln F of each contact.
    """
    charge, jacobian = charge_map.linearised(contact)
    return cramer_rao(charge, jacobian, noise)


def _invert(information: Array) -> Array:
    """Invert information matrices, and regularise singular matrices.

    Each matrix is first scaled such that its diagonal elements are 1, because the units of the parameters differ. Then
    a tiny multiple of the identity matrix is added, which is larger than the rounding errors of the eigenvalues. The
    variances of parameters that the measurement does not determine are therefore very large instead of infinite, and
    all other variances hardly change.

    Args:
        information: Symmetric matrices, shape (n, p, p).

    Returns:
        Inverse matrices, shape (n, p, p).
    """
    # If there is no information about a parameter, its diagonal element is zero. A tiny lower bound then avoids a
    # division by zero. The bound is the root of the smallest number, so that products of two bounds do not underflow.
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    smallest_information = np.sqrt(np.finfo(float).tiny)
    parameter_scale = np.sqrt(np.maximum(diagonal, smallest_information))  # shape (n, p)
    matrix_scale = parameter_scale[:, :, None] * parameter_scale[:, None, :]

    addition = 8.0 * np.finfo(float).eps * np.eye(information.shape[1])
    scaled_inverse = np.linalg.inv(information / matrix_scale + addition)
    return np.asarray(scaled_inverse / matrix_scale)
