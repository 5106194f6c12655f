"""Training charges of the misfit network: charges of good presses, charges of faulty presses, and random charges.

The misfit network must be accurate for arbitrary charges. Its training data therefore contain charges of many kinds
(`KINDS`) and charges of presses outside the working area. The charges of two simultaneous presses are approximated from
the charges that each press alone would cause.
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
- "moved": charges at various distances from the charges of presses.
- "gains": charges of presses with wrong gains of some electrodes.
- "dying": charges of presses in which one electrode loses its charge.
- "scaled": charges of presses, multiplied by a factor, as for forces far outside the range of forces.
- "two": charges of two simultaneous presses.
- "any": random charges from a box that contains the charges of all presses.
"""

PAIR_EXPONENTS = (1.0, 1.75)
"""Smallest and largest exponent p with which the charges of two presses are combined, (Q1^p + Q2^p)^(1/p).

On a taut film, the charges of two presses are added (p = 1). On a slack film, the charge is proportional to the power
2/3 of the force, so that two presses at the same place are combined with p = 3/2. The charges in a simulation of both
presses together lie between the results with the two limits of p.
"""

MIN_CHANGE = 1e-4
"""Change of |residual|^2 below which a search for the nearest contact ends, relative to 1 + |residual|^2.

The misfit of nearly all examples then differs negligibly from the misfit of a search that is continued.
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
"""Standard deviation of the logarithm of an electrode's factor relative to the factor of its press."""

BOX_LOG_LIMIT = 4.0
"""Decimal logarithm of the largest charge of the box for positive charges in pC, except for large boxes."""

LARGE_BOX_FRACTION = 0.3
"""Fraction of the presses with a large box for positive charges, up to the largest charge of the network."""

OUTSIDE_SCATTER = 0.02
"""Standard deviation of the logarithm of the random factor of a press outside the working area, dimensionless.

All charges of the press are multiplied by this factor, which fills the gaps between the given presses.
"""

LARGEST_FACTOR = 2.0
"""Largest factor by which the charge map is scaled at a press.

The factor is the quotient of two charges, which is meaningless if the charges are near zero."""

MAX_NEAR_MISFIT = 6.0
"""Largest misfit of charges near their press for which the nearest contact is searched for only near this press.

If the misfit is larger, the charges of a distant contact may be nearer."""


def misfit_noise(noise: NoiseModel) -> NoiseModel:
    """Return the noise whose standard deviation is the unit of the misfit.

    The result is the noise of the training or, if the training has no noise, the noise `reference`.
    """
    has_noise = noise.white > 0.0
    return noise if has_noise else noise_model("reference")


@dataclass(frozen=True)
class ExampleOptions:
    """Options for drawing training examples for the misfit network.

    Attributes:
        candidates: Number of contacts among which the starts of a search for the nearest contact are chosen.
        starts: Number of contacts at which a search starts.
        limits: Smallest and largest charge, pC, for all electrodes or for each electrode. The charges are clipped to
            these limits, as in the network.
    """

    candidates: int = CANDIDATES
    starts: int = 2
    limits: tuple[Array | float, Array | float] = (LOWEST_CHARGE, HIGHEST_CHARGE)

    def find_nearest(self, charge_map: ChargeMap, charge: Array, sigma: Array) -> tuple[Array, Array]:
        """For each set of charges, search for the contact with the nearest charges.

        Args:
            charge_map: Map from contacts to charges.
            charge: Charges, shape (n, n_electrode), pC.
            sigma: Standard deviations of the charges, shape (n, n_electrode), pC.

        Returns:
            The contacts c (x, y, F), shape (n, 3), mm and N, and the residuals (Q - Q(c)) / sigma of the charges Q,
            shape (n, n_electrode).
        """
        return search(charge_map, charge, sigma, starts=self.starts, candidates=self.candidates, min_change=MIN_CHANGE)


