"""Charges of presses on the perfect films of a prior, and derivatives of these charges.

A perfect film has no imperfections, no discrepancy, and only traces that the sensor file contains. The parameters of
`FilmPrior` describe a perfect film completely.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import Circle, Film, ForwardMap
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.sensor.film_prior import PARAMETERS, SHARED, FilmPrior

STEP = 0.005
"""Step of the finite differences with respect to a parameter, in prior standard deviations of the parameter."""

STEPPED = tuple(parameter.name for parameter in PARAMETERS if parameter.derivative == "difference")
"""Names of the parameters whose derivatives are computed as finite differences."""

CONTACT_STEPS = (5e-3, 5e-3, 1e-3)
"""Steps of the finite differences in x, y (mm) and ln F.

The steps are small, because the domain is reduced by one step to leave a margin for the finite differences."""

CACHED_MAPS = 8
"""Largest number of forward maps that are cached."""

EDGE = 1.0 - 1e-6
"""Fraction of the largest radius and force of the family up to which charges are computed.

It is slightly below 1, so that rounding errors do not lead outside the family."""

FORCE_MARGIN = 1.01
"""Factor by which the range of forces is reduced at both ends, for the finite differences with respect to the force."""


@dataclass(frozen=True)
class FilmMaps:
    """Forward maps of the perfect films of a prior. A forward map computes charges from contacts.

    Attributes:
        prior: Distribution of the films, which declares the parameters.
        family: Films that were simulated in advance. The forward maps of other films are interpolated between them.
    """

    prior: FilmPrior
    family: FilmFamily

    @cached_property
    def domain(self) -> Domain:
        """Range of contacts in which the charges of every film of the prior can be computed.

        The range is small enough to leave a margin for finite differences. It is a disk with a range of forces. The
        smallest load of the family requires the largest force on the stiffest film, which therefore determines the
        smallest force of the range. Correspondingly, the softest film determines the largest force.
        """
        film = self.prior.sensor.film
        young = self.prior.index("young")
        thickness = self.prior.index("thickness")
        # The parameters "young" and "thickness" are logarithms of factors relative to the described film.
        stiffness = film.young * film.thickness * film.radius
        lower, upper = self.prior.bounds
        min_stiffness = stiffness * np.exp(lower[young] + lower[thickness])
        max_stiffness = stiffness * np.exp(upper[young] + upper[thickness])

        # The family of simulated films is limited in two dimensionless variables: the distance from the centre divided
        # by the radius a of the film, and the load F / (E h a). The factors with `EDGE` keep rounding errors from
        # leading outside these limits. The step and `FORCE_MARGIN` leave room for finite differences.
        _, max_distance = self.family.limits["distance"]
        min_load, max_load = self.family.limits["load"]
        position_step, _, _ = CONTACT_STEPS
        radius = EDGE * max_distance * film.radius - position_step
        above_edge = 2.0 - EDGE  # as far above 1 as `EDGE` is below 1
        min_force = float(min_load * max_stiffness) * above_edge * FORCE_MARGIN
        max_force = float(max_load * min_stiffness) * EDGE / FORCE_MARGIN
        return Domain(radius, (min_force, max_force))

    def forward_map(self, parameters: Array) -> ForwardMap:
        """Return the forward map of one film.

        Films that differ only in piezoelectric coefficients, gains and electrodes have the same stresses. Therefore,
        the forward maps are cached by film and probe. The returned map contains the sensor that belongs to the given
        parameters. The cache contains at most `CACHED_MAPS` maps.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
        """
        sensor, probe = self.prior.film(parameters)
        key = (sensor.film, probe)
        if key not in self._maps:
            if len(self._maps) >= CACHED_MAPS:
                oldest_key = next(iter(self._maps))
                del self._maps[oldest_key]
            self._maps[key] = self.family.forward_map(sensor, probe)
        return replace(self._maps[key], sensor=sensor)

    @cached_property
    def _maps(self) -> dict[tuple[Film, Circle], ForwardMap]:
        """Cache of `forward_map`, by film and probe. The oldest entry is the first one."""
        return {}

    def parameter_jacobian(
        self, film: ForwardMap, parameters: Array, contact: Array, charge: Array, force_derivative: Array
    ) -> Array:
        """Compute the derivatives of the charges of a film with respect to its parameters.

        Only some derivatives need finite differences. The other derivatives follow from scaling laws of the charges,
        and from the linear dependence of the charges on d31, d32 and the gains. The charges have the form
        E q(F / (E h a), T / E, h / a), where E is Young's modulus, F is the force, h is the thickness, a is the radius
        of the film, and T is the pretension.

        Args:
            film: Forward map of the film.
            parameters: Parameters of the film, shape (n_parameter,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts, shape (n, n_electrode), pC.
            force_derivative: Derivatives of the charges with respect to ln F, shape (n, n_electrode), pC.

        Returns:
            Derivatives, shape (n, n_electrode, n_parameter), pC per unit of the parameter.
        """
        pretension = parameters[self.prior.index("pretension")]
        derivatives = {name: self.finite_difference(name, parameters, contact, charge) for name in STEPPED}

        # Chain rule for the charge E q(F / (E h a), T / E, h / a), with respect to ln E and ln h. The finite difference
        # for "thickness" is computed at a constant load F / (E h a), so the effect of the load is added here.
        derivatives["young"] = charge - force_derivative - pretension * derivatives["pretension"]
        derivatives["thickness"] = derivatives["thickness"] - force_derivative

        # The charge is the sum of a part proportional to d31 and a part proportional to d32. The derivative with
        # respect to ln d32 is the second part, and the derivative with respect to ln d31 is the rest of the charge.
        piezo = film.sensor.piezo
        derivatives["d32"] = np.zeros_like(charge)
        if piezo.d32 != 0.0:
            d32_alone = replace(film, sensor=replace(film.sensor, piezo=replace(piezo, d31=0.0)))
            derivatives["d32"] = d32_alone.charges(contact)
        derivatives["d31"] = charge - derivatives["d32"]

        # The parameters are in the order of `SHARED`, followed by the ln gain of each electrode.
        shared_jacobian = np.stack([derivatives[name] for name in SHARED], axis=2)
        gain_jacobian = charge[:, :, None] * np.eye(charge.shape[1])
        return np.concatenate([shared_jacobian, gain_jacobian], axis=2)

    def finite_difference(self, name: str, parameters: Array, contact: Array, charge: Array) -> Array:
        """Compute the derivative of the charges with respect to one parameter by a finite difference.

        The derivative is computed at constant contacts, except if the parameter is the thickness h. In this case, the
        force F changes in proportion to h. The load F / h is then constant, and the derivative contains only the effect
        of bending.

        Args:
            name: Name of the parameter.
            parameters: Parameters of the film, shape (n_parameter,).
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge: Charges of these contacts, shape (n, n_electrode), pC.

        Returns:
            Derivatives, shape (n, n_electrode), pC per unit of the parameter.
        """
        index = self.prior.index(name)
        _, upper_bounds = self.prior.bounds
        step = STEP * self.prior.std[index]
        if parameters[index] + step > upper_bounds[index]:  # keep the changed parameter within its bounds
            step = -step
        stepped_parameters = parameters.copy()
        stepped_parameters[index] += step
        rounded_step = stepped_parameters[index] - parameters[index]  # after rounding to floating-point numbers
        stepped_contact = contact
        if name == "thickness":
            stepped_contact = contact * [1.0, 1.0, np.exp(rounded_step)]  # keeps F / h constant
        stepped_charge = self.forward_map(stepped_parameters).charges(stepped_contact)
        return np.asarray((stepped_charge - charge) / rounded_step)


def log_force_derivative(film: ForwardMap, contact: Array) -> Array:
    """Compute the derivatives of the charges of a forward map with respect to ln F.

    Args:
        film: Forward map of the film.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Derivatives, shape (n, n_electrode), pC.
    """
    _, _, log_force_step = CONTACT_STEPS
    force_factor = np.array([1.0, 1.0, np.exp(log_force_step)])  # changes only the force of (x, y, F)
    charge_above = film.charges(contact * force_factor)
    charge_below = film.charges(contact / force_factor)
    return np.asarray((charge_above - charge_below) / (2.0 * log_force_step))
