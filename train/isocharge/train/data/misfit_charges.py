"""Training charges of the misfit network: charges of good presses, charges of faulty presses, and random charges.

The misfit network has to answer any charges, so it is trained on charges of many kinds (`KINDS`) and on presses outside
the working area. The charges of two simultaneous presses are approximated from the charges of the single presses.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate import ChargeMap, NoiseModel, noise_model
from isocharge.simulate.identifiability.nearest_contact import CANDIDATES, explain, search
from isocharge.train.data.channel_noise import ChannelNoise, Noise
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses

KINDS = {"noisy": 0.35, "moved": 0.25, "gains": 0.12, "dying": 0.05, "scaled": 0.06, "two": 0.1, "any": 0.07}
"""Share of each kind of charges in the training examples, dimensionless.

- "noisy": charges of presses with noise.
- "moved": charges at various distances from the charges of a press.
- "gains": charges of electrodes with wrong gains.
- "dying": charges of presses with one failing electrode.
- "scaled": charges of forces far outside the range.
- "two": charges of two simultaneous presses.
- "any": charges from a box that contains the charges of all presses.
"""

PAIR_EXPONENTS = (1.0, 1.75)
"""Smallest and largest exponent p with which the charges of two presses are combined, (Q1^p + Q2^p)^(1/p).

On a taut film, charges of two presses add up (p = 1). On a slack film the charge grows with the force to the power 2/3,
and two presses at the same place have p = 3/2. Presses solved with both loads at once lie in between.
"""

MIN_CHANGE = 1e-4
"""Change of |residual|^2 below which the search for the nearest contact ends, relative to 1 + |residual|^2.

For 99 % of the examples, the misfit then differs by less than 0.001 from the misfit of a converged search.
"""

MOVED_LOG_STDS = (-3.0, 0.3)
"""Decimal logarithms of the smallest and the largest standard deviation of ln Q for moved positive charges."""

MOVED_LOG_DISTANCES = (-1.0, 2.5)
"""Decimal logarithms of the smallest and the largest distance by which charges of any sign are moved.

The unit of the distance is the standard deviation of the noise.
"""

WRONG_GAIN_STD = 0.15
"""Standard deviation of the logarithm of a wrong gain."""

COMMON_FACTOR_SCATTER = 0.05
"""Standard deviation of the logarithm of a charge about a factor that is common to all electrodes."""

BOX_LOG_LIMIT = 4.0
"""Decimal logarithm of the largest positive charge of the box, pC, except for `LARGE_BOX_FRACTION` of the presses."""

LARGE_BOX_FRACTION = 0.3
"""Fraction of the presses for which the box reaches up to the largest charge of the network."""

OUTSIDE_SCATTER = 0.02
"""Standard deviation of the logarithm of a factor of all charges of a press outside the working area, dimensionless.

