"""Estimate of a film: a Gaussian distribution of its properties, its discrepancy, and the unknowns of the session.

A real film has features that no property describes. The discrepancy is the smooth difference between the real charges
and the charges of the film with its best properties. For each electrode, a Gaussian process of finite rank models the
discrepancy (Kennedy and O'Hagan 2001). The relative change of the charge of the electrode e is

    sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= DEGREE, m <= FORCE_DEGREE,

with Chebyshev polynomials T, the radius r of the domain, and the logarithm l of the force, scaled to [-1, 1]. Each
coefficient c_eijm is the sum of two parts with the prior standard deviation s FADING^(i + j + m), where s is the size
of the discrepancy. One part is the same for all electrodes, because all charges are smaller where a film is stiffer
than its properties imply.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers
from isocharge.simulate import Domain, FilmPrior, NoiseModel
from isocharge.simulate.noise import NOISE_LEVELS
from isocharge.simulate.sensor.film_properties import PRETENSION, UNEVEN_TENSIONS

DEGREE = 4
"""Largest total degree of a term in x, y and ln F."""

FORCE_DEGREE = 2
"""Largest degree of a term in ln F."""

FADING = 0.5
"""Factor by which the standard deviation of a coefficient decreases if its total degree increases by one."""


def terms(contact: Array, domain: Domain) -> Array:
    """Compute the terms of the discrepancy, which are products of Chebyshev polynomials.

    The polynomials in x, y and ln F have the degrees i, j and m. Each term is multiplied by FADING^(i + j + m), so that
    terms of high degrees, which change quickly with the contact, have small effects.

    Args:
        contact: Contacts (x, y, F) within the domain, shape (n, 3), mm and N.
        domain: Range of positions and forces to which the variables of the polynomials are scaled.

    Returns:
        Values of the terms, shape (n, n_term), dimensionless.
    """
    i, j, m = _term_degrees().T  # each of shape (n_term,)
    x, y, log_force = domain.to_unit(contact).T
    all_products = chebyshev.chebvander3d(x, y, log_force, (DEGREE, DEGREE, FORCE_DEGREE))
    # The axes are the contact and the three degrees.
    product_by_degrees = all_products.reshape(-1, DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)
    factor = FADING ** (i + j + m)  # of each term, shape (n_term,)
    return np.asarray(factor * product_by_degrees[:, i, j, m])


def discrepancy_jacobian(charge: Array, contact: Array, domain: Domain) -> Array:
    """Compute the derivatives of charges with respect to the coefficients of the discrepancy.

    The discrepancy of an electrode is a relative change of the charge of this electrode.

    Args:
        charge: Charges without discrepancy, shape (n, n_electrode), pC.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        domain: Range of positions and forces to which the variables of the polynomials are scaled.

    Returns:
        Derivatives, shape (n, n_electrode, n_coefficient), pC. The coefficients of a term follow one another.
    """
    # A coefficient belongs to one term and one electrode, and only changes the charge of its own electrode. The axes of
    # the jacobian are the press, the electrode of the charge, the term, and the electrode of the coefficient.
    own_charge = charge[:, :, None] * np.eye(charge.shape[1])  # zero between different electrodes
    jacobian = own_charge[:, :, None, :] * terms(contact, domain)[:, None, :, None]
    return jacobian.reshape(*charge.shape, -1)


@cache
def _term_degrees() -> Integers:
    """Return the degrees of each term as a polynomial in x, y and ln F, shape (n_term, 3)."""
    all_degrees = np.indices((DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)).reshape(3, -1).T
    return np.asarray(all_degrees[all_degrees.sum(axis=1) <= DEGREE])


def unit_covariance(n_electrode: int) -> Array:
    """Return the prior covariance of the coefficients for a discrepancy of the size 1.

    The covariance does not contain the factors FADING^(i + j + m), because `terms` contains them. The coefficients of a
    term are correlated between electrodes.

    Returns:
        Covariance, shape (n_term * n_electrode, n_term * n_electrode). The coefficients of a term follow one another.
    """
    # A coefficient is the sum of a part of its own and a part that is the same for all electrodes, both of variance 1.
    between_electrodes = np.eye(n_electrode) + np.ones((n_electrode, n_electrode))
    return np.asarray(np.kron(np.eye(len(_term_degrees())), between_electrodes), dtype=float)


COEFFICIENT_DRIFT = 0.002
"""Standard deviation of the change of each coefficient of the discrepancy between two calibrations."""


@dataclass(frozen=True)
class SessionProperty:
    """Declaration of unknowns of a session of presses, whose effects on the charges are proportional to their values.

    Attributes:
        name: Name of the unknown. For `offset`, the name of the electrode is added to this name.
        stds: Standard deviations of the prior distribution that are considered, with their probabilities.
        effect: Function that computes the derivatives of the charges, shape (n, n_electrode, n_value). Its arguments
            are the times of the presses, shape (n,), the charges of the film, and their derivatives with respect to the
            force, both of shape (n, n_electrode).
        caution: Text of the caution about values that are certainly not zero. The values replace the field `values`.
    """

    name: str
    stds: tuple[tuple[float, float], ...]
    effect: Callable[[Array, Array, Array], Array]
    caution: str


SESSION = (
    SessionProperty(
        "offset",
        ((1e-6, 0.75), (10.0, 0.25)),
        lambda _time, charge, _slope: np.tile(np.eye(charge.shape[1]), (len(charge), 1, 1)),
        "the charges of all presses contain an offset of {values} pC: is the tare right? The model expects the same "
        "offset in later contacts; after a new tare, calibrate again",
    ),
    SessionProperty(
        "drift",
        ((1e-6, 0.95), (0.15, 0.05)),
        lambda time, charge, _slope: time[:, None, None] * charge[:, :, None],
        "the charges change by a share of {values} from the first press to the last: does an amplifier drift? The "
        "standard deviations of the model contain this change",
    ),
    SessionProperty(
        "force_offset",
        ((1e-6, 0.98), (0.03, 0.02)),
        lambda _time, _charge, slope: -slope[:, :, None],  # the true force is the stated force minus the offset
        "all known forces contain an offset of {values} N: is the load cell zero without a load? The forces of the "
        "model are without this offset",
    ),
)
"""All unknowns of a session, in their order in the vector of unknowns.

