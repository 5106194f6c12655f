"""From random layouts to local optima: many short descents on the tables."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from isocharge.common.arrays import Array
from isocharge.simulate.layout.objective import Objective
from isocharge.simulate.layout.placing import MILLIMETRE

TRIES = 16
"""Random layouts of which the best is the start of a descent."""

POWERS = {"worst": (4.0, 12.0, 40.0), "rms": (2.0,)}
"""Powers of the error that are made small one after the other, by goal: near the worst only a large one looks, but from
far away it sees too little."""

STEPS = 60
"""Largest number of steps for each power."""

FARTHEST = 15e-3
"""Random places reach this far beyond the presses, m: charges of electrodes farther out change little."""


@dataclass(frozen=True)
class Descents:
    """Some descents, all that a worker must know.

    Attributes:
        objective: Its power is replaced by those of the goal.
        goal: "worst" or "rms".
        seed: Seed of the random layouts.
        count: Number of descents.
    """

    objective: Objective
    goal: str
    seed: tuple[int, ...]
    count: int


def descend(job: Descents) -> Array:
    """Local optima, shape (count, 1 + n_free): the objective's value, then the free numbers, m."""
    rng = np.random.default_rng(job.seed)
    return np.stack([_descent(job, rng) for _ in range(job.count)])


def _descent(job: Descents, rng: np.random.Generator) -> Array:
    first, *_ = powers = POWERS[job.goal]
    rough = replace(job.objective, power=first)
    layouts = [random_layout(job.objective, rng) for _ in range(TRIES)]
    free = min(layouts, key=rough.value)
    for power in powers:
        free = _minimise(replace(job.objective, power=power), free)
    return np.concatenate([[replace(job.objective, power=powers[-1]).value(free)], free])


def random_layout(objective: Objective, rng: np.random.Generator) -> Array:
    """Free numbers of a layout whose places are spread evenly over the disk that electrodes may lie in."""
    parameters, scene = objective.parameters, objective.conditions[0].table
    presses = float(np.hypot(*scene.presses.T).max())
    reach = min(presses + FARTHEST, objective.rules.film_radius - objective.rules.rim - parameters.side[1])
    places = parameters.places.shape[1]
    radius, angle = reach * np.sqrt(rng.random(places)), 2.0 * np.pi * rng.random(places)
    xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).ravel()[:places]
    sides = rng.uniform(*parameters.side, parameters.free - places)
    return np.concatenate([xy, sides])


def _minimise(objective: Objective, start: Array) -> Array:
    """A descent in millimetres: steps and derivatives are then of order one."""

    def function(free_mm: Array) -> tuple[float, Array]:
        value, slope = objective.gradient(free_mm * MILLIMETRE)
        return value, slope * MILLIMETRE

    limit = 1e3 * objective.rules.film_radius
    parameters = objective.parameters
    places = parameters.places.shape[1]
    low, high = (1e3 * side for side in parameters.side)
    bounds = [(-limit, limit)] * places + [(low, high)] * (parameters.free - places)
    result = minimize(
        function, start / MILLIMETRE, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": STEPS}
    )
    free: Array = result.x * MILLIMETRE
    return free
