"""Measured presses in the form that the least-squares fit of a film uses."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

UNKNOWN_FORCE_STD = 1.5
"""Assumed standard deviation of the logarithm of a force that was not measured.

The assumed mean is the middle of the logarithmic range of forces."""

NODE_DISTANCE_MPa = 0.5
"""Approximate distance between the pretensions at which charges are computed, MPa.

Several pretensions are used only if the pretension differs between the presses."""


@dataclass(frozen=True)
class PressData:
    """Measured presses with the weights of their charges and contacts.

    Each press has one residual for each electrode. Three further residuals belong to the measured contact (x, y, ln F).

    Attributes:
        charge: Measured charges, shape (n, n_electrode), pC; 0 where unknown.
        weight: Inverse of the standard deviation of each charge, shape (n, n_electrode), 1/pC; 0 where unknown.
        contact: Measured contacts (x, y, ln F), shape (n, 3); the middle of the domain where unknown.
        contact_weight: Inverse of the standard deviation of each coordinate of the contact, shape (n, 3); small where
            unknown.
        measured: Whether each charge and each coordinate was measured, shape (n, n_electrode + 3).
        session_time: Time of each press, from -1/2 for the first press to 1/2 for the last press, shape (n,),
            dimensionless.
        warming_K: Temperature of each press minus the mean temperature of all presses, shape (n,), K.
        film_excess_K: Temperature difference between film and ring during each press, minus the mean of this
            difference, shape (n,), K. Zero if the temperature of the film was not measured.
        tension_change: Pretension during each press minus the pretension of the film, shape (n,), MPa.
        friction_charge: Charges that friction adds, divided by the coefficient of friction, shape (n, n_electrode), pC;
            zero for presses without friction.
    """

    charge: Array
    weight: Array
    contact: Array
    contact_weight: Array
    measured: Booleans
    session_time: Array
    warming_K: Array
    film_excess_K: Array
    tension_change: Array
    friction_charge: Array

    @classmethod
    def from_presses(cls, presses: MeasuredPresses, noise: NoiseModel, domain: Domain) -> "PressData":
        """Convert measured presses into data for a fit.

        A missing charge gets the weight 0. A missing x, y or ln F is replaced by its value at the centre of the domain.
        Its standard deviation is then the radius of the domain, or `UNKNOWN_FORCE_STD` for ln F.

        Args:
            presses: The measured presses.
            noise: Noise of the charges.
            domain: Range of contacts for which the charges of the films are known.
        """
        # Missing values are NaN.
        has_charge = ~np.isnan(presses.charge_pC)
        charge = np.where(has_charge, presses.charge_pC, 0.0)
        log_contact = np.column_stack([presses.contact[:, :2], np.log(presses.contact[:, 2])])
        has_coordinate = ~np.isnan(log_contact)
        rig_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
        unknown_std = [domain.radius, domain.radius, UNKNOWN_FORCE_STD]
        temperature_C = temperatures(presses)
        # The time runs from -1/2 to 1/2 in the session. The presses are assumed to be made at equal intervals. A single
        # press has the time 0.
        session_time = np.linspace(-0.5, 0.5, len(presses)) if len(presses) > 1 else np.zeros(1)
        return cls(
            charge=charge,
            weight=np.where(has_charge, 1.0 / noise.sigma(charge), 0.0),
            contact=np.where(has_coordinate, log_contact, domain.centre),
            contact_weight=1.0 / np.where(has_coordinate, rig_std, unknown_std),
            measured=np.column_stack([has_charge, has_coordinate]),
            session_time=session_time,
            warming_K=temperature_C - temperature_C.mean(),
            film_excess_K=_film_excess(presses),
            tension_change=np.zeros(len(presses)),  # `without_nuisances` sets this value
            friction_charge=np.zeros_like(charge),  # `with_friction` sets this value if there is friction
        )

    def __getitem__(self, rows: Integers | Booleans) -> "PressData":
        """Return the data of selected presses, which are the given rows of every attribute."""
        return PressData(**{name: column[rows] for name, column in vars(self).items()})

    def __len__(self) -> int:
        return len(self.contact)

    @property
    def has_charge(self) -> Booleans:
        """Whether each charge was measured, shape (n, n_electrode)."""
        return self.measured[:, : self.charge.shape[1]]

    @property
    def has_place(self) -> Booleans:
        """Whether both coordinates of each position were measured, shape (n,)."""
        electrode_count = self.charge.shape[1]
        position = self.measured[:, electrode_count : electrode_count + 2]
        return np.asarray(position.all(axis=1))

    def with_force_scatter(self, share: float) -> "PressData":
        """Return a copy of the presses with a larger uncertainty of the forces.

        Args:
            share: Standard deviation of the scatter, relative to the force. Its square is added to the variance of the
                rig.
        """
        x_weight, y_weight, force_weight = self.contact_weight.T
        rig_std = 1.0 / force_weight
        total_std = np.hypot(rig_std, share)  # the variances of independent errors are added
        return replace(self, contact_weight=np.column_stack([x_weight, y_weight, 1.0 / total_std]))

    def force_derivative(self) -> Array:
        """Return the derivatives of the residuals with respect to the logarithm of the measured force.

        Only the last residual of each press depends on the measured force.

        Returns:
            Derivatives, shape (n, n_electrode + 3).
        """
        _, _, force_weight = self.contact_weight.T
        derivatives = np.zeros(self.measured.shape)
        derivatives[:, -1] = -force_weight
        return derivatives

    def pretension_nodes(self, pretension: float, bounds: tuple[float, float]) -> tuple[Array, Array]:
        """Return pretensions at which charges are computed, and weights for the interpolation at each press.

        The pretension during a press is that of the film plus the `tension_change` of the press. The returned
        pretensions are Chebyshev nodes between the smallest and the largest pretension of the presses. The weights are
        those of Lagrange's interpolation. If all presses have the same pretension, this pretension is the only node.

        Args:
            pretension: Pretension of the film, MPa.
            bounds: Smallest and largest pretension that a film may have, MPa.

        Returns:
            Nodes, shape (k,), MPa, and the weight of each node for each press, shape (n, k).
        """
        # Without presses, the limits are infinite (`low` is inf, `high` is -inf), and the node does not matter.
        press_pretensions = np.clip(pretension + self.tension_change, *bounds)  # shape (n,)
        low = float(press_pretensions.min(initial=np.inf))
        high = float(press_pretensions.max(initial=-np.inf))
        if high <= low:  # all presses have the same pretension, or there are no presses
            return np.array([low]), np.ones((len(self), 1))

        node_count = 2 + int(np.ceil((high - low) / NODE_DISTANCE_MPa))
        nodes = chebyshev_nodes(node_count, low, high)
        weights = lagrange_values(nodes, barycentric_weights(nodes), press_pretensions)
        return nodes, weights

    def residual(self, charge: Array, contact: Array) -> Array:
        """Return the residuals of the presses for given contacts, in units of their standard deviations.

        Args:
            charge: Charges of a film at these contacts, shape (n, n_electrode), pC.
            contact: Contacts (x, y, ln F), shape (n, 3).

        Returns:
            Residuals, shape (n, n_electrode + 3).
        """
        charge_residual = self.weight * (charge - self.charge)
        rig_residual = self.contact_weight * (contact - self.contact)
        return np.column_stack([charge_residual, rig_residual])

    def residual_slopes(self, charge_slopes: Array) -> Array:
        """Return the derivatives of the residuals with respect to the contact (x, y, ln F).

        Args:
            charge_slopes: Derivatives of the charges with respect to the contact, shape (n, n_electrode, 3).

        Returns:
            Derivatives, shape (n, n_electrode + 3, 3).
        """
        charge_residual_slopes = self.weight[:, :, None] * charge_slopes
        # Each residual of the rig depends only on its own coordinate, so its derivatives form a diagonal matrix.
        rig_residual_slopes = self.contact_weight[:, :, None] * np.eye(3)
        return np.concatenate([charge_residual_slopes, rig_residual_slopes], axis=1)


def temperatures(presses: MeasuredPresses) -> Array:
    """Return the temperature of each press, shape (n,), degrees Celsius.

    A missing temperature is interpolated between the temperatures of the previous and the next press. If no temperature
    was measured, the function returns zeros.

    Args:
        presses: The measured presses.
    """
    if presses.temperature_C is None or not presses.knows_temperature:
        return np.zeros(len(presses))
    return _without_gaps(presses.temperature_C)


def _film_excess(presses: MeasuredPresses) -> Array:
    """Return the temperature difference between film and ring for each press, minus the mean difference.

    Args:
        presses: The measured presses.

    Returns:
        Differences, shape (n,), K. Zeros if the temperature of the film was not measured.
    """
    if presses.film_temperature_C is None or not presses.knows_film_temperature:
        return np.zeros(len(presses))
    excess = _without_gaps(presses.film_temperature_C) - temperatures(presses)
    return np.asarray(excess - excess.mean())


def _without_gaps(temperature_C: Array) -> Array:
    """Interpolate each missing temperature between the temperatures of the previous and the next press.

    Args:
        temperature_C: Temperatures, shape (n,), degrees Celsius; NaN where missing. At least one is measured.

    Returns:
        Temperatures without gaps, shape (n,), degrees Celsius.
    """
    press_index = np.arange(len(temperature_C))
    is_measured = np.isfinite(temperature_C)
    return np.interp(press_index, press_index[is_measured], temperature_C[is_measured])


def no_presses(electrodes: tuple[str, ...]) -> MeasuredPresses:
    """Create an empty list of presses for electrodes with the given names."""
    return MeasuredPresses(
        contact=np.empty((0, 3)),
        charge_pC=np.empty((0, len(electrodes))),
        position_std_mm=np.empty(0),
        force_std=np.empty(0),
        electrodes=electrodes,
        lines=(),
    )
