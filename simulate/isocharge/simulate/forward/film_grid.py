"""The grid on which the films of a family are solved: its axes, how far they reach, and where the nodes lie."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film_prior import FilmPrior

AXES = ("distance", "load", "tension", "thickness", "reach")
"""The numbers that a press of a film is described by, in the order of the grid's axes."""

COUNTS = (5, 12, 8, 2, 5)
"""Nodes along each axis."""

SOFTENING = 4e-4
"""Added to the tension before its logarithm is taken: about the strain that a press of 0.05 N induces, below which the
pretension makes no difference."""


FilmLimits = dict[str, tuple[float, float]]
"""Smallest and largest value along each of `AXES`, all dimensionless."""


@dataclass(frozen=True)
class FilmGrid:
    """Nodes of a family, one array for each of `AXES`, ascending.

    Attributes:
        distance: Of the press from the film's centre over the film's radius a.
        load: F / (E h a).
        tension: Pretension over E.
        thickness: h / a.
        reach: Radius of the probe over a.
    """

    distance: Array
    load: Array
    tension: Array
    thickness: Array
    reach: Array

    @classmethod
    def spread(cls, limits: FilmLimits, counts: tuple[int, ...] = COUNTS) -> "FilmGrid":
        """Chebyshev nodes between the limits: of load, reach and softened tension in the logarithm."""
        axes = {name: (_stretched(name, low), _stretched(name, high)) for name, (low, high) in limits.items()}
        nodes = [chebyshev_nodes(count, *axes[name]) for name, count in zip(AXES, counts, strict=True)]
        return cls(*(_unstretched(name, values) for name, values in zip(AXES, nodes, strict=True)))

    def weights(self, axis: str, at: float) -> Array:
        """Interpolation weights of an axis at one value, shape (n_node,)."""
        nodes = _stretched(axis, getattr(self, axis))
        weights: Array = lagrange_values(nodes, barycentric_weights(nodes), np.array([_stretched(axis, at)]))[0]
        return weights

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes along each axis."""
        return tuple(getattr(self, name).size for name in AXES)


def _stretched(axis: str, value: Array | float) -> Any:
    """The coordinate in which an axis is interpolated by polynomials."""
    if axis in ("load", "reach"):
        return np.log(value)
    return np.log(value + SOFTENING) if axis == "tension" else value


def _unstretched(axis: str, value: Array) -> Array:
    if axis in ("load", "reach"):
        return np.exp(value)
    return np.maximum(np.exp(value) - SOFTENING, 0.0) if axis == "tension" else value


def limits_of(prior: FilmPrior, radius: float, force_range: tuple[float, float]) -> FilmLimits:
    """All that presses within a radius (m) and forces (N) can be on the films that a calibration may find."""
    low, high = (dict(zip(prior.names, bound.tolist(), strict=True)) for bound in prior.bounds)
    film, a = prior.sensor.film, prior.sensor.film.radius
    stiffness = [film.young * film.thickness * a * np.exp(bound["young"] + bound["thickness"]) for bound in (low, high)]
    softest = film.young * np.exp(low["young"])
    return {
        "distance": (0.0, radius / a),
        "load": (force_range[0] / stiffness[1], force_range[1] / stiffness[0]),
        "tension": (low["pretension"] / softest, high["pretension"] / softest),
        "thickness": (film.thickness / a * np.exp(low["thickness"]), film.thickness / a * np.exp(high["thickness"])),
        "reach": ((prior.probe.radius + low["probe_radius"]) / a, (prior.probe.radius + high["probe_radius"]) / a),
    }
