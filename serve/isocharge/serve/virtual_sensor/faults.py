"""Faults between board and reader, on request: lost frames, damaged bytes, gaps, unplugging, clock drift."""

from dataclasses import dataclass

import numpy as np

from isocharge.common.errors import SceneError


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults of a virtual sensor; by default it has no fault.

    Attributes:
        lose_share: Share of frames that are not sent, dimensionless.
        corrupt_share: Share of bytes that are flipped, dropped or followed by a random one, dimensionless.
        gap_every_s, gap_s: Interval and length of the gaps in which nothing is sent, s; interval 0 for no gaps.
        unplug_every_s, unplug_s: Interval and length of the outages of the port, s; interval 0 for no outages.
        clock_ppm: Excess of the device's clock rate over the true one, parts per million.
    """

    lose_share: float = 0.0
    corrupt_share: float = 0.0
    gap_every_s: float = 0.0
    gap_s: float = 0.1
    unplug_every_s: float = 0.0
    unplug_s: float = 0.5
    clock_ppm: float = 0.0

    def __post_init__(self) -> None:
        shares = 0.0 <= self.lose_share <= 1.0 and 0.0 <= self.corrupt_share <= 1.0
        times = min(self.gap_every_s, self.gap_s, self.unplug_every_s, self.unplug_s) >= 0.0
        if not (shares and times and abs(self.clock_ppm) < 1e6):
            raise SceneError(f"faults: expected shares from 0 to 1 and times from 0, got {self}")

    def in_gap(self, t_s: float) -> bool:
        """Whether nothing is sent at this time, s from the start; the first gap comes after one interval."""
        return self.gap_every_s > 0.0 and t_s >= self.gap_every_s and t_s % self.gap_every_s < self.gap_s

    def unplugged(self, t_s: float) -> bool:
        """Whether the port is away at this time, s from the start."""
        return self.unplug_every_s > 0.0 and t_s >= self.unplug_every_s and t_s % self.unplug_every_s < self.unplug_s


def corrupt(data: bytes, share: float, rng: np.random.Generator) -> bytes:
    """Damage a share of bytes: a third each is flipped in one bit, dropped, or followed by a random byte."""
    positions = np.flatnonzero(rng.random(len(data)) < share)
    if not positions.size:
        return data
    damaged = [bytes([byte]) for byte in data]
    for position in positions.tolist():
        kind, extra = int(rng.integers(3)), int(rng.integers(256))
        flipped = bytes([data[position] ^ 1 << extra % 8])
        damaged[position] = (flipped, b"", bytes([data[position], extra]))[kind]
    return b"".join(damaged)
