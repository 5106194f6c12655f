"""Computation of the mirror region of a sensor.

A press in the mirror region lies outside the working area and has the same charges as a press inside the working area.
Therefore no method can conclude from the charges that the press lies outside the working area. If all electrodes lie on
one circle of radius R, the mirror region covers almost the whole film. An inversion in this circle moves a point such
that the ratios between its distances from the points of the circle remain the same. Point loads at the distances r and
R^2 / r from the centre therefore have nearly the same influence on the points of the circle.
"""

import logging
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate.forward.charge_map import ChargeMap, within
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.simulate.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor

_log = logging.getLogger(__name__)

DETECTABLE_SIGMAS = 5.0
"""Smallest distance between charges at which a press outside the working area can be noticed.

The distance between the charges of this press and the nearest charges of a press in the working area is in standard
deviations of the noise. The value equals the smallest limit of the misfit in `isocharge.serve`.
"""

N_FORCES = 5
"""Number of forces of the presses at each position."""

FORCE_RATIO = 10.0
"""Upper bound of the ratio of the largest to the smallest force of the presses, dimensionless."""

N_RINGS = 32
"""Number of rings between the working area and the clamp."""

N_SECTORS = 48
"""Number of sectors of each ring."""

INTERIOR = 0.98
"""Distance from the centre up to which a contact counts as inside the working area, in radii of the working area.

If the search for the nearest contact stops at the edge of the area, the contact on the edge does not explain the
charges.
"""


@dataclass(frozen=True)
class MirrorRegion:
    """Share of the presses at each position outside the working area that have the charges of a press inside the area.

    Attributes:
        inner: Radius of the working area, mm.
        outer: Largest distance of the presses from the centre, mm.
        forces: Forces of the presses at each position, shape (n_force,), N.
        share: Share of the forces at which a press in a sector has the same charges as a press in the working area,
            shape (n_ring, n_sector), dimensionless. The rings between `inner` and `outer` have equal widths. The first
            sector begins at the x axis, and the others follow anticlockwise.
    """

    inner: float
    outer: float
    forces: Array
    share: Array

    @classmethod
    def of(cls, charges: ChargeMap, radius: float, whole_film: ChargeMap, noise: NoiseModel) -> "MirrorRegion":
        """Compute which presses outside the working area have the same charges as a press inside the working area.

        The part of the film outside the working area is divided into rings, and each ring is divided into sectors. In
        the middle of each sector, presses with several forces are tested. The share of a sector is the fraction of its
        presses that have, within the noise, the same charges as a press inside the working area.

        Args:
            charges: Accurate charge map of the working area.
            radius: Radius of the working area, mm. The accurate map is restricted to this radius.
            whole_film: Charge map of the whole film.
            noise: Noise of the readings.
        """
        min_force, max_force = whole_film.domain.force_range
        min_tested_force = max(min_force, max_force / FORCE_RATIO)
        forces = np.geomspace(min_tested_force, max_force, N_FORCES)
        outer_radius = whole_film.domain.radius
        sector_middles = Rings.between(radius, outer_radius, N_RINGS, N_SECTORS)
        presses = np.concatenate([sector_middles.contacts(force) for force in forces.tolist()])

        is_mirrored = has_mirror(within(charges, radius), whole_film.charges(presses), noise)
        share = is_mirrored.reshape(N_FORCES, N_RINGS, N_SECTORS).mean(axis=0)  # mean over the forces
        return cls(radius, outer_radius, forces, share)

    @property
    def edges(self) -> Array:
        """Distances from the centre of the film to the edges of the rings, shape (n_ring + 1,), mm."""
        return np.linspace(self.inner, self.outer, len(self.share) + 1)

    @property
    def total_share(self) -> float:
        """Share of the presses outside the working area that have the same charges as a press inside the working area.

        The weight of a press is the area of its sector.
        """
        # The area of a sector is proportional to the difference of the squared radii of its edges.
        return float(np.average(self.share.mean(axis=1), weights=np.diff(self.edges**2)))

    @property
    def summary(self) -> str:
        """Sentence that states which share of the presses outside the working area cannot be noticed."""
        presses = (
            f"presses of {self.forces[0]:.2g} to {self.forces[-1]:.2g} N from {self.inner:.3g} to {self.outer:.3g} mm "
            "from the centre"
        )
        if not self.share.any():
            return f"All {presses} have charges that differ from those of every press in the working area."
        return (
            f"Of {presses}, {100.0 * self.total_share:.2g} % have the charges of a press in the working area, and no "
            "method can notice them."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the mirror region as a dictionary for JSON."""
        return {
            "share": self.total_share,
            "from_mm": self.inner,
            "to_mm": self.outer,
            "force_N": self.forces[[0, -1]].tolist(),
            "words": self.summary,
        }


def has_mirror(inside: ChargeMap, charge: Array, noise: NoiseModel) -> Booleans:
    """Return for each press outside a domain whether a press inside the domain has the same charges within the noise.

    Such a press inside the domain is called the mirror of the press outside.

    Args:
        inside: Charge map of the domain.
        charge: Charges of the presses outside the domain, without noise, shape (n, n_electrode), pC.
        noise: Noise of the readings.

    Returns:
        Whether each row contains the charges of a press inside the domain, shape (n,).
    """
    contact, residual = search(inside, charge, noise.sigma(charge))
    is_same_charge = np.linalg.norm(residual, axis=1) < DETECTABLE_SIGMAS

    # If a search stopped at the edge of the domain, the contact on the edge does not explain the charges. The unit
    # coordinates are 1 at the edge, and `INTERIOR` is slightly less than 1.
    unit_x, unit_y, unit_log_force = inside.domain.to_unit(contact).T
    is_interior = (np.hypot(unit_x, unit_y) < INTERIOR) & (np.abs(unit_log_force) < INTERIOR)
    return np.asarray(is_same_charge & is_interior)


def mirror_region(
    sensor: Sensor,
    probe: Probe,
    charges: ChargeMap,
    radius: float,
    noise: NoiseModel,
    *,
    executor: Executor | None = None,
) -> MirrorRegion | None:
    """Compute the mirror region of a sensor by means of a coarse charge map of the whole film.

    The mirror region contains the presses outside the working area that have the same charges as a press inside the
    working area. The charge map of the whole film is solved for a round probe. A probe of another shape is replaced by
    the smallest circle around its centroid that contains the probe.

    Args:
        sensor: Sensor with the film and the electrodes.
        probe: Probe that presses the film.
        charges: Accurate charge map of the working area.
        radius: Radius of the working area, mm.
        noise: Noise of the readings.
        executor: Executor that runs the solves; None to run the solves in this process.

    Returns:
        The mirror region; None if there is no working area, if the working area reaches the clamp, or if the film
        cannot be solved up to the clamp. The last case is logged as a warning.
    """
    round_probe = probe if probe.is_axisymmetric else Circle(probe.reach)  # the reach is the radius of this circle
    # The contact area of some probes grows with the force, so the largest force needs the most space.
    if not 0.0 < radius < outermost_distance(sensor.film, round_probe.under(charges.domain.force_range[1])):
        return None
    try:
        whole_film = whole_film_map(sensor, round_probe, charges.domain.force_range, executor=executor)
    except (SceneError, SolveError) as error:
        _log.warning("the mirror region outside %.3g mm is not computed: %s", radius, error)
        return None
    return MirrorRegion.of(charges, radius, whole_film, noise)
