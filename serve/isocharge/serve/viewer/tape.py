"""The samples of a stream by number: the latest ones of a live stream, or all of a recording; and a place in that."""

import tempfile
from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.serve.viewer.messages import Pause, Play, ReplayRequest, Seek, Speed
from isocharge.serve.viewer.samples import Samples

LIVE_SAMPLES = 1 << 14
"""Samples that are kept of a live stream: 16 s at 1 kHz; a browser that is farther behind misses some."""

PIECES = 600
"""Largest number of pieces in the overview of a recording."""


class Tape:
    """The latest samples of a stream without end, in bounded memory.

    Attributes:
        total: Samples that ever came.
    """

    def __init__(self, dtype: "np.dtype[Any]", most: int = LIVE_SAMPLES) -> None:
        self.total = 0
        self._ring: Samples = np.zeros(most, dtype)

    @property
    def oldest(self) -> int:
        """Number of the oldest sample that is still there."""
        return max(0, self.total - len(self._ring))

    def append(self, samples: Samples) -> None:
        """Add samples, and forget as many old ones as need be."""
        latest = samples[-len(self._ring) :]
        first = self.total + len(samples) - len(latest)
        self._ring[np.arange(first, first + len(latest)) % len(self._ring)] = latest
        self.total += len(samples)

    def samples(self, start: int, stop: int) -> Samples:
        """Samples by number, those from `start` to before `stop` that are still there."""
        return self._ring[np.arange(max(start, self.oldest), stop) % len(self._ring)]

    def timestamp(self, number: int) -> float:
        """Time of a sample, unix seconds."""
        return float(self._ring[number % len(self._ring)]["timestamp"])

    def index(self, timestamp: float) -> int:
        """Number of the first sample after a time, unix seconds."""
        return bisect_right(range(self.total), timestamp, lo=self.oldest, key=self.timestamp)

    def span(self) -> tuple[float, float]:
        """Times of the oldest and the latest sample, unix seconds; zeros if there is none."""
        return (self.timestamp(self.oldest), self.timestamp(self.total - 1)) if self.total else (0.0, 0.0)

    def close(self) -> None:
        """Close the file, if there is one."""


class RecordedTape(Tape):
    """All samples of a recording, in a nameless file: a day of them needs no memory. Times never go back."""

    def __init__(self, dtype: "np.dtype[Any]") -> None:
        super().__init__(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._piece_s = 0.01
        self._force_N: list[float] = []
        self._map(LIVE_SAMPLES)

    def append(self, samples: Samples) -> None:
        """Add samples."""
        if not len(samples):
            return
        samples = samples.copy()
        times = np.maximum.accumulate(np.nan_to_num(samples["timestamp"], nan=0.0))
        samples["timestamp"] = np.maximum(times, self.span()[1])
        while self.total + len(samples) > len(self._ring):
            self._map(2 * len(self._ring))
        super().append(samples)
        self._note_forces(samples)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _map(self, most: int) -> None:
        """Make room for so many samples."""
        self._ring = np.memmap(self._file, self._ring.dtype, "r+", shape=(most,))

    def overview(self) -> list[float]:
        """Largest force in each of the equal pieces of the recording, N."""
        return [round(force, 3) for force in self._force_N]

    def _note_forces(self, samples: Samples) -> None:
        """Keep the largest force of each piece; two pieces become one where there would be too many."""
        elapsed_s = samples["timestamp"] - self.timestamp(0)
        while elapsed_s[-1] >= PIECES * self._piece_s:
            self._force_N = [max(self._force_N[k : k + 2]) for k in range(0, len(self._force_N), 2)]
            self._piece_s *= 2.0
        piece = (elapsed_s / self._piece_s).astype(int)
        self._force_N += [0.0] * (int(piece[-1]) + 1 - len(self._force_N))
        force_N = np.nan_to_num(samples["force_N"], nan=0.0)
        starts = np.flatnonzero(np.diff(piece, prepend=-1))
        for number, force in zip(piece[starts].tolist(), np.maximum.reduceat(force_N, starts).tolist(), strict=True):
            self._force_N[number] = max(self._force_N[number], force)


@dataclass
class Playhead:
    """Where a viewer is in a recording.

    Attributes:
        at_s: Time since the start of the recording, s.
        speed: Times the recorded pace.
        is_playing: Whether time goes on.
        has_jumped: Whether the viewer sought another place, and has nothing of it yet.
    """

    at_s: float = 0.0
    speed: float = 1.0
    is_playing: bool = True
    has_jumped: bool = True

    def advance(self, step_s: float, end_s: float, *, is_complete: bool) -> bool:
        """Let time go on.

        Args:
            step_s: Time that has passed, s.
            end_s: How far the recording is known, s.
            is_complete: Whether that is all of it.

        Returns:
            Whether the end has just been reached.
        """
        if not self.is_playing:
            return False
        self.at_s = min(self.at_s + step_s * self.speed, end_s)
        if is_complete and self.at_s >= end_s:
            self.is_playing = False
            return True
        return False

    def apply(self, request: ReplayRequest, end_s: float) -> None:
        """Do what the page asks for; at the end, playing begins anew."""
        match request:
            case Speed(value=value):
                self.speed = value
            case Seek(value=value):
                self.at_s, self.has_jumped = min(value, end_s), True
            case Pause():
                self.is_playing = False
            case Play():
                self.is_playing = True
                if self.at_s >= end_s:
                    self.at_s, self.has_jumped = 0.0, True

    def to_json(self) -> dict[str, float | bool]:
        """For the page."""
        return {"at_s": round(self.at_s, 3), "speed": self.speed, "is_playing": self.is_playing}
