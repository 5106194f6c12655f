"""Training charges of the misfit network: charges of good presses, charges of faulty presses, and random charges.

The misfit network has to answer any charges, so it is trained on all kinds of charges: presses with noise; charges at
any distance from the charges that contacts can have; wrong gains; failing electrodes; forces far outside of the range;
two presses at the same time; presses outside the working area; and charges from a box that contains all of these. The
charges of two presses at the same time are approximated from those of the single presses.
"""

from collections.abc import Callable
from functools import partial
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

PAIR_EXPONENTS = (1.0, 1.75)
"""Smallest and largest exponent p with which the charges of two presses are combined, (Q1^p + Q2^p)^(1/p).

On a taut film, charges of two presses add up (p = 1). On a slack film the charge grows with the force to the power 2/3,
and two presses at the same place have p = 3/2. Presses solved with both loads at once lie in between.
"""

MIN_CHANGE = 1e-4
"""Change of |residual|^2 below which the search for the nearest contact ends, relative to 1 + |residual|^2.

The misfits of 99 % of the examples then differ by less than 0.001 from those of a converged search.
"""

OUTSIDE_SCATTER = 0.02
"""Standard deviation of the logarithm of a factor of all charges of a press outside the working area, dimensionless.

It fills the gaps between the presses that are given.
"""

LARGEST_FACTOR = 2.0
"""Largest factor by which the charge map is scaled at a press. A quotient of charges near zero is meaningless."""

FAR = 6.0
"""Misfit above which the contact of a press may not be the nearest one, so that the nearest one is searched."""


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """Return the noise that is the unit of the misfit.

    It is the noise of the training, or `reference` if the noise of the training is zero.
    """
    return noise if noise.white > 0.0 else noise_model("reference")


def draw_misfit_examples(
    presses: LabelledPresses,
    charge_map: ChargeMap,
    noise: Noise,
    count: int,
    seed: int,
    *,
    candidates: int = CANDIDATES,
    starts: int = 2,
    limits: tuple[Array | float, Array | float] = (LOWEST_CHARGE, HIGHEST_CHARGE),
) -> Array:
    """Draw charges of every kind, and compute their distance from the charges of the nearest contact.

    Args:
        presses: Presses from whose charges the examples are made.
        charge_map: Map from contacts to charges.
        noise: Noise of good presses, which is also the unit of the distance; a `ChannelNoise` for charges of any sign.
        count: Number of examples.
        seed: Seed of the random numbers.
        candidates: Number of contacts among which the starts of a search are chosen.
        starts: Number of starts of a search.
        limits: Smallest and largest charge, pC. Charges are clipped to these limits, as in the network.

    Returns:
        The charges Q, pC, and their residuals (Q - Q(c)) / sigma at the nearest contact c, shape (2, count,
        n_electrode).
    """
    rng = np.random.default_rng(seed)
    chosen = presses[rng.integers(len(presses), size=count)]
    kinds, charge = draw_charges(rng, chosen.charge, presses.charge, noise)
    near = np.isin(kinds, ("noisy", "moved"))
    charge = np.clip(charge, *limits)
    find_nearest = partial(search, starts=starts, candidates=candidates, min_change=MIN_CHANGE)
    return np.stack([charge, _residuals(charge_map, charge, noise.sigma(charge), chosen, near, find_nearest)])


