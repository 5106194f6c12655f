"""Tapes, which store the samples of a stream under consecutive numbers.

A tape contains the latest samples of a live stream, or all samples of a recording.
"""

import tempfile
from bisect import bisect_right
from typing import Any

import numpy as np

from isocharge.serve.viewer.messages import Samples

LIVE_SAMPLES = 1 << 14
"""Number of stored samples of a live stream.

They cover 16 s at 1 kHz. A browser that falls further behind misses samples.
"""

MAX_PIECES = 600
"""Largest number of pieces in the overview of a recording."""

FIRST_PIECE_S = 0.01
"""Duration of a piece in the overview of a short recording, s.

The duration is doubled until at most `MAX_PIECES` pieces are needed.
"""


class Tape:
    """Ring buffer that stores the latest samples of a stream.

    Args:
        dtype: NumPy type of a sample.
        capacity: Number of samples that are stored.

    Attributes:
        total: Number of samples that were appended since the tape was created.
    """

    def __init__(self, dtype: "np.dtype[Any]", capacity: int = LIVE_SAMPLES) -> None:
        """Create a tape without samples. The docstring of the class describes the arguments."""
        self.total = 0
        self._ring: Samples = np.zeros(capacity, dtype)

    @property
    def oldest(self) -> int:
        """Number of the oldest stored sample."""
        return max(0, self.total - len(self._ring))

    def append(self, samples: Samples) -> None:
        """Append samples, shape (n,). If the buffer is full, the new samples replace the oldest samples."""
        capacity = len(self._ring)
        lasting_samples = samples[-capacity:]  # earlier samples would be overwritten at once
        new_total = self.total + len(samples)
        sample_numbers = np.arange(new_total - len(lasting_samples), new_total)
        self._ring[sample_numbers % capacity] = lasting_samples
        self.total = new_total

    def samples(self, start: int, stop: int) -> Samples:
        """Return the samples with the numbers from `start` to `stop` - 1, except those that were overwritten."""
        numbers = np.arange(max(start, self.oldest), stop)
        return self._ring[numbers % len(self._ring)]

    def timestamp(self, number: int) -> float:
        """Return the Unix time of the stored sample that has the given number, s."""
        return float(self._ring[number % len(self._ring)]["timestamp"])

    def first_number_after(self, time_s: float) -> int:
        """Return the number of the first stored sample after a given Unix time, s.

        If all stored samples are earlier, the result is the number of the next sample that will be appended.
        """
        numbers = range(self.total)
        return bisect_right(numbers, time_s, lo=self.oldest, key=self.timestamp)

    def span(self) -> tuple[float, float]:
        """Return the Unix times of the oldest and the latest stored sample, s. Without samples, return two zeros."""
        if not self.total:
            return 0.0, 0.0
        return self.timestamp(self.oldest), self.timestamp(self.total - 1)

    def close(self) -> None:
        """Close the file of the samples if the tape has a file."""


class RecordedTape(Tape):
    """Tape that stores all samples of a recording in a temporary file.

    If the time of a sample is earlier than the time of the previous sample, the previous time is stored instead.
    """

    def __init__(self, dtype: "np.dtype[Any]") -> None:
        """Create the temporary file and an empty overview of the forces.

        The overview divides the recording into pieces of equal duration, and contains the largest force in each piece.

        Args:
            dtype: NumPy type of a sample.
        """
        super().__init__(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._piece_s = FIRST_PIECE_S  # duration of a piece
        self._max_force_N: list[float] = []
        self._map_file(LIVE_SAMPLES)

    def append(self, samples: Samples) -> None:
        """Append samples, and update the overview.

        If a time is missing or is earlier than the previous time, the previous time is stored instead. The stored times
        therefore never decrease. If the samples do not fit into the mapped file, the capacity of the file is doubled
        until they fit.

        Args:
            samples: The samples, shape (n,).
        """
        if not len(samples):
            return
        ordered = samples.copy()
        _, latest_stored_s = self.span()  # 0 if no sample is stored yet
        times_s = np.nan_to_num(samples["timestamp"], nan=0.0)  # a missing time becomes 0, which is never the largest
        largest_so_far_s = np.maximum.accumulate(times_s)
        ordered["timestamp"] = np.maximum(largest_so_far_s, latest_stored_s)
        while self.total + len(ordered) > len(self._ring):
            self._map_file(2 * len(self._ring))
        super().append(ordered)
        self._update_overview(ordered)

    def close(self) -> None:
        """Close the temporary file, so that the operating system removes it."""
        self._file.close()

    def _map_file(self, capacity: int) -> None:
        """Map the file to memory, with a size of `capacity` samples. The stored samples are unchanged."""
        self._ring = np.memmap(self._file, self._ring.dtype, "r+", shape=(capacity,))

    def overview(self) -> list[float]:
        """Return the largest force in each piece of the recording, N. All pieces have the same duration."""
        return [round(force_N, 3) for force_N in self._max_force_N]

    def _update_overview(self, samples: Samples) -> None:
        """Update the largest force in each piece of the recording with the forces of new samples.

        The number of pieces is limited to `MAX_PIECES`. When a longer recording needs more pieces, neighbouring pieces
        are joined in pairs, and the duration of a piece is doubled.

        Args:
            samples: New samples, shape (n,), whose times do not decrease.
        """
        elapsed_s = samples["timestamp"] - self.timestamp(0)  # time since the first sample of the recording
        while elapsed_s[-1] >= MAX_PIECES * self._piece_s:
            self._join_pieces()

        # Append new pieces up to the piece that contains the last sample.
        piece_of_sample = (elapsed_s / self._piece_s).astype(int)  # index of the piece that contains each sample
        piece_count = int(piece_of_sample[-1]) + 1
        new_piece_count = piece_count - len(self._max_force_N)  # may be 0
        self._max_force_N += [0.0] * new_piece_count

        # Compute the largest force of the samples in each piece. These samples are neighbours, because the times do not
        # decrease. They are called a run here. `reduceat` computes the largest force of every run in one call.
        force_N = np.nan_to_num(samples["force_N"], nan=0.0)
        begins_run = np.diff(piece_of_sample, prepend=-1) != 0  # True for the first sample, because no piece is -1
        run_starts = np.flatnonzero(begins_run)
        run_pieces = piece_of_sample[run_starts].tolist()
        run_max_N = np.maximum.reduceat(force_N, run_starts).tolist()

        # A piece may contain earlier samples, so the larger one of the earlier and the new force is stored.
        for piece, max_force_N in zip(run_pieces, run_max_N, strict=True):
            self._max_force_N[piece] = max(self._max_force_N[piece], max_force_N)

    def _join_pieces(self) -> None:
        """Join neighbouring pieces of the overview in pairs, and double the duration of a piece.

        If the number of pieces is odd, the last piece remains alone.
        """
        pairs = [self._max_force_N[first : first + 2] for first in range(0, len(self._max_force_N), 2)]
        self._max_force_N = [max(pair) for pair in pairs]
        self._piece_s *= 2.0
