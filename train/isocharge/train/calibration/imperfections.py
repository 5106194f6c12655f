"""Effects of traces and of an uneven tension on the charges of a film.

A trace that is missing in the sensor file collects charge outside the pad of its electrode. Such a trace is modelled by
several lines of unknown width, which lead from the edge of the pad to the rim of the film. In second order, an uneven
tension has the effect of a smaller uniform tension.
"""

from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import ForwardMap, Sensor
from isocharge.simulate.forward.film_modes import ModeMap
from isocharge.simulate.forward.forward_map import EVEN_FIELD
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.numerics.polygon import area_of
from isocharge.train.calibration.discrepancy import TRACE_ANGLES

TRACE_STD_MM = 0.5
"""Prior standard deviation of the width of a trace that is missing in the sensor file, mm."""

TRACE_END = 0.93
"""Distance from the centre at which the modelled traces end, relative to the radius of the film.

The last millimetres before the rim contribute little charge.
"""

LARGEST_SQUARED_RATIO = 0.9
"""Upper limit of the squared ratio of the uneven part of the tension to the mean tension."""

SLACKENING = 1.75
"""Exponent in `unevenness_derivative`, which was fitted to full simulations."""

MIN_TENSION = 1e-3
"""Lower limit of the mean tension by which the uneven part of the tension is divided, MPa."""


class ModeCharges(NamedTuple):
    """Effects of the modes of a film on the charges of presses.

    Attributes:
        modes: The modes of the film; None if no modes were computed for the family of films.
        sensor: The sensor to which the charges belong.
        contact: Contacts (x, y, F) of the presses, shape (n, 3), mm and N.
        mode_jacobian: Derivatives of the charges with respect to the coefficients of the modes, shape (n, n_electrode,
            n_mode), pC.
        unevenness_derivative: Derivative of ln Q, where Q is the charge, with respect to the unevenness of the tension,
            shape (n, n_electrode); see `tension_unevenness`.
    """

    modes: ModeMap | None
    sensor: Sensor
    contact: Array
    mode_jacobian: Array
    unevenness_derivative: Array


def trace_lines(sensor: Sensor) -> Array:
    """Return the two ends of each straight line along which a trace may lie.

    Each line begins at the edge of the pad of an electrode. The pad is treated as a circle of the same area. The line
    ends near the rim, on a circle whose radius is `TRACE_END` times the radius of the film. Each pad has one line for
    each angle in `TRACE_ANGLES`. A line with the angle 0 leads straight away from the centre of the film.

    Args:
        sensor: Sensor with the film and the pads of the electrodes.

    Returns:
        Points (x, y), shape (n_electrode, n_line, 2, 2), mm. The third axis is the start and the end of the line.
    """
    end_radius = TRACE_END * sensor.film.radius
    # Points and directions in the plane are complex numbers x + i y, with one row for each electrode and one column for
    # each line. The arrays `centre` and `pad_radius` have a single column.
    centre = np.array([complex(*electrode.centre) for electrode in sensor.electrodes])[:, None]
    areas = [area_of(np.array(electrode.corners)) for electrode in sensor.electrodes]
    pad_radius = np.sqrt(np.array(areas) / np.pi)[:, None]
    direction = np.exp(1j * (np.angle(centre) + np.deg2rad(TRACE_ANGLES)))

    # The distance s from the centre c of the pad to the circle with `end_radius` along the direction d of the line is
    # the positive solution of |c + s d| = end_radius. The projection is the scalar product of c and d.
    projection = (centre.conj() * direction).real
    distance_to_end = np.sqrt(projection**2 + end_radius**2 - np.abs(centre) ** 2) - projection
    # Start and end of each line, shape (n_electrode, n_line, 2)
    ends = centre[:, :, None] + np.stack([pad_radius * direction, distance_to_end * direction], axis=2)
    return np.stack([ends.real, ends.imag], axis=3)


