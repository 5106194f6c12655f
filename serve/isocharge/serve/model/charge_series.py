"""Compact charge map of a film, stored in the file `charges.npz` of a model.

A charge map gives the charges of the electrodes for any contact. This map computes a value v_e for each electrode e.
The value is a Chebyshev series in the contact:

    v_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree,

where T_i are Chebyshev polynomials, r is the radius of the domain, and l is the logarithm of the force, scaled to
[-1, 1]. If all charges are positive, the charge is Q = exp(v). If some charges are not positive, the charge is Q = S(l)
v, where S is the typical size of the charges. The logarithm of S is a polynomial in l.

Without pretension, the charge is nearly F^(2/3) g(x, y), where F is the force and g is a smooth function of the
position. The value v is therefore smooth, and the series needs only a few terms. For a contact outside the domain, v
and ln S are extrapolated linearly in x, y and l from the nearest contact in the domain. If all charges are positive, Q
is then a power of F for forces outside the domain, because ln Q is linear in ln F.

A calibrated film may change. The map then also depends on the state of the film, a vector (t, z_1, ..., z_K):

- t is the change of the mean pretension since the calibration, MPa. The coefficients c are given for several values of
  t, which are called nodes. Between the nodes, the coefficients are interpolated by a polynomial (Lagrange). If the
  pretension of a film cannot be tracked, its map has only the node 0.
- z_k is the change of the film along direction k, in standard deviations. A direction is a linear combination of
  properties of the film that remained uncertain after the calibration. A change adds z_k (d_ke + t d'_ke) to v_e, where
  d_ke(x, y, F) and d'_ke(x, y, F) are further Chebyshev series. The series d' is needed because some combinations of
  properties hardly change the charges at the pretension of the calibration, but change the charges at another
  pretension.
"""

from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from isocharge.common.arrays import Array, Integers
from isocharge.common.contact_domain import Domain, into_unit_domain
from isocharge.serve.model.robust_estimate import ModelValues

CHUNK_SIZE = 4096
"""Number of points at which a series is evaluated at once. This number limits the required memory."""


