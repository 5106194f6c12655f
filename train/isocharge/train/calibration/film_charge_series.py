"""Content of the file `film_charges.npz`: Chebyshev series of the charges of a calibrated film at several pretensions.

The charge of a film is the product of two parts: the charge of an ideal film with the same parameters, and a factor
that describes the imperfections and the discrepancy of the film. The two parts are fitted separately. The ideal charge
is computed quickly, but it needs a series of high degree. The factor is computed slowly, but it is smooth.

Both parts are fitted at the calibrated pretension. At every other pretension, only their changes are fitted, because
the changes are smoother.
"""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.film_charges import FilmChargeSeries
from isocharge.simulate import Domain
from isocharge.train.calibration.contact_error import spread_contacts
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.data.charge_field import fit_series

RADIUS_SHARE = 0.3
"""Share of the distance from the working area to the edge of the known charges that the series also covers.

The contact that is nearest to measured charges may lie slightly outside the working area.
"""


NODE_SHARES = (0.22, 0.5, 1.0)
"""Distances of the nodes from the calibrated pretension on each side, relative to the largest distance on this side.

The nodes are the pretensions at which series are fitted. They are close to each other near the calibrated pretension,
because small changes of the pretension are frequent.
"""


SMALLEST_RANGE_MPa = 0.05
"""Largest distance from the calibrated pretension to an end of the range for which no nodes lie on this side, MPa."""


class SeriesSize(NamedTuple):
    """Size of a series, and the number of contacts to which the series is fitted.

    Attributes:
        degree: Largest total degree in x and y.
        force_degree: Largest degree in the logarithm of the force.
        n_contact: Number of contacts, about one and a half times the number of coefficients or more.
    """

    degree: int
    force_degree: int
    n_contact: int


IDEAL_CHARGE = SeriesSize(degree=16, force_degree=5, n_contact=2400)
"""Series of the ideal charge at the calibrated pretension."""

IDEAL_CHANGE = SeriesSize(degree=12, force_degree=5, n_contact=1200)
"""Series of the change of the ideal charge with the pretension."""

FACTOR = SeriesSize(degree=10, force_degree=4, n_contact=800)
"""Series of the factor at the calibrated pretension."""

FACTOR_CHANGE = SeriesSize(degree=6, force_degree=3, n_contact=300)
"""Series of the change of the factor with the pretension."""


def film_charge_series(result: CalibrationResult, range_MPa: tuple[float, float]) -> FilmChargeSeries | None:
    """Fit Chebyshev series to the charges of a calibrated film at several pretensions.

    Args:
        result: Result of the calibration.
        range_MPa: Smallest and largest pretension, MPa. The calibrated pretension lies between them.

    Returns:
        The series, or None if some charge of the film is not positive and therefore has no logarithm.
    """
    domain = _series_domain(result.problem.domain, result.problem.charges.domain)
    calibrated_unknowns = result.posterior.unknowns
    pretension_index = result.problem.prior.index("pretension")
    calibrated_MPa = float(calibrated_unknowns[pretension_index])
    node_MPa = _nodes(calibrated_MPa, range_MPa)
    try:
        calibrated_series = _fit_log_charges(
            domain,
            ideal=_log_ideal_charges(result, calibrated_unknowns, _contacts(domain, IDEAL_CHARGE)),
            factor=_log_factors(result, calibrated_unknowns, _contacts(domain, FACTOR)),
            sizes=(IDEAL_CHARGE, FACTOR),
        )
        # At the other pretensions, changes from the calibrated film are fitted. They need the charges of the calibrated
        # film at the contacts of the smaller series.
        ideal_contact = _contacts(domain, IDEAL_CHANGE)
        factor_contact = _contacts(domain, FACTOR_CHANGE)
        calibrated_ideal = _log_ideal_charges(result, calibrated_unknowns, ideal_contact)
        calibrated_factor = _log_factors(result, calibrated_unknowns, factor_contact)

        all_series = []
        for pretension_MPa in node_MPa:
            if pretension_MPa == calibrated_MPa:  # exactly equal, because this node was set to the value
                all_series.append(calibrated_series)
                continue
            unknowns = calibrated_unknowns.copy()
            unknowns[pretension_index] = pretension_MPa
            change = _fit_log_charges(
                domain,
                ideal=_log_ideal_charges(result, unknowns, ideal_contact) - calibrated_ideal,
                factor=_log_factors(result, unknowns, factor_contact) - calibrated_factor,
                sizes=(IDEAL_CHANGE, FACTOR_CHANGE),
            )
            all_series.append(calibrated_series + change)
    except _ChargeNotPositiveError:
        return None
    return FilmChargeSeries(node_MPa, np.stack(all_series), domain.radius, domain.force_range)