def trace_charges(forward_map: ForwardMap, lines: Array, contact: Array) -> Array:
    """Compute the charge that each line would collect as a metal trace of the width `TRACE_STD_MM`.

    Args:
        forward_map: Forward map of the film.
        lines: Both ends of each line, as `trace_lines` returns them.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Charges, shape (n, n_electrode, n_electrode * n_line), pC. The second axis is the electrode that receives the
        charge, and the last axis is the line. A line adds charge only to its own electrode.
    """
    n_contact = len(contact)
    n_electrode = len(lines)

    # Charge of each line per millimetre of its width
    points = ReadoutPoints.along(forward_map.sensor, lines)
    charge_per_mm = forward_map.field_charges(contact, EVEN_FIELD, points)

    line_charge = TRACE_STD_MM * charge_per_mm.reshape(n_contact, n_electrode, -1)

    # The axes are the contact, the electrode that receives the charge, the electrode of the line, and the line. The
    # charge is zero unless both electrodes are the same.
    n_line = line_charge.shape[2]
    charge_by_line = np.zeros((n_contact, n_electrode, n_electrode, n_line))
    for electrode in range(n_electrode):
        charge_by_line[:, electrode, electrode] = line_charge[:, electrode]

    # Join the last two axes, because the returned last axis counts the lines of all electrodes.
    return charge_by_line.reshape(n_contact, n_electrode, -1)


def trace_widths(coefficients: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the total width of each electrode's traces, and the standard deviation of this width.

    Args:
        coefficients: Coefficients of the lines, shape (n_electrode * n_line,). A coefficient is the width of a line
            divided by `TRACE_STD_MM`.
        covariance: Covariance of the coefficients, shape (n_electrode * n_line, n_electrode * n_line).

    Returns:
        Widths and standard deviations, each of shape (n_electrode,), mm.
    """
    n_electrode = coefficients.size // len(TRACE_ANGLES)
    # This matrix converts coefficients to widths and adds the widths of all lines of an electrode, shape (n_electrode,
    # n_electrode * n_line).
    width_matrix = TRACE_STD_MM * np.eye(n_electrode).repeat(len(TRACE_ANGLES), axis=1)
    width_covariance = width_matrix @ covariance @ width_matrix.T
    return width_matrix @ coefficients, np.sqrt(np.diag(width_covariance))


def tension_unevenness(pretension: float, tension_stds: Array, coefficients: Array) -> tuple[float, Array]:
    """Compute the unevenness of the tension, 1 - sqrt(1 - (e / T)^2), and its derivatives.

    Here T is the mean tension, and e is the uneven part of the tension. A membrane with the tensions T + e and T - e
    along two perpendicular axes deflects like a membrane with the uniform tension sqrt(T^2 - e^2). The squared ratio
    (e / T)^2 is limited to `LARGEST_SQUARED_RATIO`, and T is at least `MIN_TENSION`.

    Args:
        pretension: Mean tension T, MPa.
        tension_stds: Standard deviation of the uneven tension of each mode, shape (n_mode,), MPa; zero for a mode that
            is no uneven tension.
        coefficients: Coefficients of the modes, in standard deviations, shape (n_mode,).

    Returns:
        Unevenness, dimensionless, and its derivatives with respect to the coefficients, shape (n_mode,). The derivative
        with respect to a coefficient c with the standard deviation s is (s / T)^2 c / sqrt(1 - (e / T)^2). It is zero
        if the squared ratio is at its limit.
    """
    relative_stds = tension_stds / max(pretension, MIN_TENSION)
    squared_ratio = float(((relative_stds * coefficients) ** 2).sum())  # (e / T)^2, the sum over all modes
    root = np.sqrt(1.0 - min(squared_ratio, LARGEST_SQUARED_RATIO))
    unevenness = 1.0 - root
    if squared_ratio >= LARGEST_SQUARED_RATIO:  # beyond the limit, the unevenness is constant
        return unevenness, np.zeros_like(coefficients)
    return unevenness, relative_stds**2 * coefficients / root


def unevenness_derivative(log_tension_derivative: Array) -> Array:
    """Compute the derivative of ln Q, where Q is the charge, with respect to the unevenness of the tension.

    The derivative is s (1 - (1 - s / 2)^SLACKENING). Here s = -d ln Q / d ln T is the sensitivity of the charge to the
    mean tension T. The sensitivity is small if the film is stretched mainly by the press itself.

    Args:
        log_tension_derivative: Derivatives d ln Q / d ln T, shape (n, n_electrode), dimensionless.

    Returns:
        Derivatives of ln Q with respect to the unevenness, shape (n, n_electrode), dimensionless.
    """
    sensitivity = -log_tension_derivative
    base = np.clip(1.0 - 0.5 * sensitivity, 0.0, 1.0)  # the power is defined only for a base that is not negative
    return np.asarray(sensitivity * (1.0 - base**SLACKENING))
