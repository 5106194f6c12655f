"""What a sweep reports while it works."""

import warnings
from dataclasses import dataclass

from isocharge.common.progress import Progress, Warn


@dataclass(frozen=True)
class SweepCallbacks:
    """Functions that a sweep calls while it works.

    Attributes:
        solved: Called with (done, total) distances and orientations of a probe, each of them solved for all forces.
        sampled: Called with (done, total) samples.
        warn: Called with a sentence if a part of an earlier run is damaged; the part is computed again.
    """

    solved: Progress | None = None
    sampled: Progress | None = None
    warn: Warn = warnings.warn
