"""Compact charge map (`ChargeSeries`) of a calibrated film, from which similar films can be drawn at random.

The posterior distribution of a calibration has many unknowns, but only a few linear combinations of the unknowns change
the charges. These combinations are called directions. The compact charge map contains the changes of the charges along
each direction. The training uses the directions to draw films. The live follower uses the directions to find out how
the real film differs from the estimated film.

The nodes of the map are films with other pretensions. Their charges are computed from those of the calibrated film:
each charge changes in the same proportion as on a nearly axisymmetric film with the same change of the pretension. The
changes along the directions depend on the pretension, so they are also computed at the nodes.

Worker processes compute the charges of the films. This module does not import torch, so that the workers start quickly.
"""

import logging
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from operator import call

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.charge_series import ChargeSeries, Series, series_size
from isocharge.serve.presses.measured_presses import CONTACT
from isocharge.simulate import Domain
from isocharge.simulate.execution import in_order
from isocharge.simulate.sensor.film_properties import PRETENSION, UNEVEN_TENSIONS
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate, discrepancy_jacobian
from isocharge.train.data.charge_fit import fit_film_series, fit_series
from isocharge.train.data.presses import LOWEST_CHARGE, draw_contacts

log = logging.getLogger(__name__)

SERIES_CONTACTS = 6800
"""Number of contacts to which the series of the charges are fitted."""

CHANGE_CONTACTS = 2000
"""Number of contacts to which the changes of the charges with the pretension are fitted."""

CHANGE_DEGREES = (10, 5)
"""Degrees in the position and in the force of the series that describe how the charges change with the pretension."""

DIRECTION_CONTACTS = 1200
"""Number of contacts to which the series for the effects of the directions are fitted."""

DIRECTION_DEGREES = (8, 3)
"""Degrees in the position and in the force of the series that describe the effects of the directions."""

MIN_DIRECTION = 0.1
"""Smallest root-mean-square effect on a charge, in standard deviations of the noise, for which a direction is kept."""

MAX_SERIES_ERROR = 0.03
"""Largest relative error of the charges over all nodes. If the error is larger, the outermost node is left out."""

NODES_MPa = (-0.7, -0.3, 0.0, 0.4, 0.9)
"""Changes of the pretension at the nodes, MPa, for a film whose changes can be followed.

Changes that would make the film slack are replaced by the largest decrease that keeps the film taut."""

SEED = 3
"""Seed of the contacts and of the drawn films."""


