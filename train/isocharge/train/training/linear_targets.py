"""Targets of the contact network that follow the noise of the charges.

A press at the contact c has the charges Q(c) + n, where n is the noise. A network that minimises the squared errors
learns the posterior mean of the contact. If the noise is small, the posterior mean is the generalised least squares
estimate (Aitken 1936), which is linear in the noise:

    m = c + A n,   A = (J' W J + P)^-1 J' W.

Here J contains the derivatives of the charges with respect to the contact, W is the inverse of the covariance of the
noise, and P is the inverse of the covariance of the contacts in the domain (the prior).

The posterior mean m is a better target for the network than the contact c, for two reasons. First, m is nearly a
function of the charges, while the relation between c and the charges contains random noise. Second, A hardly depends on
the size of the noise. Therefore, the noise can be enlarged in the training, so that the network learns more clearly how
m changes with the charges. Both reasons matter for sensors with many electrodes. A change of the contact changes their
charges along only three directions. The network has to learn that noise along all other directions has no influence on
m.

The posterior mean is linear in the noise only if the standard deviation of the contact is small. For every other press,
the target is the contact, and the noise is not enlarged.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from isocharge.simulate import ChargeMap
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.losses import fresh_noise
from isocharge.train.training.network import as_tensor

LARGEST_LINEAR_STD = 0.012
"""Standard deviation of the contact up to which the estimate counts as linear in the noise, in unit coordinates.

The noise is not enlarged beyond this standard deviation, either.
"""

MAX_NOISE_FACTOR = 5.0
"""Largest factor by which the noise of a press is enlarged, dimensionless."""


class TargetBatch(NamedTuple):
    """Charges with noise, and the targets that the network learns from these charges.

    Attributes:
        charge: Charges with noise, shape (n, n_electrode), pC.
        target: Unit coordinates that the mean of the network should have, shape (n, 3).
        noise_factor: Factor by which the noise was enlarged, shape (n, 1).
    """

    charge: Tensor
    target: Tensor
    noise_factor: Tensor


@dataclass(frozen=True)
class LinearTargets:
    """Presses without noise, and matrices that determine how the targets change with the noise that is added later.

    Attributes:
        charge: Charges without noise, shape (n, n_electrode), pC.
        contact: Contacts in unit coordinates, shape (n, 3).
        noise_response: Matrices A, shape (n, 3, n_electrode), 1/pC. The noise n changes the estimated contact by A n.
            The matrix is zero if the estimated contact of a press is not linear in the noise.
        noise_factor: Factor by which the noise of each press is enlarged, shape (n, 1).
        noise: Noise of the charges.
    """

    charge: Tensor
    contact: Tensor
    noise_response: Tensor
    noise_factor: Tensor
    noise: Noise

    @classmethod
    def compute(cls, presses: LabelledPresses, charge_map: ChargeMap, noise: Noise) -> "LinearTargets":
        """Compute for each press the matrix A. If the noise n is added to the charges, the estimate changes by A n.

        With the derivatives J of the charges, the inverse W of the noise covariance, and the prior precision P, the
        matrix is A = (J' W J + P)^-1 J' W, where J' is the transpose of J. If the estimate of a press is not linear in
        the noise, its matrix is zero.

        Args:
            presses: Presses without noise.
            charge_map: Map from contacts to charges, which gives the derivatives J and the unit coordinates.
            noise: Noise of the charges.
        """
        domain = charge_map.domain
        unit_derivatives = charge_map.derivatives(presses.contact) * domain.scale  # J, shape (n, n_electrode, 3)
        noise_std = noise.sigma(presses.charge)
        whitened_jacobian = unit_derivatives / noise_std[:, :, None]  # W^(1/2) J
        transposed = whitened_jacobian.swapaxes(1, 2)  # J' W^(1/2), shape (n, 3, n_electrode)
        prior_precision = 3.0 * np.eye(3)  # P, of unit coordinates that are uniformly distributed between -1 and 1
        precision = transposed @ whitened_jacobian + prior_precision  # J' W J + P, shape (n, 3, 3)
        noise_response = np.linalg.solve(precision, transposed / noise_std[:, None, :])

        # If the contact is too uncertain, the estimate is not linear, and the noise is not enlarged (factor 1). If the
        # contact is very certain, the noise is enlarged up to the limit of linearity. The inverse of the precision is
        # the covariance of the contact, and its diagonal contains the variances.
        contact_variance = np.linalg.inv(precision).diagonal(axis1=1, axis2=2)
        largest_std = np.sqrt(contact_variance.max(axis=1))
        is_linear = largest_std <= LARGEST_LINEAR_STD
        noise_response[~is_linear] = 0.0
        noise_factor = np.clip(LARGEST_LINEAR_STD / largest_std, 1.0, MAX_NOISE_FACTOR)
        return cls(
            charge=as_tensor(presses.charge),
            contact=as_tensor(domain.to_unit(presses.contact)),
            noise_response=as_tensor(np.asarray(noise_response, dtype=float)),
            noise_factor=as_tensor(np.asarray(noise_factor[:, None], dtype=float)),
            noise=noise,
        )

    def draw(self, rows: Tensor, random: torch.Generator) -> TargetBatch:
        """Add new noise to the charges of some presses, and compute the targets for these charges.

        Args:
            rows: Indices of the presses, shape (n,).
            random: Random number generator of the noise.
        """
        charge = self.charge[rows]
        noise_factor = self.noise_factor[rows]
        noise = noise_factor * fresh_noise(charge, self.noise, random)
        contact_change = (self.noise_response[rows] @ noise[:, :, None])[:, :, 0]  # A n, shape (n, 3)
        return TargetBatch(charge + noise, self.contact[rows] + contact_change, noise_factor)
