"""The known contact nearest to any charges: what the misfit measures, searched for on the fitted forward map.

    min over contacts c of the domain of |(Q - Q(c)) / sigma|,   sigma of the measured charges Q.

Levenberg-Marquardt for many charges at once. The domain, a disk times a range of forces, is held by an active set:
where a contact lies on the edge and its slope leads out, it moves along the edge only, and on the circle the edge's own
curvature joins the second derivatives; then the nearest point of a disk is found in a few steps as well.
"""

import numpy as np
from scipy.stats import qmc

from isocharge.arrays import Array, Integers
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.charge_field import ChargeField

STEPS = 30
"""Steps at most; most charges need five."""

SETTLED = 1e-4
"""Decrease of the squared distance, relative to 1 + itself, below which a contact stays where it is."""

EASIER, HARDER = 0.2, 8.0
"""Factors of the damping after a step that helped and one that did not."""

FIRST, LEAST, MOST = 1e-4, 1e-9, 1e4
"""Damping at the start and its bounds, relative to the mean diagonal; above the last, no step helps any more."""

WALL = 1e6
"""Stiffness against leaving the edge, relative to the trace."""

CANDIDATES = 4096
"""Contacts among which starts are chosen: spread over the domain, and a quarter as many along its rim."""

CHUNK = 2048
"""Charges compared with all candidates at once."""


def nearest_contact(
    field: ChargeField, charge_pC: Array, noise: NoiseModel, start: Array, shift: Array | None = None
) -> tuple[Array, Array]:
    """The best contact that descent from a start finds.

    Args:
        field: The forward map.
        charge_pC: Charges, shape (n, n_electrode), pC.
        noise: For the unit of distance.
        start: Contacts in unit coordinates, shape (n, 3).
        shift: Added to ln Q of the field, shape (n, n_electrode): what a press's own charges are away from it.

    Returns:
        Unit coordinates (n, 3) and (Q - Q(c)) / sigma, (n, n_electrode).
    """
    sigma = 1e12 * noise.sigma(1e-12 * charge_pC)
    shift = np.zeros_like(charge_pC) if shift is None else shift
    unit = into_domain(start)
    miss, slope = _miss(field, charge_pC, sigma, shift, unit)
    square, damping = (miss**2).sum(axis=1), np.full(len(unit), FIRST)
    going = np.arange(len(unit))
    for _ in range(STEPS):
        if not going.size:
            break
        tried = into_domain(unit[going] + _step(unit[going], miss[going], slope[going], damping[going]))
        new_miss, new_slope = _miss(field, charge_pC[going], sigma[going], shift[going], tried)
        new_square = (new_miss**2).sum(axis=1)
        helped = new_square < square[going]
        settled = helped & (square[going] - new_square < SETTLED**2 * (1.0 + new_square))
        at = going[helped]
        unit[at], miss[at], slope[at] = tried[helped], new_miss[helped], new_slope[helped]
        square[at] = new_square[helped]
        damping[going] = np.where(helped, np.maximum(damping[going] * EASIER, LEAST), damping[going] * HARDER)
        going = going[~settled & (damping[going] < MOST)]
    return unit, miss


def search(field: ChargeField, charge_pC: Array, noise: NoiseModel, starts: int = 2) -> tuple[Array, Array]:
    """The nearest contact from the best few of many starts; arguments and result as `nearest_contact`."""
    known = _candidates()
    charges = np.exp(field.log_charge(known)[:, 0])
    order = np.concatenate([_best(some, charges, noise, starts) for some in _chunks(charge_pC)])
    found = [nearest_contact(field, charge_pC, noise, known[rows]) for rows in order.T]
    squares = np.stack([(miss**2).sum(axis=1) for _, miss in found])
    best = squares.argmin(axis=0), np.arange(len(charge_pC))
    return np.stack([unit for unit, _ in found])[best], np.stack([miss for _, miss in found])[best]


def into_domain(unit: Array) -> Array:
    """The nearest point of the domain, unit disk times [-1, 1]; shape (n, 3)."""
    beyond = np.maximum(np.hypot(unit[:, 0], unit[:, 1]), 1.0)[:, None]
    return np.hstack([unit[:, :2] / beyond, np.clip(unit[:, 2:], -1.0, 1.0)])


def _chunks(charge_pC: Array) -> list[Array]:
    return np.array_split(charge_pC, len(charge_pC) // CHUNK + 1)


def _candidates() -> Array:
    sobol = qmc.Sobol(3, scramble=False).random(CANDIDATES)
    radius, angle = np.sqrt(sobol[:, 0]), 2.0 * np.pi * sobol[:, 1]
    radius[::4] = 1.0
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 2.0 * sobol[:, 2] - 1.0], axis=1)


def _best(charge_pC: Array, known_pC: Array, noise: NoiseModel, count: int) -> Integers:
    """Numbers of the nearest candidates, shape (n, count): |Q - K|^2 multiplied out, one matrix product each."""
    weight = (1e12 * noise.sigma(1e-12 * charge_pC)) ** -2
    square = weight @ (known_pC**2).T - 2.0 * (charge_pC * weight) @ known_pC.T
    best: Integers = np.argpartition(square, count - 1, axis=1)[:, :count]
    return best


def _miss(field: ChargeField, charge_pC: Array, sigma: Array, shift: Array, unit: Array) -> tuple[Array, Array]:
    """(Q - Q(c)) / sigma, (n, n_electrode), and its derivatives by unit coordinates, (n, 3, n_electrode)."""
    logs = field.log_charge(unit)
    relative = np.exp(logs[:, 0] + shift) / sigma
    return charge_pC / sigma - relative, -relative[:, None, :] * logs[:, 1:]


def _step(unit: Array, miss: Array, slope: Array, damping: Array) -> Array:
    """A damped Gauss-Newton step that stays on the edges it is held by, shape (n, 3)."""
    gradient = np.einsum("nke,ne->nk", slope, miss)
    normal = slope @ slope.transpose(0, 2, 1)
    trace = np.trace(normal, axis1=1, axis2=2) + 1e-12
    outward, around = np.zeros_like(unit), np.zeros_like(unit)
    reach = np.hypot(unit[:, 0], unit[:, 1])
    outward[:, :2] = unit[:, :2] / np.maximum(reach, 1e-9)[:, None]
    around[:, 0], around[:, 1] = -outward[:, 1], outward[:, 0]
    force = np.zeros_like(unit)
    force[:, 2] = np.sign(unit[:, 2])
    push, press = -(gradient * outward).sum(axis=1), -(gradient * force).sum(axis=1)
    at_rim = np.where((reach > 1.0 - 1e-9) & (push > 0.0), 1.0, 0.0)
    at_end = np.where((np.abs(unit[:, 2]) > 1.0 - 1e-9) & (press > 0.0), 1.0, 0.0)
    normal = normal + _outer(around, at_rim * push)
    normal = normal + _outer(outward, at_rim * WALL * trace) + _outer(force, at_end * WALL * trace)
    gradient = gradient + (at_rim * push)[:, None] * outward + (at_end * press)[:, None] * force
    normal = normal + (damping * trace / 3.0)[:, None, None] * np.eye(3)
    step: Array = -np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
    return step


def _outer(vector: Array, weight: Array) -> Array:
    return weight[:, None, None] * vector[:, :, None] * vector[:, None, :]
