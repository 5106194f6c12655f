"""Training charges of the misfit network: charges of good presses, of faulty presses, and of no press at all.

The misfit network has to answer any charges, so it is trained on all kinds of charges: presses with noise; charges at
any distance from the charges that contacts can have; wrong gains; failing electrodes; forces far outside of the range;
two presses at the same time; and charges from a box that contains all of these. The charges of two presses are added.
This is an approximation, because the film is not linear. With few electrodes, the space of all charges is small enough
to be covered.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate import ChargeMap, NoiseModel, noise_model
from isocharge.simulate.identifiability.nearest_contact import CANDIDATES, explain, search
from isocharge.train.data.channel_noise import ChannelNoise, Noise
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses

KINDS = {"noisy": 0.35, "moved": 0.25, "gains": 0.12, "dying": 0.05, "scaled": 0.06, "two": 0.1, "any": 0.07}
"""Share of each kind of charges in the training examples, dimensionless."""

FARTHEST = 2.5
"""Decimal logarithm of the largest shift of charges of any sign, in standard deviations of the noise."""

LARGEST_FACTOR = 2.0
"""Largest factor by which the charge map is scaled at a press. A quotient of charges near zero is meaningless."""

FAR = 6.0
"""Misfit above which the contact of a press may not be the nearest one, so that the nearest one is searched."""


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """Return the noise that is the unit of the misfit: the noise of the training, or `reference` if that is zero."""
    return noise if noise.white > 0.0 else noise_model("reference")


def draw_misfit_examples(
    presses: LabelledPresses,
    charge_map: ChargeMap,
    noise: Noise,
    count: int,
    seed: int,
    *,
    candidates: int = CANDIDATES,
    limits: tuple[Array | float, Array | float] = (LOWEST_CHARGE, HIGHEST_CHARGE),
) -> Array:
    """Draw charges of every kind, and compute their distance from the charges of the nearest contact.

    Args:
        presses: Presses from whose charges the examples are made.
        charge_map: Map from contacts to charges.
        noise: Noise of good presses, which is also the unit of the distance; a `ChannelNoise` for charges of any sign.
        count: Number of examples.
        seed: Seed of the random numbers.
        candidates: Number of contacts from which a search starts.
        limits: Smallest and largest charge, pC. Charges are clipped to these limits, as in the network.

    Returns:
        The charges Q, pC, and their residuals (Q - Q(c)) / sigma at the nearest contact c, shape (2, count,
        n_electrode).
    """
    rng = np.random.default_rng(seed)
    chosen = presses[rng.integers(len(presses), size=count)]
    kinds, charge = draw_charges(rng, chosen.charge, presses.charge, noise)
    charge = np.clip(charge, *limits)
    near = np.isin(kinds, ("noisy", "moved"))
    return np.stack([charge, _residuals(charge_map, charge, noise.sigma(charge), chosen, near, candidates)])


def _residuals(
    charge_map: ChargeMap, charge: Array, sigma: Array, chosen: LabelledPresses, near: Booleans, candidates: int
) -> Array:
    """Return the residuals of charges at the nearest contact, in units of their noise, shape (n, n_electrode).

    Charges that are `near` to those of their own press are compared with contacts around it. The charge map is scaled
    so that it is exact at this press. For all other charges the nearest contact is searched.
    """
    residual = np.zeros_like(charge)
    near_rows = np.flatnonzero(near)
    start = chosen.contact[near_rows]
    scale = np.clip(chosen.charge[near_rows] / charge_map.charges(start), 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
    _, residual[near_rows] = explain(charge_map, charge[near_rows] / scale, sigma[near_rows] / scale, start)
    far_rows = np.flatnonzero(~near | (np.linalg.norm(residual, axis=1) > FAR))
    _, searched = search(charge_map, charge[far_rows], sigma[far_rows], candidates=candidates)
    is_smaller = (residual[far_rows] ** 2).sum(axis=1) < (searched**2).sum(axis=1)
    keep = near[far_rows] & is_smaller
    residual[far_rows] = np.where(keep[:, None], residual[far_rows], searched)
    return residual


def draw_charges(rng: np.random.Generator, charge: Array, others: Array, noise: Noise) -> tuple[NDArray[Any], Array]:
    """Draw a kind for each press and make charges of this kind.

    Args:
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC.
        others: Charges of further presses, for two presses at the same time and for the box, shape (m, n_electrode).
        noise: Noise of good presses.

    Returns:
        The kinds, shape (n,), and the charges, shape (n, n_electrode), pC.
    """
    kinds = np.array(list(KINDS))[rng.choice(len(KINDS), size=len(charge), p=list(KINDS.values()))]
    drawn = np.empty_like(charge)
    for kind in KINDS:
        rows = kinds == kind
        drawn[rows] = _draw(kind, rng, charge[rows], others, noise)
    return kinds, drawn


def _draw(kind: str, rng: np.random.Generator, charge: Array, others: Array, noise: Noise) -> Array:
    """Draw charges of one kind, shape (n, n_electrode), pC.

    Charges of any sign are moved and fill the box in units of their noise, positive charges in logarithms.
    """
    each = (len(charge), 1)
    match kind:
        case "moved" if isinstance(noise, ChannelNoise):
            far = 10.0 ** rng.uniform(-1.0, FARTHEST, each)
            return noise.charge(noise.level(charge) + far * rng.standard_normal(charge.shape))
        case "any" if isinstance(noise, ChannelNoise):
            level = noise.level(others)
            low, high = level.min(axis=0), level.max(axis=0)
            return noise.charge(rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, charge.shape))
        case "noisy":
            return noise.add(charge, rng)
        case "moved":  # in any direction, by a thousandth up to a factor of seven
            factor = np.exp(10.0 ** rng.uniform(-3.0, 0.3, each) * rng.standard_normal(charge.shape))
        case "gains":  # half of the electrodes off by 15 %
            factor = np.exp(0.15 * (rng.random(charge.shape) < 0.5) * rng.standard_normal(charge.shape))
        case "dying":  # one electrode keeps a share of its charge, down to a thousandth
            dead = rng.integers(charge.shape[1], size=each) == np.arange(charge.shape[1])
            factor = np.where(dead, 10.0 ** rng.uniform(-3.0, 0.0, each), 1.0)
        case "scaled":  # all by a common factor from a hundredth to a hundred, and a little each
            charge = charge * 10.0 ** rng.uniform(-2.0, 2.0, each)
            factor = np.exp(0.05 * rng.standard_normal(charge.shape))
        case "two":
            return charge + others[rng.integers(len(others), size=len(charge))]
        case _:  # uniform in logarithms, from what counts as nothing to 10 nC or to what counts as most
            decades = np.where(rng.random(each) < 0.3, np.log10(HIGHEST_CHARGE), 4.0)
            return 10.0 ** (decades * rng.random(charge.shape))
    return charge * factor