The smaller standard deviation stands for an unknown that is zero. It is positive, so that the covariance is invertible.
"""


@dataclass(frozen=True)
class Layout:
    """Order of the unknowns: properties of the film, unknowns of the session, coefficients of the discrepancy.

    Attributes:
        prior: Prior distribution of the properties of the film.
    """

    prior: FilmPrior

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all unknowns, in the order of their values in a vector.

        The order is: properties of the film, offsets of the electrodes, other unknowns of the session, coefficients of
        the discrepancy. The name of a coefficient contains the degrees of its term in x, y and ln F, such as "110".
        """
        electrodes = self.prior.sensor.electrode_names
        degree_texts = ["".join(map(str, degrees)) for degrees in _term_degrees().tolist()]
        coefficients = [f"discrepancy {degree_text} {name}" for degree_text in degree_texts for name in electrodes]
        # The first entry of `SESSION` declares the offsets, of which each electrode has one. The other entries declare
        # one unknown each.
        offsets = [f"offset {name}" for name in electrodes]
        return (*self.prior.names, *offsets, *(declared.name for declared in SESSION[1:]), *coefficients)

    @property
    def film(self) -> slice:
        """Slice of the vector with the properties of the film."""
        return slice(0, len(self.prior.names))

    @property
    def offset(self) -> slice:
        """Slice of the vector with the offsets of the electrodes, which are the first unknowns of the session."""
        return slice(self.film.stop, self.film.stop + len(self.prior.sensor.electrodes))

    @property
    def coefficients(self) -> slice:
        """Slice of the vector with the coefficients of the discrepancy."""
        return slice(self.offset.stop + len(SESSION) - 1, len(self.names))

    def index(self, name: str) -> int:
        """Return the index of an unknown."""
        return self.names.index(name)


