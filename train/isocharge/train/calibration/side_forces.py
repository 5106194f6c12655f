"""Side forces of the presses of a calibration, and of the contacts that its model estimates.

A tip on a vertical stage pulls the film inwards by friction while it presses beside the centre
(`simulate.solver.friction`). The coefficient of friction is a nuisance of the session. Friction changes the charges of
the presses by about dQ = coefficient * friction_charge. Here `friction_charge` is computed for the film that the
presses determine (`simulate.forward.side_force`). The fit is repeated, because this film and the coefficient depend on
each other.

The contacts on the calibrated film may have the same friction as the presses, for example if a robot moves vertically.
The contacts may also have no friction, for example if a probe moves freely. The model assumes half of the friction of
the presses. The standard deviations of the model include the differences from both cases. The standard deviations also
include the side forces of any direction that the user declares.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import Series
from isocharge.common.errors import SceneError
from isocharge.simulate import Domain, SideForceMap
from isocharge.simulate.solver.friction import MAX_FRICTION, check_friction
from isocharge.train.calibration.contact_error import ContactSensitivity, spread_contacts
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.nuisances import NuisanceEstimate
from isocharge.train.calibration.press_data import PressData
from isocharge.train.data.charge_field import fit_series

MAX_SIDE_FORCE = 0.5
"""Largest side force that can be declared, over the force of the contact. The charges are computed to first order."""

MIN_REFERENCE = 0.02
"""Smallest coefficient of friction at which the effect of friction is computed.

Friction is proportional to the coefficient except where the film sticks to the tip.
"""

CONTACTS = 400
"""Number of contacts to which the effect of friction on the charges is fitted."""

DEGREE = 8
"""Largest total degree in x and y of the fitted series."""

FORCE_DEGREE = 3
"""Largest degree in ln F of the fitted series."""


def check_side_force(share: float) -> None:
    """Raise an error if a share of the force is not between 0 and `MAX_SIDE_FORCE`."""
    if not 0.0 <= share <= MAX_SIDE_FORCE:
        raise SceneError(
            f"side force: expected a share of the force from 0 to {MAX_SIDE_FORCE:g}, such as 0.1, got {share}"
        )


def solve_side_forces(charges: FilmCharges, parameters: Array) -> SideForceMap:
    """Compute the effect of side forces on one film, which takes about ten seconds.

    Args:
        charges: The films.
        parameters: Parameters of the film, shape (n_parameter,).
    """
    return SideForceMap.build(charges.forward_map(parameters))


def with_friction(
    data: PressData, charges: FilmCharges, side_force_map: SideForceMap, contact: Array, coefficient: float
) -> PressData:
    """Return presses with the effect of friction on their charges.

    Args:
        data: The presses.
        charges: The films.
        side_force_map: Effect of side forces on the film.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.
        coefficient: Estimated coefficient of friction, at which the effect is computed.
    """
    reference = float(np.clip(coefficient, MIN_REFERENCE, MAX_FRICTION))
    friction_charge = side_force_map.friction_charges(charges.into_domain(contact), reference) / reference
    return replace(data, friction_charge=friction_charge)


@dataclass(frozen=True)
class SideForces:
    """Side forces that contacts on a calibrated film may have.

    Attributes:
        side_force_map: Effect of side forces on the charges of the film.
        domain: Contacts that the model answers.
        friction: Coefficient of friction of the presses, with its standard deviation.
        share: Largest further side force, which may have any direction, relative to the force.
    """

    side_force_map: SideForceMap
    domain: Domain
    friction: NuisanceEstimate
    share: float

    def __post_init__(self) -> None:
        check_side_force(self.share)
        check_friction(self._coefficient)

    @property
    def _coefficient(self) -> float:
        """Coefficient of friction, limited to possible values."""
        return float(np.clip(self.friction.value, 0.0, MAX_FRICTION))

    def charge_factor(self, contact: Array) -> Array:
        """Return the factors by which half of the friction changes the charges, shape (n, n_electrode).

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
        """
        if self._coefficient == 0.0:
            return np.ones((len(contact), len(self.side_force_map.film.electrodes)))
        unit_contact = self.domain.to_unit(contact)
        return np.asarray(np.exp(self._log_factor.values(unit_contact)[:, 0]))

    @cached_property
    def _log_factor(self) -> Series:
        """Logarithm of the factor by which half of the friction changes the charges, as a series of the contact.

        The series is fitted to `CONTACTS` contacts, because it is faster to evaluate than the effect of friction.
        """
        contact = spread_contacts(self.domain, CONTACTS)
        unit_contact = self.domain.to_unit(contact)
        friction_charge = self.side_force_map.friction_charges(contact, self._coefficient)
        log_factor = np.log1p(0.5 * friction_charge / self.side_force_map.film.charges(contact))
        return Series(fit_series(unit_contact, log_factor, DEGREE, FORCE_DEGREE))

    def contact_covariance(self, sensitivity: ContactSensitivity) -> Array:
        """Compute the covariances of (x, y, ln F), shape (n, 3, 3), that the side forces of contacts cause.

        Contacts with the friction of the presses and contacts without friction are equally probable. A side force that
        the user declares has the declared size and an unknown direction.

        Args:
            sensitivity: The contacts, and their dependence on charges.
        """
        contact = sensitivity.contact
        covariance = np.zeros((len(contact), 3, 3))
        if self._coefficient > 0.0:
            friction_charge = self.side_force_map.friction_charges(contact, self._coefficient)
            # Contacts have the friction charge f (1 + e) with the relative error e of the coefficient, or none. Each
            # case has the probability 0.5, and the model assumes f / 2. The mean squared difference is
            # 0.5 ((1/2)^2 + e^2) f^2 + 0.5 (1/2)^2 f^2 = (0.25 + 0.5 e^2) f^2.
            relative_std = float(np.sqrt(0.25 + 0.5 * (self.friction.std / self._coefficient) ** 2))
            covariance += _covariance_of_charge_error(sensitivity.charge_gain, relative_std * friction_charge)
        if self.share > 0.0:
            # A force in an unknown direction has half of its variance along each of the two axes.
            side_force_std = self.share * contact[:, 2, None] / np.sqrt(2.0)  # shape (n, 1), N
            charge_per_newton = self.side_force_map.jacobian(contact)  # last axis: along x and along y
            for axis in range(2):
                charge_std = side_force_std * charge_per_newton[:, :, axis]
                covariance += _covariance_of_charge_error(sensitivity.charge_gain, charge_std)
        return covariance


def _covariance_of_charge_error(charge_gain: Array, charge_error: Array) -> Array:
    """Compute the covariances of contacts that an error of their charges causes.

    The errors of all charges of a contact are fully correlated, because they have one common cause.

    Args:
        charge_gain: Derivatives of (x, y, ln F) with respect to the charges, shape (n, 3, n_electrode), mm/pC, mm/pC
            and 1/pC.
        charge_error: One standard deviation of the error, shape (n, n_electrode), pC.

    Returns:
        Covariances of (x, y, ln F), shape (n, 3, 3).
    """
    contact_error = np.einsum("nie,ne->ni", charge_gain, charge_error)  # sums over the electrodes e, shape (n, 3)
    return np.asarray(contact_error[:, :, None] * contact_error[:, None, :])  # outer products