def compact_charges(
    domain: Domain, charges: FilmCharges, film: FilmEstimate, executor: Executor | None
) -> ChargeSeries:
    """Compute the compact charge map of an estimated film.

    The map has two parts, which are series that are fitted to values at random contacts:

    - The charges at the nodes. The nodes are films that differ from the calibrated film only in the pretension.
    - The effects of the directions, which are the linear combinations of the unknowns of the film that change the
      charges.

    Only the charges of the calibrated film are computed for all contacts. The charges at the nodes and the effects of
    the directions take longer to compute, and are computed for the first of the contacts. These contacts also cover the
    domain, because the order of the contacts is random.

    Args:
        domain: Contacts for which the map is needed.
        charges: Charges of the solved film and of similar films.
        film: The estimate, with the noise of the charges, which decides how many directions are needed.
        executor: Executor that solves the films at the nodes; None for this process.
    """
    # Solve the films at the nodes. With three electrodes, some contact explains every change of the three charges, so
    # that no change of the pretension can be found. The calibrated film is then the only node.
    electrodes = charges.prior.sensor.electrode_names
    # The calibrated film is its own changed film, with the change 0 and the derivatives 1.
    calibrated = _ChangedFilm(0.0, charges, film.film_values, np.eye(film.film_values.size))
    node_films = [calibrated]
    if len(electrodes) > len(CONTACT):  # more charges than coordinates of a contact
        node_films = [calibrated.changed(change_MPa, executor) for change_MPa in _nodes(film)]
    node_MPa = np.array([node_film.change_MPa for node_film in node_films])

    # Compute the charges of all contacts on the calibrated film, and those of the first contacts at all nodes. A job is
    # a function without arguments, which the executor calls.
    contact = draw_contacts(np.random.default_rng(SEED), domain, SERIES_CONTACTS)
    node_contacts = contact[:CHANGE_CONTACTS]
    node_jobs = [partial(node_film.charge, node_contacts) for node_film in node_films]
    film_charge, *charges_at_nodes = in_order(executor, call, [partial(calibrated.charge, contact), *node_jobs])
    # The discrepancy is the smooth difference between the real charges and those of the film with its properties.
    discrepancy = discrepancy_jacobian(film_charge, contact, charges.domain) @ film.values[film.layout.coefficients]
    charge = film_charge + discrepancy  # most probable charges without offset, shape (n, n_electrode)

    # Fit series to the charges at the nodes. This may leave out nodes.
    node_charge = _node_charges(domain.to_unit(contact), charge, np.stack(charges_at_nodes, axis=1), node_MPa)
    series = _fit_accurate_nodes(domain, electrodes, contact, node_charge, node_MPa)

    # Fit series to the effects of the directions, at the remaining nodes.
    remaining_films = [node_film for node_film in node_films if node_film.change_MPa in series.node_MPa]
    direction_contacts = contact[:DIRECTION_CONTACTS]
    direction_charges = charge[:DIRECTION_CONTACTS]  # of these contacts
    return replace(
        series,
        directions=_directions(
            series, film, calibrated, remaining_films, direction_contacts, direction_charges, executor
        ),
        offset_pC=film.values[film.layout.offset],
        pretension_MPa=film.value(PRETENSION.name),
        tension_std_MPa=PRETENSION.drift,  # standard deviation of its change since the calibration
    )