@dataclass(frozen=True)
class FilmEstimate:
    """Gaussian distribution of the unknowns of a film.

    Attributes:
        layout: Order of the unknowns.
        values: Most probable values, shape (n_unknown,).
        covariance: Covariance, shape (n_unknown, n_unknown).
        noise: Noise of the charges, averaged over the hypotheses.
    """

    layout: Layout
    values: Array
    covariance: Array
    noise: NoiseModel = NOISE_LEVELS["reference"]

    @property
    def film_values(self) -> Array:
        """Properties of the film, shape (n_property,)."""
        return self.values[self.layout.film]

    def value(self, name: str) -> float:
        """Return the most probable value of a named unknown."""
        return float(self.values[self.layout.index(name)])

    def std(self, name: str) -> float:
        """Return the standard deviation of a named unknown."""
        index = self.layout.index(name)
        return float(np.sqrt(self.covariance[index, index]))

    def drifted(self) -> "FilmEstimate":
        """Return the estimate with which a later session begins.

        The covariance is increased, because the film may have drifted since this session. A drift of the pretension
        comes from a change of the temperature, which adds the same tension in all directions. The estimate contains the
        uneven parts of the tension as shares of the mean tension. The uneven parts do not drift, so the drift of the
        mean tension changes their shares. The unknowns of this session, such as the offsets, become zero with the
        variance zero.
        """
        layout = self.layout
        drift_std = np.zeros(len(self.values))
        drift_std[layout.film] = [declared.drift for declared in layout.prior.properties]
        drift_std[layout.coefficients] = COEFFICIENT_DRIFT
        # Each column contains the changes of all unknowns by one standard deviation of the drift of one unknown.
        drift_effects = np.diag(drift_std)
        tension_index = layout.index(PRETENSION.name)
        for name in UNEVEN_TENSIONS:
            # A share s = t / T of the constant uneven part t changes by -s / T per MPa of the mean tension T. The lower
            # limit of T avoids a very large change for a film that is nearly slack.
            share_change_per_MPa = -self.value(name) / max(self.values[tension_index], PRETENSION.drift)
            drift_effects[layout.index(name), tension_index] = share_change_per_MPa * PRETENSION.drift
        covariance = self.covariance + drift_effects @ drift_effects.T

        # Set the unknowns of this session to zero: their values, and their rows and columns of the covariance. In the
        # order of the unknowns, they lie between the properties of the film and the coefficients of the discrepancy.
        session = slice(layout.film.stop, layout.coefficients.start)
        values = self.values.copy()
        values[session] = 0.0
        covariance[session] = 0.0
        covariance[:, session] = 0.0
        return replace(self, values=values, covariance=covariance)

    def session_cautions(self) -> list[str]:
        """Return sentences about session unknowns that differ from zero by more than three standard deviations."""
        cautions = []
        for session_property in SESSION:
            # The property `offset` has one unknown for each electrode, with a name such as "offset A". Any other
            # property has one unknown with the name of the property.
            significant_values = [
                f"{self.value(name):.3g} +- {self.std(name):.2g} ({name})"
                for name in self.layout.names
                if name.startswith(session_property.name) and abs(self.value(name)) > 3.0 * self.std(name)
            ]
            if significant_values:
                cautions.append(session_property.caution.format(values=", ".join(significant_values)))
        return cautions


REMAINING_DISCREPANCY = 0.3
"""Size of the part of the discrepancy that an earlier calibration could not show, relative to the hypothesis."""