The factor fills the gaps between the given presses.
"""

LARGEST_FACTOR = 2.0
"""Largest factor by which the charge map is scaled at a press. A quotient of charges near zero is meaningless."""

MAX_NEAR_MISFIT = 6.0
"""Misfit at the contact of a press above which another contact may be nearer, so that a search is made."""


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """Return the noise that is the unit of the misfit.

    This unit is the noise of the training, or the noise `reference` if the training has no noise.
    """
    has_noise = noise.white > 0.0
    return noise if has_noise else noise_model("reference")


@dataclass(frozen=True)
class ExampleOptions:
    """Options for drawing examples.

    Attributes:
        candidates: Number of contacts among which the starts of a search are chosen.
        starts: Number of starts of a search.
        limits: Smallest and largest charge, pC. Charges are clipped to these limits, as in the network.
    """

    candidates: int = CANDIDATES
    starts: int = 2
    limits: tuple[Array | float, Array | float] = (LOWEST_CHARGE, HIGHEST_CHARGE)

    def find_nearest(self, charge_map: ChargeMap, charge: Array, sigma: Array) -> tuple[Array, Array]:
        """Search for the contact whose charges are nearest to each set of charges.

        Args:
            charge_map: Map from contacts to charges.
            charge: Charges, shape (n, n_electrode), pC.
            sigma: Standard deviations of the charges, shape (n, n_electrode), pC.

        Returns:
            The contacts, shape (n, 3), and the residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
        """
        return search(charge_map, charge, sigma, starts=self.starts, candidates=self.candidates, min_change=MIN_CHANGE)


DEFAULT_OPTIONS = ExampleOptions()
"""Options for positive charges and few electrodes."""


def draw_misfit_examples(
    presses: LabelledPresses,
    charge_map: ChargeMap,
    noise: Noise,
    count: int,
    seed: int,
    *,
    options: ExampleOptions = DEFAULT_OPTIONS,
) -> Array:
    """Draw charges of every kind, and compute their residuals at the nearest contact.

    Args:
        presses: Presses from whose charges the examples are made.
        charge_map: Map from contacts to charges.
        noise: Noise of good presses, which is also the unit of the distance; a `ChannelNoise` for charges of any sign.
        count: Number of examples.
        seed: Seed of the random numbers.
        options: Limits of the charges, and settings of the search for the nearest contact.

    Returns:
        The charges Q, pC, and their residuals (Q - Q(c)) / sigma at the nearest contact c, shape (2, count,
        n_electrode).
    """
    rng = np.random.default_rng(seed)
    chosen = presses[rng.integers(len(presses), size=count)]
    kinds, drawn_charge = draw_charges(rng, chosen.charge, presses.charge, noise)
    charge = np.clip(drawn_charge, *options.limits)
    is_near = np.isin(kinds, ("noisy", "moved"))  # charges of these kinds are similar to those of their press
    residual = _residuals(charge_map, charge, noise.sigma(charge), chosen, is_near, options.find_nearest)
    return np.stack([charge, residual])


def draw_outside_examples(
    outside: Array,
    charge_map: ChargeMap,
    noise: Noise,
    count: int,
    seed: int,
    *,
    options: ExampleOptions = DEFAULT_OPTIONS,
) -> Array:
    """Draw noisy charges of presses outside the working area, and compute their residuals at the nearest contact.

    Before the noise is added, all charges of a press are multiplied by a random factor near 1.

    Args:
        outside: Charges of presses outside the working area, shape (m, n_electrode), pC.
        charge_map: Map from contacts of the working area to charges.
        noise: Noise of good presses, which is also the unit of the distance.
        count: Number of examples.
        seed: Seed of the random numbers.
        options: Limits of the charges, and settings of the search for the nearest contact.

    Returns:
        Charges and residuals, as `draw_misfit_examples` returns them, shape (2, count, n_electrode).
    """
    rng = np.random.default_rng(seed)
    chosen_charge = outside[rng.integers(len(outside), size=count)]
    factor = np.exp(OUTSIDE_SCATTER * rng.standard_normal((count, 1)))
    noisy_charge = noise.add(chosen_charge * factor, rng)
    charge = np.clip(noisy_charge, *options.limits)
    _, residual = options.find_nearest(charge_map, charge, noise.sigma(charge))
    return np.stack([charge, residual])


def _residuals(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    chosen: LabelledPresses,
    is_near: Booleans,
    find_nearest: Callable[[ChargeMap, Array, Array], tuple[Array, Array]],
) -> Array:
    """Compute the residuals of charges at the nearest contact.

    Some charges are similar to those of the press from which they were made. For these charges, the search begins at
    this press, with a charge map that is scaled so that it is exact there. For all other charges, the nearest contact
    is searched for among many candidates.

    Args:
        charge_map: Map from contacts to charges.
        charge: Charges, shape (n, n_electrode), pC.
        sigma: Standard deviations of the noise of these charges, same shape, pC.
        chosen: Presses from which the charges were made.
        is_near: Whether the charges of each row are similar to those of their press, shape (n,).
        find_nearest: Function from a charge map, charges and their standard deviations to the nearest contacts and the
            residuals; see `search`.

    Returns:
        Residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """
    residual = np.zeros_like(charge)
    near_rows = np.flatnonzero(is_near)
    start = chosen.contact[near_rows]
    exact_factor = chosen.charge[near_rows] / charge_map.charges(start)
    map_factor = np.clip(exact_factor, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
    # The residual (Q - f Q(c)) / sigma of the scaled map is equal to (Q / f - Q(c)) / (sigma / f).
    _, residual[near_rows] = explain(
        charge_map, charge[near_rows] / map_factor, sigma[near_rows] / map_factor, start, min_change=MIN_CHANGE
    )

    # A large residual near the press may be a local minimum, so a search is made for these charges, too.
    has_large_residual = np.linalg.norm(residual, axis=1) > MAX_NEAR_MISFIT
    searched_rows = np.flatnonzero(~is_near | has_large_residual)
    _, searched_residual = find_nearest(charge_map, charge[searched_rows], sigma[searched_rows])

    # Keep the smaller one of both residuals. Rows that are not near a press have only the residual of the search.
    near_residual = residual[searched_rows]
    is_near_smaller = (near_residual**2).sum(axis=1) < (searched_residual**2).sum(axis=1)
    keeps_near_residual = is_near[searched_rows] & is_near_smaller
    residual[searched_rows] = np.where(keeps_near_residual[:, None], near_residual, searched_residual)
    return residual


def draw_charges(
    rng: np.random.Generator, charge: Array, other_charge: Array, noise: Noise
) -> tuple[NDArray[Any], Array]:
    """Draw a kind for each press, and change the charges of the press in the way of this kind.

    `KINDS` contains the probability of each kind.

    Args:
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC.
        other_charge: Charges of further presses, shape (m, n_electrode), pC. The kind "two" adds one of these presses
            as the second press. The kind "any" draws charges from a box around all of these presses.
        noise: Noise of good presses.

    Returns:
        Names of the kinds, shape (n,), and charges, shape (n, n_electrode), pC.
    """
    kind_names = np.array(list(KINDS))
    kind_index = rng.choice(len(KINDS), size=len(charge), p=list(KINDS.values()))
    kinds = kind_names[kind_index]
    drawn = np.empty_like(charge)
    for kind in KINDS:
        rows = kinds == kind
        drawn[rows] = _draw_kind(kind, rng, charge[rows], other_charge, noise)
    return kinds, drawn


def _draw_kind(kind: str, rng: np.random.Generator, charge: Array, other_charge: Array, noise: Noise) -> Array:
    """Return the charges of presses, changed in the way of one kind.

    Args:
        kind: Name of the kind; see `KINDS`.
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC.
        other_charge: Charges of further presses, shape (m, n_electrode), pC.
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
            second_charge = other_charge[rng.integers(len(other_charge), size=len(charge))]
            exponent = rng.uniform(*PAIR_EXPONENTS, (len(charge), 1))
            return combined_charge(charge, second_charge, exponent)
        case _:  # the kind "any"
            return _any_charges(rng, charge.shape, other_charge, noise)


