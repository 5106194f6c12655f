"""Measured presses in the form that the estimator needs, and their charges on a film with given unknowns."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.contact_domain import into_unit_domain, with_log_force
from isocharge.serve.model.robust_estimate import ModelValues
from isocharge.serve.presses.measured_presses import MeasuredPresses
from isocharge.simulate import Domain, NoiseModel
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import SESSION, Layout, discrepancy_jacobian

UNKNOWN_STD = np.inf
"""Standard deviation of a value that was not measured."""


class PressErrors(NamedTuple):
    """Standard deviations of the errors of presses, which may be larger than the user states.

    Attributes:
        noise: Noise of the charges.
        position_ratio: Standard deviation of the positions, divided by the stated standard deviation.
        force_scatter: Standard deviation of a further error of the forces, relative to the force.
        constant_force_scatter: Standard deviation of a further error of the forces, relative to their geometric mean.
            This standard deviation is the same for small and large forces, like that of the noise of a load cell.
    """

    noise: NoiseModel
    position_ratio: float = 1.0
    force_scatter: float = 0.0
    constant_force_scatter: float = 0.0


@dataclass(frozen=True)
class PressData:
    """Measured presses.

    Attributes:
        charge: Charges, shape (n, n_electrode), pC; zero if unknown.
        charge_std: Standard deviations of the noise, shape (n, n_electrode), pC; infinite if the charge is unknown.
        noise: Noise of the charges, from which the standard deviations `charge_std` follow.
        contact: Measured contacts (x, y, ln F), shape (n, 3); the middle of the domain if unknown.
        contact_std: Standard deviations of the contacts, shape (n, 3); infinite if unknown.
        time: Time of each press in the session, from -0.5 to 0.5, shape (n,).
    """

    charge: Array
    charge_std: Array
    noise: NoiseModel
    contact: Array
    contact_std: Array
    time: Array

    @classmethod
    def of(cls, presses: MeasuredPresses, noise: NoiseModel, domain: Domain) -> "PressData":
        """Convert measured presses whose electrodes are in the order of the sensor.

        The standard deviations of the positions contain the factor for presses at one place
        (`MeasuredPresses.same_place_count`).

        Args:
            presses: The presses; NaN stands for unknown values.
            noise: Noise of the charges.
            domain: Domain of the possible contacts.
        """
        # Replace unknown values by finite numbers. Their standard deviations are infinite, so they do not count.
        # Presses at one place share one error of the position. The estimator treats the errors as independent, so the
        # variance of each position is multiplied by the number of presses at its place.
        is_charge_known = np.isfinite(presses.charge_pC)
        charge = np.where(is_charge_known, presses.charge_pC, 0.0)
        log_contact = with_log_force(presses.contact)
        is_contact_known = np.isfinite(log_contact)
        position_std = presses.position_std_mm * np.sqrt(presses.same_place_count)
        measured_std = np.column_stack([position_std, position_std, presses.force_std])
        return cls(
            charge=charge,
            charge_std=np.where(is_charge_known, noise.sigma(charge), UNKNOWN_STD),
            noise=noise,
            contact=np.where(is_contact_known, log_contact, domain.centre),
            contact_std=np.where(is_contact_known, measured_std, UNKNOWN_STD),
            time=np.linspace(-0.5, 0.5, len(presses)),  # as if the presses were evenly spaced in time
        )

    def __len__(self) -> int:
        return len(self.charge)

    @property
    def measured_std(self) -> Array:
        """Standard deviations of the charges and of the contacts, shape (n, n_electrode + 3); infinite if unknown."""
        return np.column_stack([self.charge_std, self.contact_std])

    @property
    def redundancy(self) -> Integers:
        """Number of redundant measurements of each press, shape (n,). The contact of a press has three unknowns."""
        return np.asarray(np.maximum(np.isfinite(self.measured_std).sum(axis=1) - 3, 0))

    def __getitem__(self, rows: Booleans) -> "PressData":
        """Return some of the presses. The times of these presses do not change."""
        names = ("charge", "charge_std", "contact", "contact_std", "time")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def with_errors(self, errors: PressErrors) -> "PressData":
        """Return a copy of these presses with larger or smaller standard deviations of the measurements.

        The noise of the charges is replaced. The stated standard deviations of the positions are multiplied by
        `position_ratio`. Two further errors are added to the stated errors of the forces.

        Args:
            errors: Noise of the charges, ratio for the positions, and the two further errors of the forces. The first
                error of the forces is relative to each force. The second error is the same for all forces, and is
                stated relative to their geometric mean.
        """
        noise, position_ratio, force_scatter, constant_scatter = errors
        charge_std = np.where(np.isfinite(self.charge_std), noise.sigma(self.charge), UNKNOWN_STD)
        # All standard deviations of forces are relative to the force F. The ratio of the geometric mean of the forces
        # to F follows from the logarithms ln F.
        log_force = self.contact[:, 2]
        relative_constant = constant_scatter * np.exp(log_force.mean() - log_force)
        # The variances of the three independent errors are added.
        force_std = np.hypot(np.hypot(self.contact_std[:, 2], force_scatter), relative_constant)
        contact_std = np.column_stack([position_ratio * self.contact_std[:, :2], force_std])
        return replace(self, charge_std=charge_std, noise=noise, contact_std=contact_std)


@dataclass(frozen=True)
class Linearised:
    """Residuals of presses and their derivatives, at given unknowns and contacts.

    The residuals of a press are those of its charges and of its measured contact, in standard deviations of the
    measurements.

    Attributes:
        residual: Residuals, shape (n, n_electrode + 3).
        jacobian: Derivatives with respect to the unknowns, shape (n, n_electrode + 3, n_unknown).
        contact_jacobian: Derivatives with respect to the contact (x, y, ln F), shape (n, n_electrode + 3, 3).
    """

    residual: Array
    jacobian: Array
    contact_jacobian: Array

    @classmethod
    def of(cls, model: ModelValues, data: PressData, contact: Array) -> "Linearised":
        """Compute the residuals of presses, and their derivatives, from the charges of a model and from given contacts.

        The residuals of a press are those of its charges and of the three coordinates of its contact, divided by the
        standard deviations of the measurements.

        Args:
            model: Charges of the presses at the contacts, and their derivatives.
            data: The presses.
            contact: Contacts (x, y, ln F), shape (n, 3).
        """
        weight = 1.0 / data.measured_std
        residual = np.column_stack([model.charge_pC - data.charge, contact - data.contact])
        # The first rows of a press belong to its charges, and the last three to its contact. The unknowns do not change
        # the contact (rows of zeros), and each coordinate of the contact only changes itself (identity matrix). The
        # unknowns take the place of the state in `ModelValues`.
        jacobian = np.pad(model.by_state, ((0, 0), (0, 3), (0, 0)))  # three further rows of zeros for each press
        contact_rows = np.tile(np.eye(3), (len(data), 1, 1))
        contact_jacobian = np.concatenate([model.by_contact, contact_rows], axis=1)
        return cls(weight * residual, weight[:, :, None] * jacobian, weight[:, :, None] * contact_jacobian)

    @property
    def log_contact_volume(self) -> float:
        """Logarithm of the volume of the contacts of all presses that agree with the measurements, up to a constant."""
        precision = self.contact_jacobian.swapaxes(1, 2) @ self.contact_jacobian
        precision += 1e-6 * np.eye(3)  # without it, the volume of fewer than three measurements is infinite
        _, log_determinants = np.linalg.slogdet(precision)
        return float(-0.5 * log_determinants.sum())

    def eliminated(self) -> tuple[Array, Array]:
        """Return the part of the residuals that no change of the contacts can reduce, and its derivatives.

        The residuals of a press are a vector. A change of the three coordinates of the contact changes this vector only
        within a subspace of three dimensions. The results are the components of the vector in an orthonormal basis of
        the other n_electrode dimensions.

        Returns:
            Residuals, shape (n, n_electrode), and derivatives with respect to the unknowns, shape (n, n_electrode,
            n_unknown).
        """
        # The first three columns of the complete basis span the subspace of the contact, and the others the rest.
        basis, _ = np.linalg.qr(self.contact_jacobian, mode="complete")
        projection = basis[:, :, 3:].swapaxes(1, 2)  # shape (n, n_electrode, n_electrode + 3)
        residual = (projection @ self.residual[:, :, None])[:, :, 0]
        return residual, projection @ self.jacobian

    def contact_change(self, change: Array) -> Array:
        """Return the changes of the contacts that minimise the squared residuals after a change of the unknowns.

        The residuals depend linearly on the unknowns and on the contacts. For each press, the change of the contact is
        the solution of a linear least-squares problem, which the pseudoinverse gives.

        Args:
            change: Change of the unknowns, shape (n_unknown,).

        Returns:
            Changes of x, y and ln F, shape (n, 3).
        """
        residual = self.residual + self.jacobian @ change  # after the change of the unknowns, shape (n, n_row)
        solution = np.linalg.pinv(self.contact_jacobian) @ residual[:, :, None]
        return -solution[:, :, 0]


def model_values(charges: FilmCharges, layout: Layout, time: Array, unknowns: Array, contact: Array) -> ModelValues:
    """Compute the charges of presses for given unknowns, and their derivatives.

    The unknowns are properties of the film, unknowns of the session of presses such as the offsets of the electrodes,
    and coefficients of the discrepancy between the real film and its description.

    Args:
        charges: Charges of a solved film and of similar films.
        layout: Order of the unknowns.
        time: Time of each press in the session, from -0.5 to 0.5, shape (n,).
        unknowns: Values of the unknowns, shape (n_unknown,).
        contact: Contacts (x, y, ln F), shape (n, 3). A contact outside the domain is replaced by the nearest contact
            inside.

    Returns:
        Charges, pC, and their derivatives with respect to the contact (x, y, ln F) and to the unknowns.
    """
    metric_contact = in_domain(contact, charges.domain)  # (x, y, F), mm and N
    film_charge, contact_slopes, film_jacobian = charges.linearised(unknowns[layout.film], metric_contact)
    # The derivatives with respect to ln F, divided by F, are the derivatives with respect to F, pC/N.
    force_slope = contact_slopes[:, :, 2] / metric_contact[:, 2:]
    # The method `effect` returns the derivatives of the charges with respect to an unknown of the session.
    session_jacobians = [session_unknown.effect(time, film_charge, force_slope) for session_unknown in SESSION]
    coefficient_jacobian = discrepancy_jacobian(film_charge, metric_contact, charges.domain)
    jacobian = np.concatenate([film_jacobian, *session_jacobians, coefficient_jacobian], axis=2)

    # The unknowns of the session and the coefficients of the discrepancy follow those of the film. The charges are
    # linear in these unknowns, so each unknown adds its value times its derivatives.
    beyond_film = slice(layout.film.stop, None)
    addition = jacobian[:, :, beyond_film] @ unknowns[beyond_film]
    return ModelValues(film_charge + addition, contact_slopes, jacobian)


def in_domain(contact: Array, domain: Domain) -> Array:
    """Convert contacts (x, y, ln F) to (x, y, F), and move contacts outside a domain to the nearest contacts inside."""
    return domain.to_contact(into_unit_domain((contact - domain.centre) / domain.scale))
