"""Many samples as few: what a browser can show of them."""

from itertools import pairwise
from typing import Any

import numpy as np

from isocharge.serve.viewer.sample import CONTACT_BIT

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in their order, shape (n,), of a `SampleFormat`."""


def coalesce(samples: Samples, most: int) -> Samples:
    """At most `most` samples that stand for all: each for a run of neighbours.

    Of a run, the newest sample counts if it is a contact, else the hardest press: a tap between two pictures is shown.
    Flags are those of the whole run, the latency its largest, and `records` add up.

    Args:
        samples: Shape (n,).
        most: At least 1.
    """
    if len(samples) <= most:
        return samples
    edges = np.linspace(0, len(samples), most + 1).astype(int)
    shown: Samples = samples[_shown_of_runs(samples, edges)]
    starts = edges[:-1]
    contact = shown["flags"] & CONTACT_BIT
    shown["flags"] = np.bitwise_or.reduceat(samples["flags"], starts) & ~np.uint32(CONTACT_BIT) | contact
    shown["records"] = np.add.reduceat(samples["records"], starts)
    shown["latency_us"] = np.fmax.reduceat(samples["latency_us"], starts)
    return shown


def _shown_of_runs(samples: Samples, edges: np.ndarray) -> np.ndarray:
    """The position of the sample that is shown of each run, shape (runs,)."""
    touching = (samples["flags"] & CONTACT_BIT) != 0
    force = np.where(touching, np.nan_to_num(samples["force_N"], nan=0.0), -1.0)
    last = edges[1:] - 1
    hardest = np.array([start + int(force[start:stop].argmax()) for start, stop in pairwise(edges)])
    missed_tap = ~touching[last] & touching[hardest]
    return np.where(missed_tap, hardest, last)