def _moved_charges(rng: np.random.Generator, charge: Array, noise: Noise) -> Array:
    """Move charges in random directions by random distances.

    Charges of any sign are moved by a multiple of the standard deviation of their noise; see `MOVED_LOG_DISTANCES`.
    Positive charges are multiplied by factors whose logarithms are normally distributed. The standard deviation of the
    logarithms is between 0.001 and 2.

    Args:
        rng: Random number generator.
        charge: Charges, shape (n, n_electrode), pC.
        noise: Noise of good presses; a `ChannelNoise` for charges of any sign.

    Returns:
        Moved charges, same shape, pC.
    """
    one_per_press = (len(charge), 1)  # the shape of an array with one number for each press
    if isinstance(noise, ChannelNoise):
        # The noise of a level has the standard deviation 1, so a distance between levels is a multiple of the noise.
        distance = 10.0 ** rng.uniform(*MOVED_LOG_DISTANCES, one_per_press)
        moved_level = noise.level(charge) + distance * rng.standard_normal(charge.shape)
        return noise.charge(moved_level)
    log_std = 10.0 ** rng.uniform(*MOVED_LOG_STDS, one_per_press)
    return np.asarray(charge * np.exp(log_std * rng.standard_normal(charge.shape)))


def _wrong_gains(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw gains, shape (n, n_electrode). About half of them are wrong, with a standard deviation of 15 %."""
    is_wrong = rng.random(shape) < 0.5
    log_gain = np.where(is_wrong, WRONG_GAIN_STD * rng.standard_normal(shape), 0.0)
    return np.exp(log_gain)


def _failing_gains(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw gains, shape (n, n_electrode).

    One electrode has a gain between 0.001 and 1, and all others have the gain 1.
    """
    n_press, n_electrode = shape
    failing_electrode = rng.integers(n_electrode, size=(n_press, 1))
    is_failing = failing_electrode == np.arange(n_electrode)  # shape (n_press, n_electrode)
    failing_gain = 10.0 ** rng.uniform(-3.0, 0.0, (n_press, 1))
    return np.where(is_failing, failing_gain, 1.0)


def _common_factors(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw factors from 0.01 to 100, shape (n, n_electrode), which are nearly equal for all electrodes of a press."""
    n_press, _ = shape
    common_factor = 10.0 ** rng.uniform(-2.0, 2.0, (n_press, 1))
    return np.asarray(common_factor * np.exp(COMMON_FACTOR_SCATTER * rng.standard_normal(shape)))


def _any_charges(rng: np.random.Generator, shape: tuple[int, ...], other_charge: Array, noise: Noise) -> Array:
    """Draw charges from a box that contains the charges of all presses.

    Charges of any sign are uniformly distributed in units of their noise. The logarithms of positive charges are
    uniformly distributed, from 1 pC to 10 nC or, for some presses, to the largest charge of the network.

    Args:
        rng: Random number generator.
        shape: Shape of the charges, (n, n_electrode).
        other_charge: Charges of presses, which determine the box for charges of any sign, shape (m, n_electrode), pC.
        noise: Noise of good presses; a `ChannelNoise` for charges of any sign.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    if isinstance(noise, ChannelNoise):
        level = noise.level(other_charge)
        lowest = level.min(axis=0)
        highest = level.max(axis=0)
        margin = 0.5 * (highest - lowest)  # on both sides, so the box is twice as wide as the range of the charges
        drawn_level = rng.uniform(lowest - margin, highest + margin, shape)
        return noise.charge(drawn_level)

    n_press, _ = shape
    has_large_box = rng.random((n_press, 1)) < LARGE_BOX_FRACTION
    log_limit = np.where(has_large_box, np.log10(HIGHEST_CHARGE), BOX_LOG_LIMIT)
    return 10.0 ** (log_limit * rng.random(shape))  # from 10^0 = 1 pC


def combined_charge(first: Array, second: Array, exponent: Array | float) -> Array:
    """Approximate the charges of two simultaneous presses by (Q1^p + Q2^p)^(1/p).

    Q1 and Q2 are the charges that each press alone would cause. A power of a negative charge keeps the sign of the
    charge: it is sign(Q) |Q|^p.

    Args:
        first: Charges of the first press alone, shape (n, n_electrode), pC.
        second: Charges of the second press alone, same shape.
        exponent: The exponent p, a number or shape (n, 1).

    Returns:
        Charges of both presses, shape (n, n_electrode), pC.
    """
    sum_of_powers = _signed_power(first, exponent) + _signed_power(second, exponent)
    return _signed_power(sum_of_powers, 1.0 / exponent)


def _signed_power(charge: Array, power: Array | float) -> Array:
    """Raise the magnitude of each charge to a power, and keep the sign of the charge."""
    return np.asarray(np.sign(charge) * np.abs(charge) ** power)