DEFAULT_OPTIONS = ExampleOptions()
"""Options for positive charges."""


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
        presses: Presses from which the examples are made.
        charge_map: Map from contacts to charges.
        noise: Noise of good presses, whose standard deviation is the unit of the residuals; a `ChannelNoise` for
            charges of any sign.
        count: Number of examples.
        seed: Seed of the random numbers.
        options: Limits of the charges, and settings of the search for the nearest contact.

    Returns:
        Array of shape (2, count, n_electrode) with the charges Q, pC, and then their residuals (Q - Q(c)) / sigma at
        the nearest contact c.
    """
    rng = np.random.default_rng(seed)
    chosen_presses = presses[rng.integers(len(presses), size=count)]
    kinds, drawn_charge = draw_charges(rng, chosen_presses.charge, presses.charge, noise)
    charge = np.clip(drawn_charge, *options.limits)
    is_near = np.isin(kinds, ("noisy", "moved"))  # charges of these kinds are similar to those of their press
    residual = _compute_residuals(
        charge_map, charge, noise.sigma(charge), chosen_presses, is_near, options.find_nearest
    )
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
        noise: Noise of good presses, whose standard deviation is the unit of the residuals.
        count: Number of examples.
        seed: Seed of the random numbers.
        options: Limits of the charges, and settings of the search for the nearest contact.

    Returns:
        Array of shape (2, count, n_electrode) with charges and residuals, as `draw_misfit_examples` returns them.
    """
    rng = np.random.default_rng(seed)
    chosen_charge = outside[rng.integers(len(outside), size=count)]
    common_factor = np.exp(OUTSIDE_SCATTER * rng.standard_normal((count, 1)))  # one factor for all charges of a press
    noisy_charge = noise.add(chosen_charge * common_factor, rng)
    charge = np.clip(noisy_charge, *options.limits)
    _, residual = options.find_nearest(charge_map, charge, noise.sigma(charge))
    return np.stack([charge, residual])


def _compute_residuals(
    charge_map: ChargeMap,
    charge: Array,
    sigma: Array,
    source_presses: LabelledPresses,
    is_near: Booleans,
    find_nearest: Callable[[ChargeMap, Array, Array], tuple[Array, Array]],
) -> Array:
    """Compute the residuals of charges at the nearest contact, which is the contact with the most similar charges.

    Charges that are similar to those of the press from which they were made are called near. For near charges, a fast
    search begins at the contact of the press. In this search, the charge map is scaled so that it gives the charges
    of the press at this contact. A thorough search begins at several contacts. The thorough search is made for all
    charges that are not near, and for near charges whose residuals are large after the fast search.

    Args:
        charge_map: Map from contacts to charges.
        charge: Charges, shape (n, n_electrode), pC.
        sigma: Standard deviations of the noise of these charges, same shape, pC.
        source_presses: Presses from which the charges were made.
        is_near: Whether the charges of each row are near, shape (n,).
        find_nearest: Function for the thorough search; see `ExampleOptions.find_nearest`.

    Returns:
        Residuals (Q - Q(c)) / sigma, shape (n, n_electrode).
    """
    # Fast search for the near charges
    residual = np.zeros_like(charge)
    near_rows = np.flatnonzero(is_near)
    start_contact = source_presses.contact[near_rows]
    exact_factor = source_presses.charge[near_rows] / charge_map.charges(start_contact)
    map_factor = np.clip(exact_factor, 1.0 / LARGEST_FACTOR, LARGEST_FACTOR)
    # With the factor f of the map, the residual (Q - f Q(c)) / sigma is equal to (Q / f - Q(c)) / (sigma / f). The
    # charges and their standard deviations are therefore divided by f instead of scaling the map.
    _, residual[near_rows] = explain(
        charge_map, charge[near_rows] / map_factor, sigma[near_rows] / map_factor, start_contact, min_change=MIN_CHANGE
    )

    # Thorough search for the other charges, and for near charges with large residuals, which may be local minima
    has_large_residual = np.linalg.norm(residual, axis=1) > MAX_NEAR_MISFIT
    searched_rows = np.flatnonzero(~is_near | has_large_residual)
    _, searched_residual = find_nearest(charge_map, charge[searched_rows], sigma[searched_rows])

    # Keep the smaller of both residuals. Rows whose charges are not near have only the residual of the thorough search.
    near_residual = residual[searched_rows]
    near_is_smaller = (near_residual**2).sum(axis=1) < (searched_residual**2).sum(axis=1)
    keeps_near_residual = is_near[searched_rows] & near_is_smaller
    residual[searched_rows] = np.where(keeps_near_residual[:, None], near_residual, searched_residual)
    return residual


