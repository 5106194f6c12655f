"""A press that is held while a board is listened to: whether its charge stays, leaks, creeps, or drifts as at rest.

Nothing is known of the board yet, so a press is no level in pC. It is the first of the largest steps that the channels
make within two tenths of a second; its size is what they show along that step, above the straight line of the rest
before it.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.serve.live.fading import law_of_fading

BLOCK_S = 0.1
"""Time over which values are averaged, s."""

LEAST_REST_S, SETTLE_S, LEAST_HELD_S = 1.0, 0.5, 4.0
"""Rest before the press that is needed; time after the step that does not count; time from there on, s."""

STEP = 20.0
"""Size of a step over the usual one from which it is a press, dimensionless."""

STEADY = 0.02
"""Share of its charge that a press may lose or gain and still have kept it, dimensionless."""

DRIFT_SIGMAS = 4.0
"""Slope of the rest from which it drifts, in its standard errors."""

LEARNS_S = 1e5
"""A time constant that undoes nothing, s: the stage `[leak]` still learns the drift at rest, and takes it off."""


@dataclass(frozen=True)
class HeldPress:
    """What a held press says.

    Attributes:
        begin_s: When it began, s since the first frame.
        sections: What to put into a device file.
        says: A sentence.
    """

    begin_s: float
    sections: dict[str, dict[str, float]]
    says: str


def held_press(values: Array, t_s: Array) -> HeldPress | None:
    """The press in what came, None if none was held for `LEAST_HELD_S`.

    Args:
        values: Shape (n, channels), in any unit.
        t_s: Times from the first frame on, shape (n,), s.
    """
    blocks = (t_s / BLOCK_S).astype(int)
    count = np.bincount(blocks)[:-1]  # the last one may not be whole
    if len(count) * BLOCK_S < LEAST_REST_S + SETTLE_S + LEAST_HELD_S or not (count.all() and np.isfinite(values).all()):
        return None
    mean = np.stack([np.bincount(blocks, column)[:-1] for column in values.T], axis=1) / count[:, None]
    step = mean[2:] - mean[:-2]
    size = np.linalg.norm(step, axis=1)
    first = int(np.argmax(size > 0.5 * size.max()))
    along = mean @ (step[first] / max(size[first], 1e-30))
    begin, settled = first + 1, first + 1 + round(SETTLE_S / BLOCK_S)
    leaves = np.flatnonzero(along[settled + 2 :] - along[settled:-2] < -0.3 * size[first])
    held = slice(settled, settled + int(leaves[0]) if leaves.size else len(along))
    at_s = BLOCK_S * (np.arange(len(along)) + 0.5)
    if (
        size[first] < STEP * np.median(size)
        or first * BLOCK_S < LEAST_REST_S
        or (held.stop - settled) * BLOCK_S < LEAST_HELD_S
    ):
        return None
    (slope, level), spread = np.polyfit(at_s[:first], along[:first], 1, cov=True)
    drifts = abs(slope) > DRIFT_SIGMAS * np.sqrt(spread[0, 0]) and abs(slope) * LEAST_HELD_S > STEADY * size[first]
    rest = level + slope * at_s if drifts else np.full(len(along), along[:first].mean())
    says, sections = _words(at_s[held] - BLOCK_S * begin, (along - rest)[held])
    if drifts:
        remedy = f"[leak] tau_s = {LEARNS_S:g} in a device file lets the drift be learned at rest and taken off"
        if "leak" in sections:
            remedy = "leave the board alone until the rest stands still, and measure again"
        says = f"the rest drifts, by {100.0 * slope / size[first]:.2g} % of the press in a second; {says}; {remedy}"
        sections = {"leak": {"tau_s": LEARNS_S}} | sections
    return HeldPress(BLOCK_S * begin, sections, says)


def _words(held_s: Reals, size: Reals) -> tuple[str, dict[str, dict[str, float]]]:
    """What a press does beside any drift, and what to put into a device file."""
    lost = 1.0 - float(size[-5:].mean() / size[:5].mean())
    if abs(lost) < STEADY:
        return f"a held press keeps its charge for {held_s[-1]:.0f} s", {}
    law = law_of_fading(list(zip(held_s.tolist(), np.maximum(size, 1e-9).tolist(), strict=True)))
    if law.tau_s is not None:
        tau_s = float(f"{law.tau_s:.2g}")
        return f"a held press leaks: [leak] tau_s = {tau_s:g} in a device file undoes it", {"leak": {"tau_s": tau_s}}
    if law.creep is not None:
        return (
            f"a held press creeps by {100.0 * law.creep:.2g} % in each decade of time: the film does, so set no [leak] "
            f"for it, and {law.remedy}",
            {} if law.memory is None else {"memory": law.memory},
        )
    return (
        f"a held press changes by {-100.0 * lost:.2g} % in {held_s[-1]:.0f} s, by no law that is clear: hold one "
        "longer, with a weight",
        {},
    )
