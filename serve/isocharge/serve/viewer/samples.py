"""A prediction record as a sample of fixed size: what goes to the process of the page, and on to browsers.

Many samples are coalesced to as few as a browser can show.

    offset 0   timestamp, unix seconds, f64
           8   x_mm, y_mm, force_N, x_std_mm, y_std_mm, force_std_N, misfit, latency_us, f32 each
          40   flags, u32: a bit for each word of `isocharge.serve.flags`, the highest one for contact
          44   number of records that the sample stands for, u32
          48   touch charges, pC, f32 for each electrode; zeros up to a multiple of eight bytes

All little-endian; what is unknown is NaN.
"""

import math
import struct
from itertools import pairwise
from typing import Any

import numpy as np

from isocharge.serve.flags import MEANINGS
from isocharge.serve.prediction.record import PredictionRecord

NUMBERS = ("x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N", "misfit", "latency_us")
"""Fields of a record that a sample has as numbers."""

FLAG_BITS = {word: 1 << position for position, word in enumerate(MEANINGS)}
"""The bit of each word."""

CONTACT_BIT = 1 << 31

LARGEST = float(np.finfo(np.float32).max)

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in their order, shape (n,), of a `SampleFormat`."""


class SampleFormat:
    """Samples of a sensor with these electrodes.

    Attributes:
        electrodes: Their names, in the order of the charges.
        dtype: A sample as a NumPy record.
    """

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Lay the sample out."""
        self.electrodes = electrodes
        count = len(electrodes)
        padding = -4 * count % 8
        self._struct = struct.Struct(f"<d{len(NUMBERS)}fII{count}f{padding}x")
        numbers = [(name, "<f4") for name in NUMBERS]
        counts = [("flags", "<u4"), ("records", "<u4")]
        fields: list[Any] = [("timestamp", "<f8"), *numbers, *counts, ("charge_pC", "<f4", (count,))]
        self.dtype = np.dtype([*fields, ("padding", f"V{padding}")] if padding else fields)

    def pack(self, record: PredictionRecord) -> bytes:
        """A record as a sample."""
        bits = CONTACT_BIT if record.contact else 0
        for word in record.flags:
            bits |= FLAG_BITS[word]
        charges = record.charge_pC or {}
        values = [getattr(record, name) for name in NUMBERS]
        numbers = [math.nan if value is None else value for value in values]
        charge_pC = [math.nan if (q := charges.get(name)) is None else q for name in self.electrodes]
        timestamp = math.nan if record.timestamp is None else record.timestamp
        try:
            return self._struct.pack(timestamp, *numbers, bits, 1, *charge_pC)
        except OverflowError:  # a number that no float32 can hold
            clipped = [[min(max(value, -LARGEST), LARGEST) for value in part] for part in (numbers, charge_pC)]
            return self._struct.pack(timestamp, *clipped[0], bits, 1, *clipped[1])


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