def draw_charges(
    rng: np.random.Generator, charge: Array, other_charge: Array, noise: Noise
) -> tuple[NDArray[Any], Array]:
    """For each press, choose a kind of charges at random, and make charges of this kind from those of the press.

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
    drawn_charge = np.empty_like(charge)
    for kind in KINDS:
        rows = kinds == kind
        drawn_charge[rows] = _draw_charges_of_kind(kind, rng, charge[rows], other_charge, noise)
    return kinds, drawn_charge


def _draw_charges_of_kind(
    kind: str, rng: np.random.Generator, charge: Array, other_charge: Array, noise: Noise
) -> Array:
    """From the charges of each press, make one set of charges of the given kind.

    Args:
        kind: Name of the kind; see `KINDS`.
        rng: Random number generator.
        charge: Charges of presses, shape (n, n_electrode), pC.
        other_charge: Charges of further presses, shape (m, n_electrode), pC.
        noise: Noise of good presses.

    Returns:
        Charges of this kind, shape (n, n_electrode), pC.
    """
    match kind:
        case "noisy":
            return noise.add(charge, rng)
        case "moved":
            return _move_charges(rng, charge, noise)
        case "gains":
            return charge * _draw_wrong_gains(rng, charge.shape)
        case "dying":
            return charge * _draw_failing_gains(rng, charge.shape)
        case "scaled":
            return charge * _draw_common_factors(rng, charge.shape)
        case "two":
            second_charge = other_charge[rng.integers(len(other_charge), size=len(charge))]
            exponent = rng.uniform(*PAIR_EXPONENTS, (len(charge), 1))
            return combined_charge(charge, second_charge, exponent)
        case _:  # the kind "any"
            return _draw_any_charges(rng, charge.shape, other_charge, noise)


def _move_charges(rng: np.random.Generator, charge: Array, noise: Noise) -> Array:
    """Move charges in random directions by random distances.

    Charges of any sign are moved by random multiples of the standard deviation of their noise. The factor of each press
    is log-uniform within `MOVED_LOG_DISTANCES`. Positive charges are multiplied by factors whose logarithms are
    normally distributed. The standard deviation of these logarithms is log-uniform within `MOVED_LOG_STDS`.

    Args:
        rng: Random number generator.
        charge: Charges, shape (n, n_electrode), pC.
        noise: Noise of good presses; a `ChannelNoise` for charges of any sign.

    Returns:
        Moved charges, same shape, pC.
    """
    one_per_press = (len(charge), 1)  # the shape of an array with one number for each press
    if isinstance(noise, ChannelNoise):
        # A level is a function of the charge; the noise of every level has the standard deviation 1. A distance between
        # levels is therefore a multiple of the noise.
        distance = 10.0 ** rng.uniform(*MOVED_LOG_DISTANCES, one_per_press)
        moved_level = noise.level(charge) + distance * rng.standard_normal(charge.shape)
        return noise.charge(moved_level)
    log_std = 10.0 ** rng.uniform(*MOVED_LOG_STDS, one_per_press)
    return np.asarray(charge * np.exp(log_std * rng.standard_normal(charge.shape)))


def _draw_wrong_gains(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw relative gains, shape (n, n_electrode). About half of the gains are wrong, and the others are 1."""
    is_wrong = rng.random(shape) < 0.5
    log_gain = np.where(is_wrong, WRONG_GAIN_STD * rng.standard_normal(shape), 0.0)
    return np.exp(log_gain)