@dataclass(frozen=True)
class _ChangedFilm:
    """The calibrated film, or the same film after a change of the tension that is equal in all directions.

    Attributes:
        change_MPa: Change of the pretension, MPa.
        charges: Charges of a solved film and of similar films. For the calibrated film, the solved film is that of the
            calibration. For a changed film, the solved film is axisymmetric.
        values: Properties of the changed film, shape (n_property,).
        value_jacobian: Derivatives of `values` with respect to the properties of the calibrated film, shape
            (n_property, n_property).
    """

    change_MPa: float
    charges: FilmCharges
    values: Array
    value_jacobian: Array

    def changed(self, change_MPa: float, executor: Executor | None) -> "_ChangedFilm":
        """Return this calibrated film with another pretension, for which an axisymmetric film is solved.

        If the change is zero, nothing is solved: the calibration has already solved an axisymmetric film whose
        properties hardly differ from those of this film.

        Args:
            change_MPa: Change of the pretension, MPa.
            executor: Executor that runs the solves; None for this process.
        """
        prior = self.charges.prior
        tension_index = prior.index(PRETENSION.name)
        uneven_indices = [prior.index(name) for name in UNEVEN_TENSIONS]

        # The change D increases the mean tension from T to T + D. It does not change the uneven parts of the tension in
        # MPa. The values contain the uneven parts as shares of the mean tension, so a share s becomes s T / (T + D).
        values = self.values.copy()
        values[tension_index] += change_MPa
        changed_tension_MPa = max(float(values[tension_index]), 1e-9)  # T + D; positive, to avoid a division by zero
        share_ratio = self.values[tension_index] / changed_tension_MPa  # T / (T + D)
        values[uneven_indices] *= share_ratio

        # Each row contains the derivatives of one value. A changed share s T / (T + D) has the derivatives T / (T + D)
        # with respect to s, and s D / (T + D)^2 with respect to T. The other values have the derivative 1 with respect
        # to themselves.
        value_jacobian = np.eye(values.size)
        value_jacobian[uneven_indices, uneven_indices] = share_ratio
        value_jacobian[uneven_indices, tension_index] = (
            self.values[uneven_indices] * change_MPa / changed_tension_MPa**2
        )

        # Without a change, use the axisymmetric film that the calibration has solved.
        even_charges = self.charges.even
        if change_MPa != 0.0:
            even_charges = FilmCharges.of_even_film(prior, values, self.charges.domain, executor)
        return _ChangedFilm(change_MPa, even_charges, values, value_jacobian)

    def charge(self, contact: Array) -> Array:
        """Compute the charges of contacts on this film, shape (n, n_electrode), pC."""
        return self.charges.charges(self.values, contact)

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the charges of this film, and their derivatives with respect to the unknowns of the calibrated film.

        The unknowns are the properties of the film, the offsets of the electrodes and the coefficients of the
        discrepancy.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC, and derivatives, shape (n, n_electrode, n_unknown), pC per unit of the
            unknown.
        """
        # The first derivatives are with respect to the properties of this film, and not of the calibrated film.
        charge, _, by_own_property = self.charges.linearised(self.values, contact)
        by_property = by_own_property @ self.value_jacobian  # chain rule
        by_offset = np.tile(np.eye(charge.shape[1]), (len(charge), 1, 1))
        by_coefficient = discrepancy_jacobian(charge, contact, self.charges.domain)
        return charge, np.concatenate([by_property, by_offset, by_coefficient], axis=2)


def _fit_accurate_nodes(
    domain: Domain, electrodes: tuple[str, ...], contact: Array, charge: Array, node_MPa: Array
) -> ChargeSeries:
    """Fit a series to the charges at the nodes, and leave out the nodes at which the charges are not accurate.

    The nodes are the pretensions for which charges were computed. The nodes with the largest change of the pretension
    are left out, one after the other, until the series fits accurately or one node remains.

    The charges contain the imperfections of the film only to first order. At a node whose pretension differs much from
    that of the calibrated film, the imperfections may nearly cancel a charge, so that its relative error is large. A
    smooth series does not fit such charges. A warning is logged each time when nodes are left out.

    Args:
        domain: Contacts for which the series is needed.
        electrodes: Names of the electrodes.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Charges of the contacts at the nodes, shape (n, n_node, n_electrode), pC.
        node_MPa: Changes of the pretension at the nodes, shape (n_node,), MPa, ascending and containing 0.
    """
    series = fit_film_series(domain, electrodes, contact, charge, node_MPa)
    if series.charge_std <= MAX_SERIES_ERROR or node_MPa.size == 1:  # `charge_std` is the relative error of the series
        return series
    is_kept = np.abs(node_MPa) < np.abs(node_MPa).max()
    remaining_MPa = node_MPa[is_kept]
    log.warning(
        "the charges of this film are not known after large changes of its pretension; changes from %+.2g to "
        "%+.2g MPa can be followed",
        remaining_MPa[0],
        remaining_MPa[-1],
    )
    return _fit_accurate_nodes(domain, electrodes, contact, charge[:, is_kept], remaining_MPa)


def _nodes(film: FilmEstimate) -> Array:
    """Return changes of the pretension at the nodes that do not make the film slack, shape (n_node,), MPa."""
    sensor, _ = film.layout.prior.film(film.film_values)
    smallest_tension_MPa = sensor.film.pretension - np.hypot(*sensor.film.deviator)  # over all directions
    lowest_MPa = min(0.0, -0.95 * smallest_tension_MPa)
    # Nodes below the lowest change become one node. An interpolation between several nodes close to each other would
    # amplify the errors of their charges.
    return np.unique(np.maximum(NODES_MPa, lowest_MPa))


def _node_charges(unit_contact: Array, charge: Array, even_charge: Array, node_MPa: Array) -> Array:
    """Compute the charges of the calibrated film at the nodes from those of axisymmetric films.

    The nodes are a few pretensions, between which the charges are later interpolated. One of them is the pretension of
    the calibration.

    The charges of an axisymmetric film change by a certain ratio if its pretension changes from the value of the
    calibration to the value of a node. The charges of the calibrated film change by about the same ratio, although this
    film is not axisymmetric. The ratio is a smooth function of the contact. The axisymmetric films are only solved for
    the first of the contacts. A series that is fitted to their ratios gives the ratios of the other contacts.

    If all charges have the same sign, the change is relative to the charge itself. Otherwise, some charges are nearly
    zero, and the change is relative to the root of the sum of the squared charges of all electrodes.

    Args:
        unit_contact: Contacts in unit coordinates, shape (n, 3).
        charge: Charges of the contacts on the calibrated film, shape (n, n_electrode), pC.
        even_charge: Charges of the first `n_first` contacts on the axisymmetric films at the nodes, shape (n_first,
            n_node, n_electrode), pC.
        node_MPa: Changes of the pretension, one of which is zero, shape (n_node,), MPa.

    Returns:
        Charges, shape (n, n_node, n_electrode), pC.
    """
    has_one_sign = np.ptp(np.sign(even_charge)) == 0.0

    def change_scale(film_charge: Array) -> Array:
        """Return the charges relative to which changes are stated, for charges of shape (n, 1, n_electrode), pC."""
        return film_charge if has_one_sign else np.linalg.norm(film_charge, axis=2, keepdims=True)

    # Compute the relative changes of the charges of the first contacts, shape (n_first, n_node, n_electrode).
    even_charge_before = even_charge[:, node_MPa == 0.0]  # shape (n_first, 1, n_electrode)
    first_changes = (even_charge - even_charge_before) / change_scale(even_charge_before)

    # Fit a series with one value for each node and electrode. Evaluate it for the other contacts, and keep the values
    # without the derivatives (index 0). No contact lies outside the range of the series, so the excess is zero.
    n_first, n_node, n_electrode = even_charge.shape
    first_contact, other_contact = np.split(unit_contact, [n_first])
    series = Series(fit_series(first_contact, first_changes.reshape(n_first, -1), *CHANGE_DEGREES))
    other_changes = series.values_and_derivatives(other_contact, excess=np.zeros_like(other_contact))[:, 0]
    all_changes = np.concatenate([first_changes, other_changes.reshape(-1, n_node, n_electrode)])
    charge_before = charge[:, None]  # shape (n, 1, n_electrode)
    return charge_before + all_changes * change_scale(charge_before)


def _directions(
    series: ChargeSeries,
    film: FilmEstimate,
    calibrated: _ChangedFilm,
    films: list[_ChangedFilm],
    contact: Array,
    charge: Array,
    executor: Executor | None,
) -> Array:
    """Find the directions that make the charges of the film uncertain, and fit series to the effects of the directions.

    A direction is a linear combination of the unknowns of the film. The directions are chosen so that their effects on
    the charges are uncorrelated, and directions with effects below `MIN_DIRECTION` are left out. The effects are
    considered at the pretension of the calibration and at the two nodes beside it, because a direction may change the
    charges only at another pretension.

    A charge map contains values v instead of charges Q. If all charges are positive, v is ln Q. Otherwise, v is Q / S,
    where S is the typical size of the charges at the same force. An effect is a change of v.

    Args:
        series: Map of the charges without directions.
        film: The estimate of the calibrated film.
        calibrated: The calibrated film.
        films: The films at the nodes of the series, in ascending order of the changes of the pretension.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Most probable charges of the contacts, shape (n, n_electrode), pC.
        executor: Executor that computes the charges of the films; None for this process.

    Returns:
        Coefficients of the series, in the form of `ChargeSeries.directions`.
    """
    unit_contact = series.domain.to_unit(contact)
    size = None  # the typical size S of the charges, shape (n, 1), pC; None if the values are ln Q
    charge_per_value = charge  # dQ / dv = Q for the values ln Q
    if series.log_size is not None:
        size, _ = series_size(series.log_size, unit_contact[:, 2])
        charge_per_value = size  # dQ / dv = S for the values Q / S

    # Find the films at the nodes below and above the calibrated film. At an end of the nodes, there is no neighbour,
    # and the node of the calibrated film takes its place.
    middle = [node_film.change_MPa for node_film in films].index(0.0)
    lower = films[max(middle - 1, 0)]
    upper = films[min(middle + 1, len(films) - 1)]

    # Compute the changes of the values on the calibrated film, and the derivatives of these changes with respect to the
    # pretension, which are difference quotients.
    examined_films = [calibrated] if lower is upper else [calibrated, lower, upper]
    changes, *neighbour_changes = _value_changes(examined_films, film, contact, size, executor)
    slopes = np.zeros_like(changes)  # 1/MPa
    if neighbour_changes:
        lower_changes, upper_changes = neighbour_changes
        slopes = (upper_changes - lower_changes) / (upper.change_MPa - lower.change_MPa)

    # Compute the effects of the unknowns on the charges of the three films, in standard deviations of the noise.
    noise_stds_per_value = (charge_per_value / film.noise.sigma(charge))[:, :, None]
    effects_at_films = [
        noise_stds_per_value * (changes + one.change_MPa * slopes) for one in (lower, calibrated, upper)
    ]

    # Find the directions with uncorrelated effects by a singular value decomposition. There is one row for each film,
    # contact and electrode. A singular value is the root-mean-square effect of a direction, times the root of the
    # number of rows.
    *_, n_unknown = changes.shape
    all_effects = np.stack(effects_at_films).reshape(-1, n_unknown)
    _, singular_values, all_directions = np.linalg.svd(all_effects, full_matrices=False)
    smallest_singular_value = MIN_DIRECTION * np.sqrt(len(all_effects))
    directions = all_directions[singular_values > smallest_singular_value]  # shape (n_direction, n_unknown)

    # Fit a series to the change and to the slope of each direction, which are side by side: shape (n, 2, n_direction,
    # n_electrode). In the coefficients, three axes for the degrees take the place of the axis of the contacts.
    effects = np.stack([changes @ directions.T, slopes @ directions.T], axis=1).swapaxes(2, 3)
    coefficients = fit_series(unit_contact, effects.reshape(len(contact), -1), *DIRECTION_DEGREES)
    *degree_axes, _ = coefficients.shape
    return coefficients.reshape(*degree_axes, *effects.shape[1:])


def _value_changes(
    films: list[_ChangedFilm], film: FilmEstimate, contact: Array, size: Array | None, executor: Executor | None
) -> list[Array]:
    """Compute how the uncertainty of the unknowns changes the values v of a charge map.

    A charge map contains the values v = ln Q of the charges Q, or v = Q / S if a size S of the charges is given.

    The unknowns are correlated. They are replaced by the same number of linear combinations that are uncorrelated and
    have the standard deviation 1. The function returns the changes of v that one standard deviation of each combination
    causes.

    Args:
        films: Films for which the changes are computed.
        film: The estimate of the calibrated film, with the covariance of the unknowns.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        size: Typical size S of the charges if the values are Q / S, shape (n, 1), pC; None if the values are ln Q.
        executor: Executor that computes the charges of the films; None for this process.

    Returns:
        One array of changes of v for each film, shape (n, n_electrode, n_unknown).
    """
    # The columns of the root contain the changes of the unknowns by one standard deviation of each combination. The
    # unknowns are those of `_ChangedFilm.linearised`, whose indices in the estimate are those of three slices.
    unknowns = np.r_[film.layout.film, film.layout.offset, film.layout.coefficients]
    eigenvalues, vectors = np.linalg.eigh(film.covariance[np.ix_(unknowns, unknowns)])
    covariance_root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))

    changes = []
    jobs = [partial(changed_film.linearised, contact) for changed_film in films]  # functions without arguments
    for film_charge, jacobian in in_order(executor, call, jobs):
        # dQ / dv is Q for v = ln Q, and S for v = Q / S. The limit avoids a division by zero.
        charge_per_value = np.maximum(film_charge, LOWEST_CHARGE) if size is None else size
        changes.append((jacobian / charge_per_value[:, :, None]) @ covariance_root)
    return changes
