"""Charges of measured presses on a film with given unknowns, and their derivatives, which the estimator needs."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.robust_estimate import ModelValues
from isocharge.train.calibration.discrepancy import terms
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import SESSION, Layout
from isocharge.train.calibration.press_data import PressData


@dataclass(frozen=True)
class Linearised:
    """Residuals of presses and their derivatives, at given unknowns and contacts.

    The residuals of a press are those of its charges and of its measured contact, in standard deviations.

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
        """Compare the charges of a model with those of presses.

        Args:
            model: Charges of the presses at the contacts, and their derivatives.
            data: The presses.
            contact: Contacts (x, y, ln F), shape (n, 3).
        """
        weight = 1.0 / data.charge_std
        contact_weight = 1.0 / data.contact_std
        charge_residual = weight * (model.charge_pC - data.charge)
        contact_rows = contact_weight[:, :, None] * np.eye(3)
        return cls(
            np.column_stack([charge_residual, contact_weight * (contact - data.contact)]),
            np.pad(weight[:, :, None] * model.by_state, ((0, 0), (0, 3), (0, 0))),
            np.concatenate([weight[:, :, None] * model.by_contact, contact_rows], axis=1),
        )

    def eliminated(self) -> tuple[Array, Array]:
        """Return the residuals and their derivatives after the best change of each contact.

        Returns:
            Residuals, shape (n, n_electrode + 3), and derivatives, shape (n, n_electrode + 3, n_unknown), both
            projected onto the space in which the contacts have no effect.
        """
        basis, _ = np.linalg.qr(self.contact_jacobian)  # shape (n, n_electrode + 3, 3)
        transposed = basis.swapaxes(1, 2)
        residual = self.residual - (basis @ (transposed @ self.residual[:, :, None]))[:, :, 0]
        return residual, self.jacobian - basis @ (transposed @ self.jacobian)

    def contact_change(self, change: Array) -> Array:
        """Return the best changes of the contacts (x, y, ln F), shape (n, 3), after a change of the unknowns."""
        residual = self.residual + self.jacobian @ change
        return -(np.linalg.pinv(self.contact_jacobian) @ residual[:, :, None])[:, :, 0]


def model_values(charges: FilmCharges, layout: Layout, data: PressData, unknowns: Array, contact: Array) -> ModelValues:
    """Compute the charges of presses for given unknowns, and their derivatives.

    Args:
        charges: Charges of a solved film and of similar films.
        layout: Order of the unknowns.
        data: The presses, from which the effects of the unknowns of the session follow.
        unknowns: Values of the unknowns, shape (n_unknown,).
        contact: Contacts (x, y, ln F), shape (n, 3).
    """
    metric_contact = in_domain(contact, charges)
    film_values = unknowns[layout.film]
    charge, film_jacobian = charges.linearised(film_values, metric_contact)
    session_jacobian = np.stack([one.effect(data, charge) for one in SESSION], axis=2)

    # The discrepancy multiplies the charge of its own electrode.
    term_values = terms(metric_contact, charges.domain)  # shape (n, n_term)
    own_charge = charge[:, :, None] * np.eye(charge.shape[1])
    coefficient_jacobian = own_charge[:, :, None, :] * term_values[:, None, :, None]

    jacobian = np.concatenate(
        [film_jacobian, session_jacobian, coefficient_jacobian.reshape(*charge.shape, -1)], axis=2
    )
    beyond_film = slice(layout.film.stop, None)
    return ModelValues(
        charge_pC=charge + jacobian[:, :, beyond_film] @ unknowns[beyond_film],
        by_contact=charges.contact_slopes(film_values, metric_contact),
        by_state=jacobian,
    )


def linearise(charges: FilmCharges, layout: Layout, data: PressData, unknowns: Array, contact: Array) -> Linearised:
    """Compute the residuals of presses and their derivatives; see `model_values`."""
    return Linearised.of(model_values(charges, layout, data, unknowns, contact), data, contact)


def in_domain(contact: Array, charges: FilmCharges) -> Array:
    """Convert contacts (x, y, ln F) to (x, y, F), and move contacts outside the domain to its nearest contact."""
    log_force = np.clip(contact[:, 2], *np.log(charges.domain.force_range))  # no number overflows
    return charges.into_domain(np.column_stack([contact[:, :2], np.exp(log_force)]))