@dataclass(frozen=True)
class Series:
    """Sum of products of Chebyshev polynomials in three coordinates: x, y and the logarithm of the force.

    Each coordinate is scaled to the range from -1 to 1. Each electrode has its own coefficients. Products whose total
    degree in x and y exceeds `degree` are omitted.

    Attributes:
        coefficients: Coefficients of the products, shape (degree + 1, degree + 1, force_degree + 1, n_electrode). The
            indices of the first three axes are the degrees of the polynomials in x, in y and in the logarithm of the
            force.
    """

    coefficients: Array

    def values_and_derivatives(self, coordinates: Array, excess: Array) -> Array:
        """Evaluate the series and its derivatives with respect to the coordinates, and extrapolate the values linearly.

        The points are processed in chunks of at most `CHUNK_SIZE` points. In each chunk, the method first sums over the
        n_term products of a polynomial in x and a polynomial in y, and then over the n_force polynomials in the
        logarithm of the force.

        Args:
            coordinates: Scaled coordinates (x, y, logarithm of the force) of n points, shape (n, 3). Coordinates
                outside the range from -1 to 1 are clipped.
            excess: Steps from these points to the given points, which may lie outside the range, shape (n, 3). The
                value at a given point is extrapolated along the tangent at the clipped point.

        Returns:
            Values and derivatives, shape (n, 4, n_electrode). The second axis contains the value at the given point,
            and the derivatives at the clipped point with respect to x, y and the logarithm of the force.
        """
        n_x, _n_y, n_force, n_electrode = self.coefficients.shape  # numbers of polynomials, and of electrodes
        n_chunk = len(coordinates) // CHUNK_SIZE + 1  # at least one chunk, even if there are no points
        evaluated_chunks = []
        for chunk in np.array_split(coordinates, n_chunk):
            # Shapes (points, n_term) and (points, n_force)
            position_terms, force_terms = chebyshev_terms(chunk, degree=n_x - 1, force_degree=n_force - 1)

            # Sum over the products of polynomials in x and y: (points, n_term) @ (n_term, n_force * 4 * n_electrode).
            # The factor 4 stands for the value and its three derivatives. For each point, the sums are the coefficients
            # of series in the logarithm of the force.
            position_sums = position_terms @ self._term_coefficients
            force_coefficients = position_sums.reshape(len(chunk), n_force, 4 * n_electrode)

            # Sum over the polynomials in the logarithm of the force:
            # (points, 1, n_force) @ (points, n_force, 4 * n_electrode).
            chunk_values = force_terms[:, None, :] @ force_coefficients
            evaluated_chunks.append(chunk_values[:, 0, :])
        values = np.concatenate(evaluated_chunks).reshape(len(coordinates), 4, n_electrode)
        if excess.any():  # add the sum of excess times derivative over the three coordinates (index s)
            values[:, 0] += np.einsum("ns,nse->ne", excess, values[:, 1:])
        return values

    @cached_property
    def _term_coefficients(self) -> Array:
        """Coefficients of the series and of its derivatives with respect to x, y and the logarithm of the force.

        The shape is (n_term, (force_degree + 1) * 4 * n_electrode). Each row belongs to one product of a polynomial in
        x and a polynomial in y, in the order of `position_degrees`. In a row, the degree in the logarithm of the force
        changes slowest. Then follow the four series (the value and its derivatives) and, as the fastest, the electrode.
        """
        derivatives = [_derivative(self.coefficients, axis) for axis in range(3)]
        series_and_derivatives = np.stack([self.coefficients, *derivatives])
        degree = self.coefficients.shape[0] - 1
        x_degree, y_degree = position_degrees(degree)  # degrees in x and y of each product, shape (n_term,)

        # Select the coefficients of each product. The shape is (4, n_term, force_degree + 1, n_electrode).
        coefficients = series_and_derivatives[:, x_degree, y_degree]
        coefficients_by_term = coefficients.transpose(1, 2, 0, 3)  # shape (n_term, force_degree + 1, 4, n_electrode)
        return coefficients_by_term.reshape(len(x_degree), -1)


@cache
def position_degrees(degree: int) -> tuple[Integers, Integers]:
    """Return the degrees in x and in y of all products of polynomials whose total degree is at most `degree`.

    Args:
        degree: Largest sum of the degrees in x and in y.

    Returns:
        The degree in x and the degree in y of each product, each of shape (n_term,).
    """
    degrees = np.arange(degree + 1)
    total_degree = np.add.outer(degrees, degrees)
    x_degree, y_degree = np.nonzero(total_degree <= degree)
    return x_degree, y_degree


def chebyshev_terms(coordinates: Array, degree: int, force_degree: int) -> tuple[Array, Array]:
    """Evaluate the Chebyshev polynomials that occur in a series.

    Args:
        coordinates: Scaled coordinates of n points, shape (n, 3). Coordinates outside [-1, 1] are clipped.
        degree: Largest total degree in x and y.
        force_degree: Largest degree in the logarithm of the force.

    Returns:
        Products of the polynomials in x and y, in the order of `position_degrees`, shape (n, n_term). Polynomials in
        the logarithm of the force, shape (n, force_degree + 1).
    """
    polynomials = chebyshev.chebvander(np.clip(coordinates, -1.0, 1.0).T, max(degree, force_degree))
    x_polynomials, y_polynomials, force_polynomials = polynomials  # each of shape (n, largest degree + 1)

    x_degree, y_degree = position_degrees(degree)  # degrees in x and in y of each product, shape (n_term,)
    position_terms = x_polynomials[:, x_degree] * y_polynomials[:, y_degree]
    return position_terms, force_polynomials[:, : force_degree + 1]


def _derivative(coefficients: Array, axis: int) -> Array:
    """Return the coefficients of the derivative of a Chebyshev series with respect to one coordinate.

    Args:
        coefficients: Coefficients of the series; see `Series`.
        axis: Axis of `coefficients` that belongs to the coordinate.

    Returns:
        Coefficients of the derivative, of the same shape.
    """
    # With one more coefficient, which is zero, the derivative has as many coefficients as the series.
    padding = [(0, 0)] * coefficients.ndim
    padding[axis] = (0, 1)
    return np.asarray(chebyshev.chebder(np.pad(coefficients, padding), axis=axis))


