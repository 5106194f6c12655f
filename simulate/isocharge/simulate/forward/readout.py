"""Charge collected by an electrode on a stretched piezoelectric film.

The electrodes are held at virtual ground by the charge amplifiers, so the field vanishes and an electrode of area A
collects only what the in-plane stress polarises (Mirbagheri et al. 2007, eq. 2),

    Q = A * mean(d31 * s11 + d32 * s22),

with s the mid-surface stress in the film's axes, 1 = drawn direction = x. The area readout takes the mean over the
electrode; the edge readout is the paper's eq. 3: s11 averaged over the left and right edges, s22 over the lower and
upper. Touch charge is the reading under load minus the reading without: a uniform pretension cancels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import SensorError
from isocharge.simulate.numerics.interpolation import gauss_line, gauss_square
from isocharge.simulate.numerics.polygon import gauss_polygon, gauss_quadrilateral
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import MAX_PART_SIDE, Electrode, Readout, Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, touch_stress

DIRECT, FINE, COARSE = 20, 12, 4
"""Gauss points per side of an electrode: of one press; of many, near the probe and away from it.

The stress has a kink on the footprint's edge; where that crosses an electrode 20 points leave 1e-5, 12 leave 8e-5.
"""

ALONG = 8
"""Gauss points along a line."""

NEAR = 1.0
"""Distance from the probe's edge to an electrode below which the fine rule is used, mm; beyond it the coarse one leaves
1e-4 of the charge at most, for squares of 1 to 6 mm."""


@dataclass(frozen=True)
class ReadoutPoints:
    """How charges follow from the stress at points of the film.

    Attributes:
        points: (x, y), shape (n_electrode, n_point, 2), mm.
        weights: Charge per stress (s11, s22, s12), shape (n_electrode, n_point, 3), pC/MPa.
        count: Points of each electrode, shape (n_electrode,); those beyond have no weight.
    """

    points: Array
    weights: Array
    count: Integers

    @classmethod
    def of(cls, sensor: Sensor, per_side: int) -> "ReadoutPoints":
        """Integration points for a sensor's electrodes and readout."""
        layout = _on_layout(sensor.electrodes, sensor.readout, per_side)
        per_stress = np.array([sensor.piezo.d31, sensor.piezo.d32, 2.0 * sensor.piezo.d12])
        weights = sensor.gains[:, None, None] * layout.weights * per_stress
        return cls(sensor.calibration.place(layout.points), weights, layout.count)

    @classmethod
    def along(cls, sensor: Sensor, lines: Array) -> "ReadoutPoints":
        """Points along straight lines of metal that belong to the electrodes, each read by itself.

        Args:
            sensor: Its coefficients and calibration are used.
            lines: Ends on the layout, shape (n_electrode, n_line, 2, 2), mm.

        Returns:
            For n_electrode * n_line lines, those of an electrode in turn; weights are per mm of width, pC/(MPa mm).
        """
        at, share = gauss_line(ALONG)
        start, step = lines[:, :, :1], lines[:, :, 1:] - lines[:, :, :1]
        points = start + at[:, None] * step
        weights = sensor.gains[:, None, None] * np.linalg.norm(step, axis=3) * share
        per_stress = np.array([sensor.piezo.d31, sensor.piezo.d32, 2.0 * sensor.piezo.d12])
        placed = sensor.calibration.place(points.reshape(-1, ALONG, 2))
        return cls(placed, weights.reshape(-1, ALONG, 1) * per_stress, np.full(len(placed), ALONG))

    def charge(self, stress: Array) -> Array:
        """Charges (..., n_electrode), pC, from stress at the points, shape (..., n_electrode, n_point, 3), MPa."""
        return np.asarray(np.einsum("...epc,epc->...e", stress, self.weights))


@lru_cache(maxsize=32)
def _on_layout(electrodes: tuple[Electrode, ...], readout: Readout, per_side: int) -> ReadoutPoints:
    """Points where the electrodes are drawn; weights are areas, mm^2. Films of one layout share them."""
    parts = [electrode_rule(electrode, readout, per_side) for electrode in electrodes]
    count = np.array([len(share) for _, share in parts])
    points, areas = np.zeros((2, len(parts), count.max(), 3))
    for number, (electrode, (at, share)) in enumerate(zip(electrodes, parts, strict=True)):
        points[number, : len(at), :2], areas[number, : len(at)] = at, electrode.area * share
    return ReadoutPoints(points[..., :2], areas, count)


