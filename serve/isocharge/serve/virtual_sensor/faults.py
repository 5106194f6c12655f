"""What goes wrong between board and reader, on demand: lost frames, damaged bytes, gaps, unplugging, clock drift."""

from dataclasses import dataclass

import numpy as np

from isocharge.errors import SceneError


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults of a virtual sensor; none by default.

    Attributes:
        lose_share: Share of frames that are not sent.
        corrupt_share: Share of bytes that are flipped, dropped or followed by a random one.
        gap_every_s, gap_s: So often nothing is sent, for so long, s; 0 for never.
        unplug_every_s, unplug_s: So often the port vanishes, for so long, s; 0 for never.
        clock_ppm: How much faster the device's clock runs, parts per million.
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
        """Whether nothing is sent at this time, s from the beginning; the first gap comes after one interval."""
        return self.gap_every_s > 0.0 and t_s >= self.gap_every_s and t_s % self.gap_every_s < self.gap_s

    def unplugged(self, t_s: float) -> bool:
        """Whether the port is gone at this time, s from the beginning."""
        return self.unplug_every_s > 0.0 and t_s >= self.unplug_every_s and t_s % self.unplug_every_s < self.unplug_s


def corrupt(data: bytes, share: float, rng: np.random.Generator) -> bytes:
    """Bytes of which a share is flipped in one bit, dropped, or followed by a random one, a third each."""
    hit = np.flatnonzero(rng.random(len(data)) < share)
    if not hit.size:
        return data
    damaged = [bytes([byte]) for byte in data]
    for at in hit.tolist():
        kind, extra = int(rng.integers(3)), int(rng.integers(256))
        bit = bytes([data[at] ^ 1 << extra % 8])
        damaged[at] = (bit, b"", bytes([data[at], extra]))[kind]
    return b"".join(damaged)