class _ChargeNotPositiveError(ValueError):
    """Error for a film with a charge that is not positive, and therefore has no logarithm."""


def _series_domain(working_domain: Domain, known_domain: Domain) -> Domain:
    """Return the domain of the series, which is slightly larger than the working area of the sensor.

    Args:
        working_domain: Contacts in the working area.
        known_domain: Contacts for which the charges of films are known.
    """
    radius = working_domain.radius + RADIUS_SHARE * (known_domain.radius - working_domain.radius)
    return Domain(radius, known_domain.force_range)


def _nodes(calibrated_MPa: float, range_MPa: tuple[float, float]) -> Array:
    """Return the pretensions at which series are fitted (nodes), shape (n_node,), MPa, in ascending order.

    Args:
        calibrated_MPa: The calibrated pretension, MPa, which is one of the nodes.
        range_MPa: Smallest and largest pretension, MPa. If one of them is not farther than `SMALLEST_RANGE_MPa` from
            the calibrated pretension, no nodes lie on this side.
    """
    nodes = [calibrated_MPa]
    for limit_MPa in range_MPa:
        signed_distance_MPa = limit_MPa - calibrated_MPa  # negative towards the smallest pretension
        if abs(signed_distance_MPa) > SMALLEST_RANGE_MPa:
            nodes += [calibrated_MPa + share * signed_distance_MPa for share in NODE_SHARES]
    return np.sort(nodes)


def _contacts(domain: Domain, size: SeriesSize) -> Array:
    """Return the contacts (x, y, F) to which a series is fitted, shape (n_contact, 3), mm and N."""
    return spread_contacts(domain, size.n_contact)


def _log_ideal_charges(result: CalibrationResult, unknowns: Array, contact: Array) -> Array:
    """Return the logarithms of the charges of an ideal film, shape (n, n_electrode).

    Args:
        result: Result of the calibration.
        unknowns: Unknowns of the film, which differs from the calibrated film only in its pretension.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Raises:
        _ChargeNotPositiveError: If a charge is not positive.
    """
    charges = result.problem.charges
    charge = charges.forward_map(unknowns[charges.layout.parameters]).charges(contact)
    if charge.min() <= 0.0:
        raise _ChargeNotPositiveError
    return np.log(charge)


def _log_factors(result: CalibrationResult, unknowns: Array, contact: Array) -> Array:
    """Return the logarithms of the factors by which imperfections multiply the charges, shape (n, n_electrode).

    Args:
        result: Result of the calibration.
        unknowns: Unknowns of the film, which differs from the calibrated film only in its pretension.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
    """
    return np.log(result.charge_factor(unknowns, contact))


def _fit_log_charges(domain: Domain, ideal: Array, factor: Array, sizes: tuple[SeriesSize, SeriesSize]) -> Array:
    """Fit one series to the logarithms of ideal charges and one to the logarithms of factors, and add both series.

    The sum is a series of the logarithm of the product of charge and factor.

    Args:
        domain: Contacts for which the series are valid.
        ideal: Logarithms of the ideal charges, or their changes, shape (n_ideal, n_electrode).
        factor: Logarithms of the factors, or their changes, shape (n_factor, n_electrode).
        sizes: Sizes of the series of the ideal charges and of the factors.

    Returns:
        Coefficients of the sum, shape (degree + 1, degree + 1, force_degree + 1, n_electrode). The degrees are those of
        `IDEAL_CHARGE`, so all sums have the same shape.
    """
    largest = IDEAL_CHARGE  # no series has larger degrees
    total = np.zeros((largest.degree + 1, largest.degree + 1, largest.force_degree + 1, ideal.shape[1]))
    for values, size in zip((ideal, factor), sizes, strict=True):
        unit_contact = domain.to_unit(_contacts(domain, size))
        series = fit_series(unit_contact, values, size.degree, size.force_degree)
        # A series of lower degree contributes only to the first coefficients along each axis.
        total[: size.degree + 1, : size.degree + 1, : size.force_degree + 1] += series
    return total