def draw_outside_examples(
    outside: Array,
    charge_map: ChargeMap,
    noise: Noise,
    count: int,
    seed: int,
    *,
    candidates: int = CANDIDATES,
    starts: int = 2,
    limits: tuple[Array | float, Array | float] = (LOWEST_CHARGE, HIGHEST_CHARGE),
) -> Array:
    """Draw noisy charges of presses outside the working area, and compute their distance from the nearest contact.

    Args:
        outside: Charges of presses outside the working area, shape (m, n_electrode), pC.
        charge_map: Map from contacts of the working area to charges.
        noise: Noise of good presses, which is also the unit of the distance.
        count: Number of examples.
        seed: Seed of the random numbers.
        candidates: Number of contacts among which the starts of a search are chosen.
        starts: Number of starts of a search.
        limits: Smallest and largest charge, pC, to which charges are clipped.

    Returns:
        Charges and residuals, as of `draw_misfit_examples`.
    """
    rng = np.random.default_rng(seed)
    chosen = outside[rng.integers(len(outside), size=count)]
    factor = np.exp(OUTSIDE_SCATTER * rng.standard_normal((count, 1)))
    charge = np.clip(noise.add(chosen * factor, rng), *limits)
    sigma = noise.sigma(charge)
    _, residual = search(charge_map, charge, sigma, starts=starts, candidates=candidates, min_change=MIN_CHANGE)
    return np.stack([charge, residual])