def _draw_failing_gains(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw relative gains of the electrodes for each press, shape (n, n_electrode).

    One random electrode of each press has a gain between 0.001 and 1, and all other electrodes have the gain 1.

    Args:
        rng: Random number generator.
        shape: Shape of the result, (n, n_electrode).
    """
    n_press, n_electrode = shape
    failing_electrode = rng.integers(n_electrode, size=(n_press, 1))
    is_failing = failing_electrode == np.arange(n_electrode)  # shape (n_press, n_electrode)
    failing_gain = 10.0 ** rng.uniform(-3.0, 0.0, (n_press, 1))
    return np.where(is_failing, failing_gain, 1.0)


def _draw_common_factors(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw factors from about 0.01 to 100, shape (n, n_electrode). The factors of one press are nearly equal."""
    n_press, _ = shape
    common_factor = 10.0 ** rng.uniform(-2.0, 2.0, (n_press, 1))
    return np.asarray(common_factor * np.exp(COMMON_FACTOR_SCATTER * rng.standard_normal(shape)))


def _draw_any_charges(rng: np.random.Generator, shape: tuple[int, ...], other_charge: Array, noise: Noise) -> Array:
    """Draw random charges of each electrode from a wide range.

    For charges of any sign, the levels are uniformly distributed over a range twice as wide as that of the presses. A
    level is a function of the charge; the noise of every level has the standard deviation 1. For positive charges, the
    logarithms are uniformly distributed from 1 pC to an upper limit, which is larger for some presses.

    Args:
        rng: Random number generator.
        shape: Shape of the charges, (n, n_electrode).
        other_charge: Charges of presses, which determine the range for charges of any sign, shape (m, n_electrode), pC.
        noise: Noise of good presses; a `ChannelNoise` for charges of any sign.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    if isinstance(noise, ChannelNoise):
        level = noise.level(other_charge)
        lowest_level = level.min(axis=0)
        highest_level = level.max(axis=0)
        # With a margin on both sides, the range is twice as wide as that of the presses.
        margin = 0.5 * (highest_level - lowest_level)
        drawn_level = rng.uniform(lowest_level - margin, highest_level + margin, shape)
        return noise.charge(drawn_level)

    n_press, _ = shape
    has_large_limit = rng.random((n_press, 1)) < LARGE_BOX_FRACTION
    log_limit = np.where(has_large_limit, np.log10(HIGHEST_CHARGE), BOX_LOG_LIMIT)  # of each press, shape (n_press, 1)
    return 10.0 ** (log_limit * rng.random(shape))  # the exponents begin at 0, so the smallest charge is 1 pC


def combined_charge(first: Array, second: Array, exponent: Array | float) -> Array:
    """Approximate the charges of two simultaneous presses by (Q1^p + Q2^p)^(1/p).

    Q1 and Q2 are the charges that each press alone would cause. The power of a charge Q is defined as sign(Q) |Q|^p, so
    that it has the sign of the charge.

    Args:
        first: Charges of the first press alone, shape (n, n_electrode), pC.
        second: Charges of the second press alone, same shape.
        exponent: The exponent p, as one number or for each row, shape (n, 1).

    Returns:
        Charges of both presses, shape (n, n_electrode), pC.
    """
    sum_of_powers = _signed_power(first, exponent) + _signed_power(second, exponent)
    return _signed_power(sum_of_powers, 1.0 / exponent)


def _signed_power(charge: Array, exponent: Array | float) -> Array:
    """Raise the magnitude of each charge to a power, and keep the sign of the charge."""
    return np.asarray(np.sign(charge) * np.abs(charge) ** exponent)
