"""Side forces of presses in a calibration, and side forces of later contacts on the calibrated film.

If a tip on a vertical stage presses beside the centre, friction pulls the film inwards (`simulate.solver.friction`).
The coefficient of friction is a nuisance of the session. Friction changes the charges of a press by about
coefficient * friction_charge, where `friction_charge` is computed for the estimated film
(`simulate.forward.side_force`). The fit is repeated, because the estimated film and the coefficient depend on each
other.

Later contacts may have the same friction as the presses, for example if a robot moves vertically. Later contacts may
also have no friction, for example if a probe moves freely. The model of the calibrated film assumes half of the
friction of the presses. The standard deviations of the model include the error of this assumption in both cases. The
standard deviations also include any side force that the user declares.
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
"""Largest side force that can be declared, divided by the force of the contact.

The side force is limited, because its effect on the charges is computed to first order."""

MIN_REFERENCE = 0.02
"""Smallest coefficient of friction at which the effect of friction is computed.

For a smaller coefficient, the effect is scaled in proportion, because the friction is proportional to the coefficient
except where the film sticks to the tip.
"""

CONTACTS = 400
"""Number of contacts at which the effect of friction is computed in order to fit a series to it."""

DEGREE = 8
"""Largest total degree in x and y of the series that is fitted to the effect of friction."""

FORCE_DEGREE = 3
"""Largest degree in ln F of the series that is fitted to the effect of friction."""


def check_side_force(share: float) -> None:
    """Raise SceneError if a declared side force is not between 0 and `MAX_SIDE_FORCE` times the force.

    Args:
        share: Side force divided by the force of the contact.
    """
    if not 0.0 <= share <= MAX_SIDE_FORCE:
        raise SceneError(
            f"side force: expected a share of the force from 0 to {MAX_SIDE_FORCE:g}, such as 0.1, got {share}"
        )


def solve_side_forces(charges: FilmCharges, parameters: Array) -> SideForceMap:
    """Compute the effect of side forces on the charges of one film. The computation takes several seconds.

    Args:
        charges: Model of the charges of all films.
        parameters: Parameters of the film, shape (n_parameter,).
    """
    return SideForceMap.build(charges.forward_map(parameters))


def with_friction(
    data: PressData, charges: FilmCharges, side_force_map: SideForceMap, contact: Array, coefficient: float
) -> PressData:
    """Return a copy of the presses, with the effect of friction on their charges as `friction_charge`.

    The effect is divided by the coefficient of friction at which it was computed. This coefficient is at least
    `MIN_REFERENCE`.

    Args:
        data: The measured presses.
        charges: Model of the charges of all films, with their domain.
        side_force_map: Effect of side forces on the charges of the estimated film.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.
        coefficient: Estimated coefficient of friction, at which the effect is computed if it is not too small.
    """
    reference_coefficient = float(np.clip(coefficient, MIN_REFERENCE, MAX_FRICTION))
    charge_at_reference = side_force_map.friction_charges(charges.into_domain(contact), reference_coefficient)
    return replace(data, friction_charge=charge_at_reference / reference_coefficient)


@dataclass(frozen=True)
class SideForces:
    """Side forces that later contacts on a calibrated film may have.

    Attributes:
        side_force_map: Effect of side forces on the charges of the film.
        domain: Range of contacts that the model can estimate.
        friction: Estimated coefficient of friction of the presses, with its standard deviation.
        share: Declared side force in any direction, divided by the force of the contact.
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
        """Estimated coefficient of friction, limited to the range from 0 to `MAX_FRICTION`."""
        return float(np.clip(self.friction.value, 0.0, MAX_FRICTION))

    def charge_factor(self, contact: Array) -> Array:
        """Compute the factors by which half of the friction of the presses multiplies the charges.

        All factors are 1 if the estimated coefficient of friction is zero.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Factors, shape (n, n_electrode), dimensionless.
        """
        if self._coefficient == 0.0:
            return np.ones((len(contact), len(self.side_force_map.film.electrodes)))
        unit_contact = self.domain.to_unit(contact)
        log_factor = self._log_factor.values_and_derivatives(unit_contact)[:, 0]  # the values without the derivatives
        return np.asarray(np.exp(log_factor))

    @cached_property
    def _log_factor(self) -> Series:
        """Series for the logarithm of the factor by which half of the friction multiplies the charges.

        The variables of the series are the coordinates of the contact. The series is evaluated faster than the effect
        of friction could be computed.
        """
        contact = spread_contacts(self.domain, CONTACTS)
        unit_contact = self.domain.to_unit(contact)
        friction_charge = self.side_force_map.friction_charges(contact, self._coefficient)
        log_factor = np.log1p(0.5 * friction_charge / self.side_force_map.film.charges(contact))
        return Series(fit_series(unit_contact, log_factor, DEGREE, FORCE_DEGREE))

    def contact_covariance(self, sensitivity: ContactSensitivity) -> Array:
        """Compute the part of the covariance of each estimated contact that is caused by its side force.

        Contacts with the friction of the presses and contacts without friction are assumed to be equally probable. A
        declared side force is assumed to have the declared size and a random direction.

        Args:
            sensitivity: The contacts, and the derivatives of the estimated contacts with respect to the charges.

        Returns:
            Covariances of (x, y, ln F), shape (n, 3, 3).
        """
        contact = sensitivity.contact
        covariance = np.zeros((len(contact), 3, 3))
        if self._coefficient > 0.0:
            friction_charge = self.side_force_map.friction_charges(contact, self._coefficient)
            # The charge by friction is f (1 + e) or 0, each with the probability 0.5. Here f is `friction_charge`, and
            # e is the relative error of the coefficient. The model assumes f / 2. The mean squared difference from this
            # assumption is 0.5 ((1/2)^2 + e^2) f^2 + 0.5 (1/2)^2 f^2 = (0.25 + 0.5 e^2) f^2.
            relative_std = float(np.sqrt(0.25 + 0.5 * (self.friction.std / self._coefficient) ** 2))
            covariance += _covariance_of_charge_error(sensitivity.charge_gain, relative_std * friction_charge)
        if self.share > 0.0:
            # The mean square of each component of a force with a random direction is half of the squared force.
            side_force_std = self.share * contact[:, 2, None] / np.sqrt(2.0)  # shape (n, 1), N
            charge_per_newton = self.side_force_map.jacobian(contact)  # last axis: along x and along y
            for axis in range(2):
                charge_std = side_force_std * charge_per_newton[:, :, axis]
                covariance += _covariance_of_charge_error(sensitivity.charge_gain, charge_std)
        return covariance


def _covariance_of_charge_error(charge_gain: Array, charge_error: Array) -> Array:
    """Compute the part of the covariance of each estimated contact that is caused by an error of its charges.

    The errors of all charges of a contact are fully correlated, because all of them have the same cause.

    Args:
        charge_gain: Derivatives of the estimated (x, y, ln F) with respect to the charges, shape (n, 3, n_electrode),
            mm/pC, mm/pC and 1/pC.
        charge_error: Errors of the charges if their common cause has the size of one standard deviation, shape (n,
            n_electrode), pC.

    Returns:
        Covariances of (x, y, ln F), shape (n, 3, 3).
    """
    # Error of (x, y, ln F) for one standard deviation of the common cause, shape (n, 3): sums over the electrodes e
    contact_error = np.einsum("nie,ne->ni", charge_gain, charge_error)
    return np.asarray(contact_error[:, :, None] * contact_error[:, None, :])  # outer products