def touch_charge(sensor: Sensor, equilibrium: Equilibrium) -> Array:
    """Touch charge of each electrode.

    Args:
        sensor: Its electrodes, coefficients and readout are used; its `coated_film` must be the one that was solved.
        equilibrium: The solved press.

    Returns:
        Shape (n_electrode,), pC, in the order of `sensor.electrode_names`; positive for tension along a direction with
        a positive coefficient.

    Raises:
        SensorError: If the film is another one, or the sensor reads a surface and bending was left out.
    """
    if sensor.coated_film != equilibrium.film:
        raise SensorError(
            f"the equilibrium belongs to another film: expected {sensor.coated_film}, got {equilibrium.film}"
        )
    if sensor.surface != "middle" and not equilibrium.theory.bending:
        raise SensorError(
            f"surface {sensor.surface!r} needs bending, but the film was solved as a {equilibrium.theory.name}; solve "
            "it with SolveSettings(theory=theory_for(sensor, probe, (force, force)))"
        )
    readout = ReadoutPoints.of(sensor, DIRECT)
    stress = touch_stress(equilibrium, readout.points.reshape(-1, 2), sensor.surface)
    charge = readout.charge(stress.reshape(*readout.points.shape[:2], 3))
    charge += contact_charge(sensor, equilibrium.probe, equilibrium.at, equilibrium.force)
    return sensor.calibration.read(charge)


def contact_charge(sensor: Sensor, probe: Probe, at: tuple[float, float], force: float) -> Array:
    """Charge of the contact pressure on the electrodes, d33 * mean(s33), shape (n_electrode,), pC.

    The film hangs free: through its thickness s33 goes from -pressure under the probe to 0 at the other face, so its
    mean is -pressure / 2, by symmetry also where the film is sheared; -pressure would need a rigid back. Only the part
    of an electrode under the footprint counts; a negative d33, as PVDF has, gives a positive charge.
    """
    if sensor.piezo.d33 == 0.0:
        return np.zeros(len(sensor.electrodes))
    covered = []
    for electrode, (centre, reach) in zip(sensor.electrodes, sensor.part_circles, strict=True):
        near = np.flatnonzero(np.abs(complex(*at) - centre) < reach + probe.reach)
        covered.append(
            sum(probe.covered_area(sensor.calibration.place(electrode.parts[i]), complex(*at)) for i in near)
        )
    return np.asarray(-0.5 * sensor.piezo.d33 * force / probe.area * sensor.gains * np.array(covered))


def thermal_charge(sensor: Sensor, step: float) -> Array:
    """Pyroelectric charge of a uniform temperature step, shape (n_electrode,), pC: the same on equal electrodes.

    `step` is in K, positive for warming, which takes charge from a PVDF film with d31 > 0. The clamp is taken to expand
    as the film does: what a rim holds back is stress, and belongs to the pretension.
    """
    areas = np.array([electrode.area for electrode in sensor.electrodes])
    return sensor.calibration.read(sensor.gains * areas * sensor.piezo.pyro * step)


def electrode_rule(electrode: Electrode, readout: Readout, per_side: int) -> tuple[Array, Array]:
    """Integration points, shape (n, 2), mm, and the share of each in the mean of (s11, s22, s12), shape (n, 3)."""
    return _edge_rule(electrode, per_side) if readout == "edge" else _area_rule(electrode, per_side)


def _area_rule(electrode: Electrode, per_side: int) -> tuple[Array, Array]:
    """Points (n, 2) and shares of the mean (n, 3) for a mean over the electrode."""
    if electrode.square:
        unit, share = gauss_square(per_side)
        low, high = np.array(electrode.corners[0]), np.array(electrode.corners[2])
        points = low + unit * (high - low)
    elif len(electrode.parts) == 1:
        points, share = gauss_polygon(electrode.parts[0], per_side)
    else:
        rules = [gauss_quadrilateral(part, per_side, MAX_PART_SIDE) for part in electrode.parts]
        points, weights = (np.concatenate(values) for values in zip(*rules, strict=True))
        share = weights / weights.sum()
    return points, np.repeat(share[:, None], 3, axis=1)


def _edge_rule(electrode: Electrode, per_side: int) -> tuple[Array, Array]:
    """Points and shares for s11 over the left and right edges and s22 over the lower and upper ones (eq. 3)."""
    at, share = gauss_line(2 * per_side)
    lower, right, upper, left = (
        np.array(start) + at[:, None] * (np.array(end) - np.array(start))
        for start, end in zip(electrode.corners, electrode.corners[1:] + electrode.corners[:1], strict=True)
    )
    half, zero = 0.5 * share, np.zeros_like(share)
    first, second = np.stack([half, zero, zero], axis=1), np.stack([zero, half, zero], axis=1)
    return np.concatenate([left, right, lower, upper]), np.concatenate([first, first, second, second])