PLANNING_SIZES = np.array([1.0, 0.5, 0.5, 0.01, *(session_property.stds[0][0] for session_property in SESSION)])
"""Sizes of the parts of the prior covariance that are assumed to plan presses before the first press."""


@dataclass(frozen=True)
class Prior:
    """Gaussian prior distribution of all unknowns.

    Attributes:
        layout: Order of the unknowns.
        earlier: Estimate of an earlier calibration, including the drift since then; None for the prior distribution of
            the sensor.
    """

    layout: Layout
    earlier: FilmEstimate | None = None

    @property
    def mean(self) -> Array:
        """Means of the unknowns, shape (n_unknown,).

        After an earlier calibration, the means are the values of its estimate. Otherwise, they are the declared means
        of the properties of the film, and zero for all other unknowns.
        """
        if self.earlier is not None:
            return self.earlier.values
        mean = np.zeros(self.layout.coefficients.stop)  # the coefficients are the last unknowns
        mean[self.layout.film] = self.layout.prior.mean
        return mean

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the unknowns, shape (n_unknown,), infinite except for properties of the film."""
        high = np.full(self.layout.coefficients.stop, np.inf)
        low = -high
        low[self.layout.film], high[self.layout.film] = self.layout.prior.bounds
        return low, high

    @cached_property
    def parts(self) -> Array:
        """Matrices whose weighted sum is the covariance of the unknowns, shape (4 + n_session, n_unknown, n_unknown).

        The first part is the covariance that is the same under all hypotheses. The other parts are the covariances of
        the uneven tension, of the other imperfections, of the discrepancy, and of each entry of `SESSION`, as they are
        if their sizes are 1. A hypothesis multiplies each of these parts by the square of a size; see
        `Hypothesis.sizes`. The first entry of `SESSION` declares the offsets of the electrodes. Each other entry
        declares one unknown.

        After an earlier calibration, the first part is the covariance of the earlier estimate, which includes the
        imperfections. The parts of the imperfections are then zero, and the part of the discrepancy describes only what
        the earlier calibration could not show.
        """
        layout = self.layout
        n_unknown = layout.coefficients.stop  # the coefficients are the last unknowns
        parts = np.zeros((4 + len(SESSION), n_unknown, n_unknown))
        # These matrices are views of `parts`. They are filled below, one after the other.
        fixed, uneven_tension, other_imperfections, discrepancy, offset, *other_session_parts = parts
        n_electrode = len(layout.prior.sensor.electrode_names)
        coefficient_covariance = unit_covariance(n_electrode)
        discrepancy[layout.coefficients, layout.coefficients] = coefficient_covariance
        # An offset, like a coefficient, is the sum of a part of its own and a part that is the same for all electrodes.
        offset[layout.offset, layout.offset] = coefficient_covariance[:n_electrode, :n_electrode]
        # The other unknowns of the session follow the offsets, in the order of their parts.
        for index, part in enumerate(other_session_parts, layout.offset.stop):
            part[index, index] = 1.0
        if self.earlier is not None:
            fixed += self.earlier.covariance
            discrepancy *= REMAINING_DISCREPANCY**2
            return parts

        # Distribute the variances of the properties of the film over the first three parts. Each property belongs to
        # one part, and its variance in the other parts is zero.
        is_imperfection = layout.prior.is_imperfection
        is_tension = np.isin(layout.prior.names, UNEVEN_TENSIONS)
        for part, is_in_part in (
            (fixed, ~is_imperfection),
            (uneven_tension, is_tension),
            (other_imperfections, is_imperfection & ~is_tension),
        ):
            part[layout.film, layout.film] = np.diag(is_in_part * layout.prior.std**2)
        return parts

    def covariance(self, sizes: Array) -> Array:
        """Return the covariance of the unknowns, shape (n_unknown, n_unknown).

        Args:
            sizes: Sizes of the parts, shape (4 + n_session,). Each part is multiplied by the square of its size.
        """
        return np.tensordot(sizes**2, self.parts, 1)
