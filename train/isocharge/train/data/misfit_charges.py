"""Charges that the misfit is learned from: of good presses, of bad ones, and of no press at all.

The misfit network answers whatever charges come in, so it has to have seen all kinds: presses with their noise, charges
off the image of the forward map by any distance, wrong gains, dying electrodes, forces far outside, two presses at once
(their charges added: the film is not linear, so this is only like two presses), and charges drawn from a box that holds
everything. Few electrodes make a space small enough to be covered.
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
"""Kinds of charges, and the share of the examples that each makes up, dimensionless."""

FARTHEST = 2.5
"""Decades by which charges of any sign are moved, in standard deviations of the noise."""

LARGEST_FACTOR = 2.0
"""Factor by which a map may be off at a press to be scaled there: a quotient of charges near zero says nothing."""

FAR = 6.0
"""Distance above which a press's own place may not be the nearest: searched as the others are."""


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """The unit of the misfit: the training's noise, or `reference` where that is none."""
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
    """Draw charges of every kind, and find how far from any known contact they are.

    Args:
        presses: To start from.
        charge_map: What is known.
        noise: Noise of good presses, and the unit of distance; `ChannelNoise` for charges of any sign.
        count: How many.
        seed: Of all that is drawn.
        candidates: Contacts among which searches start.
        limits: What charges are brought between, pC, as the network brings them.

    Returns:
        The charges Q, pC, and their residuals (Q - Q(c)) / sigma at the nearest known contact c, shape (2, count,
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
    """Those `near` their own press start there, with the map scaled to be right there; the others search."""
    residual, at = np.zeros_like(charge), np.flatnonzero(near)
    start = chosen.contact[at]
    scale = np.clip(chosen.charge[at] / charge_map.charges(start), 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
    residual[at] = explain(charge_map, charge[at] / scale, sigma[at] / scale, start)[1]
    far = np.flatnonzero(~near | (np.linalg.norm(residual, axis=1) > FAR))
    searched = search(charge_map, charge[far], sigma[far], candidates=candidates)[1]
    keep = near[far] & ((residual[far] ** 2).sum(axis=1) < (searched**2).sum(axis=1))
    residual[far] = np.where(keep[:, None], residual[far], searched)
    return residual


def draw_charges(rng: np.random.Generator, charge: Array, others: Array, noise: Noise) -> tuple[NDArray[Any], Array]:
    """Kinds, shape (n,), and charges of them made from those of presses, shape (n, n_electrode), pC."""
    kinds = np.array(list(KINDS))[rng.choice(len(KINDS), size=len(charge), p=list(KINDS.values()))]
    drawn = np.empty_like(charge)
    for kind in KINDS:
        rows = kinds == kind
        drawn[rows] = _draw(kind, rng, charge[rows], others, noise)
    return kinds, drawn


def _draw(kind: str, rng: np.random.Generator, charge: Array, others: Array, noise: Noise) -> Array:
    """Charges of one kind; those of any sign are moved, and fill a box, in units of their noise."""
    each = len(charge), 1
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
