"""Description of a press that is held during the port check.

The description states whether the charge of the press is constant, leaks, creeps or drifts.

The gain of the board may be unknown. A press is therefore not recognised by a charge in pC, but by the first large
change of the channels within 0.2 s. The charge of the press is the projection of the channel values onto the direction
of this change, minus the rest level before the press. A rest level that drifts is extrapolated along a straight line.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.live.fading import law_of_fading

BLOCK_S = 0.1
"""Time over which values are averaged, s."""

MIN_REST_S = 1.0
"""Shortest rest before the press, s."""

SETTLE_S = 0.5
"""Time after the step that is left out, s, because the force is still changing."""

MIN_HELD_S = 4.0
"""Shortest time for which the press must be held afterwards, s."""

STEP_RATIO = 20.0
"""Smallest size of the step of a press, as a multiple of the usual change, dimensionless."""

RELEASE_SHARE = 0.3
"""Share of the step by which the charge must fall at once when the press ends, dimensionless."""

STEADY_SHARE = 0.02
"""Largest relative change of the charge of a steady press, dimensionless."""

DRIFT_SIGMAS = 4.0
"""Slope above which the rest level is assumed to drift, in standard errors of the slope."""

LEARNING_TAU_s = 1e5
"""Time constant for `[leak]` that corrects no leak, s. The stage still estimates the drift at rest and removes it."""


SMALLEST_SIZE = 1e-30
"""Lower limit for the size of a step, in any unit, which avoids a division by zero if the channels never change."""

END_BLOCKS = 5
"""Number of blocks at the beginning and at the end of a press whose means are compared."""


@dataclass(frozen=True)
class HeldPress:
    """A press that was held during the port check, and settings that correct the change of its charge.

    Attributes:
        begin_s: Time at which the press began, s since the first frame.
        sections: Sections for a device file, as tables by name.
        description: Sentence that describes whether and how the charge of the press changes.
    """

    begin_s: float
    sections: dict[str, dict[str, float]]
    description: str


def find_held_press(values: Array, times_s: Array) -> HeldPress | None:
    """Find a press that is held for at least `MIN_HELD_S`, and describe how its charge changes.

    The values are averaged over blocks of time. The press begins with the first large step between the blocks. The film
    must be at rest before the press, and the step must be much larger than the usual change between blocks.

    The step is a vector with one change for each channel. The values of all channels are combined into one component,
    which is their projection onto the direction of the step.

    Args:
        values: Values of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.

    Returns:
        The press; None if no such press is found.
    """
    min_duration_s = MIN_REST_S + SETTLE_S + MIN_HELD_S
    levels = _block_means(values, times_s)
    if levels is None or len(levels) * BLOCK_S < min_duration_s:
        return None

    # Find the indices of the blocks in which the force rises (begin), becomes constant (settled), and falls (end). The
    # force rises in the block between the two blocks of the step.
    step = _find_step(levels)
    settled_block = step.begin_block + round(SETTLE_S / BLOCK_S)
    end_block = _end_of_press(step.component, settled_block, step.size)
    has_rest = step.rest_blocks * BLOCK_S >= MIN_REST_S
    is_long = (end_block - settled_block) * BLOCK_S >= MIN_HELD_S
    if not (step.is_large and has_rest and is_long):
        return None

    # Subtract the rest level from the component. The difference is the charge of the press in each block.
    block_times_s = BLOCK_S * (np.arange(len(step.component)) + 0.5)  # middle of each block
    rest_level, drift_per_s = _extrapolate_rest(step.component, block_times_s, step.rest_blocks, step.size)
    press_charge = step.component - rest_level

    # Describe how this charge changes while the force is constant. A drift of the rest level is described separately.
    begin_s = BLOCK_S * step.begin_block
    held_times_s = block_times_s[settled_block:end_block] - begin_s
    description, sections = _describe(held_times_s, press_charge[settled_block:end_block])
    if drift_per_s != 0.0:
        description, sections = _with_drift(description, sections, percent_per_s=100.0 * drift_per_s / step.size)
    return HeldPress(begin_s, sections, description)


class _Step(NamedTuple):
    """Step of the channels at the beginning of a press.

    Attributes:
        rest_blocks: Number of blocks at rest before the press.
        begin_block: Index of the block in which the force rises.
        size: Euclidean norm of the change of the channels, in the unit of the channels.
        is_large: Whether the step is much larger than the usual change of the channels.
        component: Mean of each block along the direction of the change, shape (blocks,), in the unit of the channels.
    """

    rest_blocks: int
    begin_block: int
    size: float
    is_large: bool
    component: Array


def _find_step(levels: Array) -> _Step:
    """Find the step at the beginning of a press: the first change that is larger than half of the largest change.

    A change is the difference between two blocks with one block between them, because the force of a press rises during
    a part of one block. The press begins in this middle block.

    Args:
        levels: Mean of each channel in each block of time, shape (blocks, channels), any unit.

    Returns:
        The step, its position among the blocks, and the projection of all blocks onto its direction.
    """
    changes = levels[2:] - levels[:-2]  # change i is from block i to block i + 2; shape (blocks - 2, channels)
    change_sizes = np.linalg.norm(changes, axis=1)
    is_step = change_sizes > 0.5 * change_sizes.max()
    block_before = int(np.argmax(is_step))  # index of the first True: the last block before the force rises
    size = float(change_sizes[block_before])
    is_large = bool(size >= STEP_RATIO * np.median(change_sizes))

    # Project the levels onto the direction of the step, a unit vector of shape (channels,).
    direction = changes[block_before] / max(size, SMALLEST_SIZE)  # no division by zero if the channels never change
    return _Step(
        rest_blocks=block_before,  # does not include block_before itself, at whose end the force may begin to rise
        begin_block=block_before + 1,
        size=size,
        is_large=is_large,
        component=levels @ direction,
    )


def _extrapolate_rest(
    component: Reals, block_times_s: Reals, rest_blocks: int, step_size: float
) -> tuple[Reals, float]:
    """Extrapolate the rest level from the time before a press to the time of the press.

    A straight line is fitted to the blocks before the press. The line is used if its slope is significant and so large
    that it would affect the description of the press. If the line is not used, the rest level is the mean of the blocks
    before the press.

    Args:
        component: Mean of each block, projected onto the change of the channels by the press, shape (blocks,), any
            unit.
        block_times_s: Middle of each block, shape (blocks,), s.
        rest_blocks: Number of blocks before the press.
        step_size: Change of the component when the press begins, in the unit of the component.

    Returns:
        The rest level in each block, shape (blocks,), and the slope of the rest level per second, which is 0 if the
        mean is used.
    """
    rest_component = component[:rest_blocks]
    rest_times_s = block_times_s[:rest_blocks]
    (slope_per_s, intercept), covariance = np.polyfit(rest_times_s, rest_component, deg=1, cov=True)
    slope_std = np.sqrt(covariance[0, 0])
    is_significant = abs(slope_per_s) > DRIFT_SIGMAS * slope_std
    # During a held press, the drift would be mistaken for a change of the charge of the press.
    is_disturbing = abs(slope_per_s) * MIN_HELD_S > STEADY_SHARE * step_size
    if is_significant and is_disturbing:
        return intercept + slope_per_s * block_times_s, float(slope_per_s)
    return np.full(len(component), rest_component.mean()), 0.0


def _block_means(values: Array, times_s: Array) -> Array | None:
    """Compute the mean of each channel over each block of time of the length `BLOCK_S`.

    The last block is left out, because it may be incomplete.

    Args:
        values: Values of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.

    Returns:
        Means, shape (blocks, channels); None if a value is not finite, or a block has no value.
    """
    if not np.isfinite(values).all():
        return None
    block_numbers = (times_s / BLOCK_S).astype(int)  # number of the block of each value
    counts = np.bincount(block_numbers)[:-1]  # number of values in each block, without the last block
    if not counts.all():
        return None
    sums = np.zeros((len(counts), values.shape[1]))  # shape (blocks, channels)
    for channel, channel_values in enumerate(values.T):
        sums[:, channel] = np.bincount(block_numbers, weights=channel_values)[:-1]  # adds up the values of each block
    return np.asarray(sums / counts[:, np.newaxis])


def _end_of_press(component: Array, settled_block: int, step_size: float) -> int:
    """Return the index of the block before which the held part of a press ends.

    The press ends when the component first falls by a large part of the step within two blocks. If the component never
    falls by so much, the press is held to the end, and the result is the total number of blocks.

    Args:
        component: Mean of each block, projected onto the change of the channels by the press, shape (blocks,).
        settled_block: Index of the first block in which the force is constant.
        step_size: Change of the component when the press begins.
    """
    held_component = component[settled_block:]
    changes = held_component[2:] - held_component[:-2]  # from each block to the second block after it
    is_release = changes < -RELEASE_SHARE * step_size
    releases = np.flatnonzero(is_release)  # indices within `held_component`
    if releases.size == 0:
        return len(component)
    return settled_block + int(releases[0])


def _with_drift(
    description: str, sections: dict[str, dict[str, float]], percent_per_s: float
) -> tuple[str, dict[str, dict[str, float]]]:
    """Add a drift of the rest level to the description and to the sections of a press.

    The section `[leak]` of a device file has two effects. It corrects an exponential loss of charge with the time
    constant `tau_s`, and it removes a drift at rest.

    - Without a section `[leak]`, the press does not lose charge exponentially. The section is then added in order to
      remove the drift. Its `tau_s` is so large that no loss of charge is corrected.
    - A given section `[leak]` is kept. Because the drift may have falsified its `tau_s`, the user is asked to measure
      again without a drift.

    Args:
        description: Description of the press, a sentence.
        sections: Sections for a device file, as tables by name.
        percent_per_s: Drift of the rest level in percent of the press per second.

    Returns:
        The completed description, and the completed sections.
    """
    if "leak" in sections:
        remedy = "do not touch the film until the drift has ended, and measure again"
        completed_sections = sections
    else:
        remedy = f"[leak] tau_s = {LEARNING_TAU_s:g} in a device file measures the drift at rest and subtracts it"
        completed_sections = {"leak": {"tau_s": LEARNING_TAU_s}, **sections}
    sentence = f"the rest level drifts by {percent_per_s:.2g} % of the press per second; {description}; {remedy}"
    return sentence, completed_sections


def _describe(held_times_s: Reals, press_charge: Reals) -> tuple[str, dict[str, dict[str, float]]]:
    """Describe how the charge of a press changes: whether it is constant, leaks, creeps, or follows no clear law.

    A leak is an exponential loss of charge in the amplifier. Creep is a decrease of the charge of the film in
    proportion to the logarithm of time. A drift of the rest level has already been subtracted from the charge.

    Args:
        held_times_s: Times since the beginning of the press, shape (n,), s.
        press_charge: Charge of the press at these times, shape (n,), any unit.

    Returns:
        A sentence, and sections for a device file, as tables by name; empty if no setting is needed or known.
    """
    # Means over some blocks at the beginning and at the end have less noise than single blocks.
    first_charge = press_charge[:END_BLOCKS].mean()
    last_charge = press_charge[-END_BLOCKS:].mean()
    lost_share = 1.0 - float(last_charge / first_charge)
    if abs(lost_share) < STEADY_SHARE:
        return f"a held press keeps its charge for {held_times_s[-1]:.0f} s", {}

    positive_charge = np.maximum(press_charge, 1e-9)  # the law is fitted to the logarithm of the charge
    times_and_charges = list(zip(held_times_s.tolist(), positive_charge.tolist(), strict=True))
    law = law_of_fading(times_and_charges)
    if law.tau_s is not None:
        return f"a held press leaks: {law.settings} in a device file corrects the leak", law.sections
    if law.creep is not None:
        sentence = (
            f"a held press creeps by {100.0 * law.creep:.2g} % in each decade of time: this is a property of the film, "
            f"so set no [leak] for it, and {law.creep_remedy}"
        )
        return sentence, law.sections
    sentence = (
        f"a held press changes by {-100.0 * lost_share:.2g} % in {held_times_s[-1]:.0f} s and follows no clear law: "
        "hold a press longer, with a weight"
    )
    return sentence, {}
