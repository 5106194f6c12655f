"""Description of a press that is held during the port check.

The description states whether the charge of the press is constant, leaks, creeps or drifts.

A press is recognised by a change of the channels that is large compared with their noise, because the gain of the board
may be unknown. The charge of the press is the projection of the channel levels onto the direction of this change, minus
the rest level before the press. A rest level that drifts is extrapolated along a straight line.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.examination.press_detector import BLOCK_S, PressDetector, block_medians, channel_noise
from isocharge.serve.live.fading import law_of_fading

MIN_REST_S = 1.0
"""Shortest rest before the press, s."""

SETTLE_S = 0.5
"""Time after the step that is left out, s, because the force is still changing."""

MIN_HELD_S = 4.0
"""Shortest time for which the press must be held afterwards, s."""

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

    The levels of all channels in each block of time are combined into one component, which is their projection onto the
    change of the channels by the press.

    Args:
        values: Values of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.

    Returns:
        The press; None if no such press is found.
    """
    levels = block_medians(values, times_s)  # shape (blocks, channels)
    if not np.isfinite(levels).all():
        return None
    noise = np.array([channel_noise(column) for column in values.T])
    detector = PressDetector()
    end_block = len(levels)  # number of blocks before the end of the press
    for number, level in enumerate(levels):
        if detector.feed(level, noise):
            end_block = number - 1  # the force may have begun to fall in the block before
            break
    if detector.begin_block is None:
        return None

    begin_block = detector.begin_block
    settled_block = begin_block + round(SETTLE_S / BLOCK_S)  # the force is constant from here on
    rest_blocks = begin_block - 1  # the force may have begun to rise in the block before
    has_rest = rest_blocks * BLOCK_S >= MIN_REST_S
    is_long = (end_block - settled_block) * BLOCK_S >= MIN_HELD_S
    if not (has_rest and is_long):
        return None

    # Subtract the rest level from the component. The difference is the charge of the press in each block.
    step = levels[settled_block] - levels[rest_blocks - 1]
    step_size = max(float(np.linalg.norm(step)), SMALLEST_SIZE)
    component = levels @ step / step_size
    block_times_s = BLOCK_S * (np.arange(len(component)) + 0.5)  # middle of each block
    rest_level, drift_per_s = _extrapolate_rest(component, block_times_s, rest_blocks, step_size)
    press_charge = component - rest_level

    # Describe how this charge changes while the force is constant. A drift of the rest level is described separately.
    begin_s = BLOCK_S * begin_block
    held_times_s = block_times_s[settled_block:end_block] - begin_s
    description, sections = _describe(held_times_s, press_charge[settled_block:end_block])
    if drift_per_s != 0.0:
        description, sections = _with_drift(description, sections, percent_per_s=100.0 * drift_per_s / step_size)
    return HeldPress(begin_s, sections, description)


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