NO_DIRECTIONS = np.zeros((1, 1, 1, 2, 0, 1))
"""Coefficients of the directions of a map without directions: the axis of the K directions has the length 0."""

MAX_VALUE = 100.0
"""Largest magnitude of v and of ln S in the domain. The logarithms of charges in pC are between -5 and 12."""


@dataclass(frozen=True, kw_only=True)
class ChargeSeries:
    """Compact charge map: charges of a film as a function of the contact and of the state of the film.

    The class implements the interface `ChargeMap` of `isocharge.simulate`.

    Attributes:
        domain: Contacts for which the map is valid.
        electrodes: Names of the electrodes, in the order of the charges.
        coefficients: Coefficients of v at each node, shape (n_node, degree + 1, degree + 1, force_degree + 1,
            n_electrode).
        node_MPa: Changes t of the mean pretension at the nodes, shape (n_node,), MPa, ascending and containing 0.
        directions: Coefficients of d and d' for each direction. d is the change of v for one unit of the direction, and
            d' is the derivative of d with respect to t, 1/MPa. The shape is (degree + 1, degree + 1, force_degree + 1,
            2, K, n_electrode). By default, the map has no directions.
        log_size: Chebyshev coefficients of ln S as a function of l; None if all charges are positive.
        is_folded: Whether different contacts of the domain have the same charges. A service then tracks contacts with a
            `ContactMixture`.
        charge_std: Standard deviation of the part of the charges that the map does not describe, relative to the
            charges.
        offset_pC: Charges that are added to the computed charges, shape (n_electrode,) or one number for all
            electrodes, pC. A calibration found these additional charges in all presses.
        pretension_MPa: Mean pretension of the film as it was calibrated, MPa.
        tension_std_MPa: Standard deviation of t when a stream begins, MPa.
    """

    domain: Domain
    electrodes: tuple[str, ...]
    coefficients: Array
    node_MPa: Array = field(default_factory=lambda: np.zeros(1))
    directions: Array = field(default_factory=lambda: NO_DIRECTIONS)
    log_size: Array | None = None
    is_folded: bool = False
    charge_std: float = 0.0
    offset_pC: Array | float = 0.0
    pretension_MPa: float = 0.0
    tension_std_MPa: float = 0.0

    @property
    def direction_count(self) -> int:
        """Number K of directions."""
        return int(self.directions.shape[4])

    def charges(self, contact: Array) -> Array:
        """Compute the charges of contacts on the calibrated film.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.
        """
        charge_pC, _ = self.linearised(contact)
        return charge_pC

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the charges of contacts on the calibrated film, and the derivatives of the charges.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC. Derivatives with respect to (x, y, ln F), shape (n, n_electrode, 3),
            pC/mm, pC/mm and pC.
        """
        nearest, excess = self._nearest_in_domain(contact)
        values = self._calibrated.values_and_derivatives(nearest, excess)
        charge_pC, _, by_contact = self._charges_from_values(values, nearest, excess)
        return charge_pC + self.offset_pC, by_contact

    def in_state(self, contact: Array, state: Array) -> ModelValues:
        """Compute the charges of contacts for any state of the film, and the derivatives of the charges.

        For each electrode, the map contains a value v: the logarithm of the charge or, if some charges are not
        positive, the charge divided by its typical size. t is the change of the mean pretension since the calibration.
        v is interpolated between its values at some values of t, which are called nodes. The film may also change along
        K directions. A change z_k along direction k adds z_k (d_k + t d'_k) to v. The map contains d_k and d'_k as
        further series. The charges follow from v.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            state: State (t, z_1, ..., z_K) of the film, shape (1 + K,), or one state for each contact, shape
                (n, 1 + K). The unit of t is MPa. z_k is in standard deviations.

        Returns:
            Charges, and their derivatives with respect to (x, y, ln F) and with respect to the state.
        """
        n_contact = len(contact)
        n_electrode = len(self.electrodes)
        nearest, excess = self._nearest_in_domain(contact)  # contacts outside the domain are extrapolated by the excess
        states = np.broadcast_to(state, (n_contact, 1 + self.direction_count))
        pretension = states[:, 0]  # t of each contact, shape (n,)
        shifts = states[:, 1:]  # z_1 to z_K of each contact, shape (n, K)

        # Evaluate v at the nodes, and d and d' of each direction. The axis of length 4 contains the value and its
        # derivatives with respect to the three coordinates of the contact.
        node_values = self._node_series.values_and_derivatives(nearest, excess).reshape(n_contact, 4, -1, n_electrode)
        direction_values = self._direction_series.values_and_derivatives(nearest, excess)
        direction_values = direction_values.reshape(n_contact, 4, 2, self.direction_count, n_electrode)
        change = direction_values[:, :, 0]  # d, shape (n, 4, K, n_electrode)
        change_per_MPa = direction_values[:, :, 1]  # d', of the same shape
        total_change = change + pretension[:, None, None, None] * change_per_MPa  # d + t d'

        # Interpolate between the nodes (index m), and add the changes by the directions (index k). The other indices
        # are the contact (n), the value or one of its derivatives (s) and the electrode (e).
        weights, weight_slopes = interpolation_weights(self.node_MPa, pretension)  # each of shape (n, n_node)
        value = np.einsum("nm,nsme->nse", weights, node_values) + np.einsum("nk,nske->nse", shifts, total_change)

        # Derivatives of v with respect to t, and to z of each direction
        value_per_MPa = np.einsum("nm,nme->ne", weight_slopes, node_values[:, 0])
        value_per_MPa += np.einsum("nk,nke->ne", shifts, change_per_MPa[:, 0])
        value_per_direction = total_change[:, 0].swapaxes(0, 1)  # shape (K, n, n_electrode)
        value_per_state = np.stack([value_per_MPa, *value_per_direction], axis=2)

        # Convert v to charges, and apply the chain rule to the derivatives with respect to the state. `by_contact` are
        # the derivatives of the charges with respect to (x, y, ln F).
        charge_pC, charge_per_value, by_contact = self._charges_from_values(value, nearest, excess)
        by_state = charge_per_value[:, :, None] * value_per_state  # shape (n, n_electrode, 1 + K)
        return ModelValues(charge_pC + self.offset_pC, by_contact, by_state)

    @cached_property
    def _calibrated(self) -> Series:
        """Series of v for the film as it was calibrated."""
        return Series(self.coefficients[self.node_MPa.searchsorted(0.0)])

    @cached_property
    def _node_series(self) -> Series:
        """Series of v at every node. Nodes and electrodes share the last axis."""
        term_coefficients = np.moveaxis(self.coefficients, 0, 3)
        return Series(term_coefficients.reshape(*term_coefficients.shape[:3], -1))

    @cached_property
    def _direction_series(self) -> Series:
        """Series of d and d'. The last axis contains all pairs of a direction and an electrode."""
        return Series(self.directions.reshape(*self.directions.shape[:3], -1))

    def _nearest_in_domain(self, contact: Array) -> tuple[Array, Array]:
        """Return the nearest contacts in the domain, and the steps from them to the contacts, in unit coordinates.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Unit coordinates of the nearest contacts, shape (n, 3), and the steps, shape (n, 3), dimensionless. For a
            contact in the domain, the step is zero.
        """
        unit_contact = self.domain.to_unit(contact)
        nearest = into_unit_domain(unit_contact)
        return nearest, unit_contact - nearest

    def _charges_from_values(self, value: Array, nearest: Array, excess: Array) -> tuple[Array, Array, Array]:
        """Convert values v of the series into charges Q without the offset.

        If all charges are positive, v is ln Q. If some charges are not positive, v is Q / S(l). Here, S is the typical
        size of the charges, and l is the logarithm of the force in unit coordinates. The unit coordinates (x, y, l) are
        scaled to [-1, 1] in the domain of the map.

        Args:
            value: v and its derivatives with respect to the unit coordinates, shape (n, 4, n_electrode).
            nearest: Unit coordinates (x, y, l) of the contacts in the domain that are nearest to the given contacts,
                shape (n, 3).
            excess: Unit coordinates of the given contacts minus `nearest`, shape (n, 3). ln S is extrapolated linearly.

        Returns:
            Charges without the offset, and their derivatives with respect to v, both of shape (n, n_electrode), pC.
            Derivatives of the charges with respect to (x, y, ln F), where F is the force, shape (n, n_electrode, 3),
            pC/mm, pC/mm and pC.
        """
        slopes = value[:, 1:].swapaxes(1, 2)  # shape (n, n_electrode, 3)
        if self.log_size is None:  # all charges are positive; Q = exp(v), so the derivative with respect to v is Q, too
            charge_pC = _limited_exp(value[:, 0])
            charge_per_value = charge_pC
            by_unit_contact = charge_pC[:, :, None] * slopes
        else:  # Q = S(l) v; `log_size` contains the coefficients of ln S
            size_pC, log_size_slope = series_size(self.log_size, nearest[:, 2], excess[:, 2])  # S and (ln S)'
            charge_pC = size_pC * value[:, 0]
            charge_per_value = np.broadcast_to(size_pC, charge_pC.shape)
            by_unit_contact = size_pC[:, :, None] * slopes
            # S depends on l. By the product rule, dQ/dl = S v' + S' v = S v' + (ln S)' Q.
            by_unit_contact[:, :, 2] += log_size_slope * charge_pC
        # `scale` contains the sizes of the units of x (mm), y (mm) and ln F.
        return charge_pC, charge_per_value, by_unit_contact / self.domain.scale


def series_size(log_size: Array, unit_log_force: Array, excess: Array | float = 0.0) -> tuple[Array, Array]:
    """Compute the typical size S of charges, and the derivative of ln S with respect to l.

    Args:
        log_size: Chebyshev coefficients of ln S as a function of l.
        unit_log_force: Logarithms l of the forces, scaled to [-1, 1], shape (n,).
        excess: Amount by which l lies outside the range from -1 to 1, shape (n,) or a number. Outside this range, ln S
            is continued linearly.

    Returns:
        The size S, pC, and the derivative of ln S, dimensionless, each of shape (n, 1).
    """
    slope = chebyshev.chebval(unit_log_force, chebyshev.chebder(log_size))
    log_sizes = chebyshev.chebval(unit_log_force, log_size) + excess * slope
    return _limited_exp(log_sizes)[:, None], np.asarray(slope, dtype=float)[:, None]


def _limited_exp(logarithm: Array) -> Array:
    """Compute the exponential of each logarithm. The magnitude of the logarithm is first limited to `MAX_VALUE`."""
    return np.exp(np.clip(logarithm, -MAX_VALUE, MAX_VALUE))


def interpolation_weights(nodes: Array, points: Array) -> tuple[Array, Array]:
    """Compute the weights of a polynomial interpolation between nodes (Lagrange), and their derivatives.

    Args:
        nodes: Nodes, shape (n_node,), ascending.
        points: Points at which values are interpolated, shape (n,), in the range of the nodes.

    Returns:
        Weights of the values at the nodes, and the derivatives of the weights with respect to the points, each of shape
        (n, n_node).
    """
    # The nodes are divided by the largest of them. The matrix of their powers is then well conditioned.
    scale = max(np.abs(nodes).max(), 1e-12)
    # Each column contains the coefficients of the polynomial that is 1 at one node, and 0 at the others.
    node_polynomials = np.linalg.inv(polynomial.polyvander(nodes / scale, nodes.size - 1))
    weights = polynomial.polyval(points / scale, node_polynomials)
    slopes = polynomial.polyval(points / scale, polynomial.polyder(node_polynomials)) / scale
    return weights.T, slopes.T