def _residuals(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    chosen: LabelledPresses,
    near: Booleans,
    find_nearest: Callable[[ChargeMap, Array, Array], tuple[Array, Array]],
) -> Array:
    """Compute the residuals of charges at the nearest contact.

    Some charges are similar to those of the press from which they were made. They are compared with contacts near this
    press. The charge map is scaled so that it is exact at this press. For all other charges, the nearest contact is
    searched for among many candidates.

    Args:
        charge_map: Map from contacts to charges.
        charge: Charges, shape (n, n_electrode), pC.
        sigma: Standard deviations of the noise of these charges, same shape, pC.
        chosen: Presses from which the charges were made.
        near: Whether each of the charges is similar to those of its press, shape (n,).
        find_nearest: Function from a charge map, charges and their standard deviations to the nearest contacts and the
            residuals; see `search`.

    Returns:
        Residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """
    residual = np.zeros_like(charge)
    near_rows = np.flatnonzero(near)
    start = chosen.contact[near_rows]
    map_factor = np.clip(chosen.charge[near_rows] / charge_map.charges(start), 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
    _, residual[near_rows] = explain(
        charge_map, charge[near_rows] / map_factor, sigma[near_rows] / map_factor, start, min_change=MIN_CHANGE
    )

    # A large residual near the press may be a local minimum, so a search is made for these charges, too.
    searched_rows = np.flatnonzero(~near | (np.linalg.norm(residual, axis=1) > FAR))
    _, searched_residual = find_nearest(charge_map, charge[searched_rows], sigma[searched_rows])
    near_residual = residual[searched_rows]
    is_near_smaller = (near_residual**2).sum(axis=1) < (searched_residual**2).sum(axis=1)
    use_near = near[searched_rows] & is_near_smaller
    residual[searched_rows] = np.where(use_near[:, None], near_residual, searched_residual)
    return residual


def draw_charges(rng: np.random.Generator, charge: Array, others: Array, noise: Noise) -> tuple[NDArray[Any], Array]:
    """Draw a kind of charges for each press, and create charges of this kind.

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
    """Draw charges of one kind.

    Args:
        kind: Name of the kind; see `KINDS`.
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC.
        others: Charges of further presses, shape (m, n_electrode), pC.
        noise: Noise of good presses.

    Returns:
        Charges of the kind, shape (n, n_electrode), pC.
    """
    match kind:
        case "noisy":
            return noise.add(charge, rng)
        case "moved":
            return _moved_charges(rng, charge, noise)
        case "gains":
            return charge * _wrong_gains(rng, charge.shape)
        case "dying":
            return charge * _failing_gains(rng, charge.shape)
        case "scaled":
            return charge * _common_factors(rng, charge.shape)
        case "two":
            second = others[rng.integers(len(others), size=len(charge))]
            return combined_charge(charge, second, rng.uniform(*PAIR_EXPONENTS, (len(charge), 1)))
        case _:
            return _any_charges(rng, charge.shape, others, noise)


def _moved_charges(rng: np.random.Generator, charge: Array, noise: Noise) -> Array:
    """Move charges in random directions by random distances.

    Charges of any sign are moved by up to 10^FARTHEST standard deviations of their noise. Positive charges are
    multiplied by factors whose logarithms are normally distributed. The standard deviation of the logarithms is between
    0.001 and 2.

    Args:
        rng: Random number generator.
        charge: Charges, shape (n, n_electrode), pC.
        noise: Noise of good presses; a `ChannelNoise` for charges of any sign.

    Returns:
        Moved charges, same shape, pC.
    """
    one_per_press = (len(charge), 1)
    if isinstance(noise, ChannelNoise):
        distance = 10.0 ** rng.uniform(-1.0, FARTHEST, one_per_press)
        return noise.charge(noise.level(charge) + distance * rng.standard_normal(charge.shape))
    distance = 10.0 ** rng.uniform(-3.0, 0.3, one_per_press)
    return np.asarray(charge * np.exp(distance * rng.standard_normal(charge.shape)))


def _wrong_gains(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw gains, shape (n, n_electrode), about half of which are wrong with a standard deviation of 15 %."""
    is_wrong = rng.random(shape) < 0.5
    return np.exp(0.15 * is_wrong * rng.standard_normal(shape))


def _failing_gains(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw gains that are 1 for all electrodes but one, whose gain is between 0.001 and 1, shape (n, n_electrode)."""
    n_press, n_electrode = shape
    is_failing = rng.integers(n_electrode, size=(n_press, 1)) == np.arange(n_electrode)
    failing_gain = 10.0 ** rng.uniform(-3.0, 0.0, (n_press, 1))
    return np.where(is_failing, failing_gain, 1.0)


def _common_factors(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw factors from 0.01 to 100 that are nearly equal for all electrodes of a press, shape (n, n_electrode)."""
    n_press, _ = shape
    common_factor = 10.0 ** rng.uniform(-2.0, 2.0, (n_press, 1))
    return np.asarray(common_factor * np.exp(0.05 * rng.standard_normal(shape)))


def _any_charges(rng: np.random.Generator, shape: tuple[int, ...], others: Array, noise: Noise) -> Array:
    """Draw charges from a box that contains the charges of all presses.

    Charges of any sign are uniformly distributed in units of their noise. The logarithms of positive charges are
    uniformly distributed, from 1 pC to 10 nC or, for some presses, to the largest charge of the network.

    Args:
        rng: Random number generator.
        shape: Shape (n, n_electrode) of the charges.
        others: Charges of presses, which determine the box for charges of any sign, shape (m, n_electrode), pC.
        noise: Noise of good presses; a `ChannelNoise` for charges of any sign.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    if isinstance(noise, ChannelNoise):
        level = noise.level(others)
        lowest = level.min(axis=0)
        highest = level.max(axis=0)
        margin = 0.5 * (highest - lowest)
        return noise.charge(rng.uniform(lowest - margin, highest + margin, shape))
    n_press, _ = shape
    largest_decade = np.where(rng.random((n_press, 1)) < 0.3, np.log10(HIGHEST_CHARGE), 4.0)
    return 10.0 ** (largest_decade * rng.random(shape))


def combined_charge(first: Array, second: Array, exponent: Array | float) -> Array:
    """Approximate the charges of two presses at the same time, (Q1^p + Q2^p)^(1/p).

    Args:
        first: Charges of the first press alone, shape (n, n_electrode), pC.
        second: Charges of the second press alone, same shape.
        exponent: The exponent p, a number or shape (n, 1).

    Returns:
        Charges of both presses, shape (n, n_electrode), pC. Powers of negative charges keep the sign.
    """

    def signed_power(charge: Array, power: Array | float) -> Array:
        return np.asarray(np.sign(charge) * np.abs(charge) ** power)

    total = signed_power(first, exponent) + signed_power(second, exponent)
    return signed_power(total, 1.0 / exponent)
