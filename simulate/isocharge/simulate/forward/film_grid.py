"""The grid on which the films of a family are solved: its axes, its solves, and the modes that their stresses have."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.press import press
from isocharge.simulate.solver.settings import SolveSettings

AXES = ("distance", "load", "tension", "thickness", "reach")
"""The numbers that a press of a film is described by, in the order of the grid's axes."""

COUNTS = (5, 12, 8, 2, 5)
"""Nodes along each axis."""

SOFTENING = 4e-4
"""Added to the tension before its logarithm is taken: about the strain that a press of 0.05 N induces, below which the
pretension makes no difference."""

MODES_LEFT = 8e-5
"""Share of the stresses that the modes may leave out: root mean square, each node's stress relative to its own size."""

THEORY = Theory(stretching=True, bending=True, pretensioned=True)
"""All terms: a family holds slack films and taut ones."""

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


def limits_of(prior: FilmPrior, domain: Domain) -> FilmLimits:
    """All that the presses of a domain can be on the films that a calibration may find."""
    low, high = (dict(zip(prior.names, bound.tolist(), strict=True)) for bound in prior.bounds)
    film, a = prior.sensor.film, prior.sensor.film.radius
    stiffness = [film.young * film.thickness * a * np.exp(bound["young"] + bound["thickness"]) for bound in (low, high)]
    softest = film.young * np.exp(low["young"])
    return {
        "distance": (0.0, domain.radius / a),
        "load": (domain.force_range[0] / stiffness[1], domain.force_range[1] / stiffness[0]),
        "tension": (low["pretension"] / softest, high["pretension"] / softest),
        "thickness": (film.thickness / a * np.exp(low["thickness"]), film.thickness / a * np.exp(high["thickness"])),
        "reach": ((prior.probe.radius + low["probe_radius"]) / a, (prior.probe.radius + high["probe_radius"]) / a),
    }


def solve_films(
    film: Film, surface: Surface, grid: FilmGrid, settings: SolveSettings, executor: Executor | None
) -> Array:
    """Scaled stress at the nodes of the template, shape (*grid.shape, n_element * n_local * 3)."""
    chains = [
        _Chain(film, surface, (distance, tension, thickness, reach), grid.load, settings)
        for distance in grid.distance
        for tension in grid.tension
        for thickness in grid.thickness
        for reach in grid.reach
    ]
    rows = np.stack(list(track(in_order(executor, _solve_chain, chains), "solving the films", len(chains))))
    by_axis = rows.reshape(*(grid.shape[axis] for axis in (0, 2, 3, 4, 1)), -1)
    return np.moveaxis(by_axis, 4, 1)


@dataclass(frozen=True)
class _Chain:
    """Presses of all loads on one film at one distance, by one probe.

    Attributes:
        film: The described film; its radius, modulus and Poisson's ratio are taken.
        surface: Where in the thickness the stress is read.
        groups: Distance, tension, thickness and reach as on the grid.
        load: F / (E h a), shape (n_load,), ascending.
        settings: Theory and mesh.
    """

    film: Film
    surface: Surface
    groups: tuple[float, float, float, float]
    load: Array
    settings: SolveSettings


def _solve_chain(chain: _Chain) -> Array:
    """Scaled stress at the nodes for each load, shape (n_load, ...); each is solved from the next larger one."""
    distance, tension, thickness, reach = chain.groups
    a, young = chain.film.radius, chain.film.young
    film = replace(chain.film, pretension=tension * young, thickness=thickness * a)
    start: Equilibrium | None = None
    rows = []
    for load in chain.load[::-1]:
        force = float(load) * young * film.thickness * a
        start = press(film, Circle(reach * a), (distance * a, 0.0), force, chain.settings, start=start)
        rows.append(nodal_stress(start, chain.surface).ravel())
    return np.stack(rows[::-1])


def decompose(stress: Array) -> tuple[Array, Array]:
    """Coefficients and modes of scaled stresses of shape (..., n): the fewest that leave out `MODES_LEFT`.

    Every node counts relative to its own stress: the peak under the probe would else hide the electrodes.
    """
    flat = stress.reshape(-1, stress.shape[-1])
    size = np.repeat(np.sqrt((flat.reshape(len(flat), -1, 3) ** 2).sum(axis=2).mean(axis=0)), 3)
    relative = flat / size
    values, vectors = np.linalg.eigh(relative.T @ relative)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    left = np.sqrt(np.maximum(1.0 - np.cumsum(values) / values.sum(), 0.0))
    count = int(np.argmax(left <= MODES_LEFT)) + 1
    modes = vectors[:, :count].T
    return (relative @ modes.T).reshape(*stress.shape[:-1], count), modes * size
