"""Tape, which stores the samples of a stream under consecutive numbers."""

import tempfile
from bisect import bisect_right
from typing import Any

import numpy as np

from isocharge.serve.viewer.samples import Samples

LIVE_SAMPLES = 1 << 14
"""Number of stored samples of a live stream.

They cover 16 s at 1 kHz. A browser that falls further behind misses samples.
"""

RATE_SAMPLES = 400
"""Number of the latest samples from whose times the frame rate of the board is computed."""

OVERVIEW_PIECES = 600
"""Number of pieces of equal duration into which the overview divides a recording."""


class Tape:
    """Ring buffer that stores the latest samples of a live stream.

    One thread appends samples. Any other thread may read samples at the same time.

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

    def append(self, values: tuple[float | None, ...]) -> None:
        """Append a sample. If the buffer is full, the sample replaces the oldest sample.

        Args:
            values: The numbers of the sample in the order of its type. None is stored as NaN.
        """
        self._ring[self.total % len(self._ring)] = values
        self.total += 1

    def samples(self, start: int, stop: int) -> Samples:
        """Return the samples with the numbers from `start` to `stop` - 1, except those that were overwritten."""
        numbers = np.arange(max(start, self.oldest), stop)
        samples: Samples = self._ring[numbers % len(self._ring)]
        return samples[numbers >= self.oldest]  # samples may have been appended while the others were copied

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

    def rate_Hz(self) -> float | None:
        """Compute the frame rate, Hz, from the times of the latest samples. Return None if the rate is unknown."""
        times_s = self.samples(self.total - RATE_SAMPLES, self.total)["timestamp"]
        if len(times_s) < 2 or not times_s[-1] > times_s[0]:  # also if a time is NaN
            return None
        return float((len(times_s) - 1) / (times_s[-1] - times_s[0]))

    def close(self) -> None:
        """Close the file of the samples if the tape has a file."""


class RecordedTape(Tape):
    """Tape that stores all samples of a recording in a temporary file.

    If the time of a sample is missing or is earlier than the time of the previous sample, the previous time is stored
    instead. The stored times therefore never decrease.
    """

    def __init__(self, dtype: "np.dtype[Any]") -> None:
        """Create the temporary file.

        Args:
            dtype: NumPy type of a sample.
        """
        super().__init__(dtype)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._map_file(LIVE_SAMPLES)

    def append(self, values: tuple[float | None, ...]) -> None:
        """Append a sample. If the mapped file is full, its capacity is doubled."""
        if self.total == len(self._ring):
            self._map_file(2 * len(self._ring))
        number = self.total
        previous_time_s = self.timestamp(number - 1) if number else 0.0
        self._ring[number] = values
        self._ring["timestamp"][number] = np.fmax(self._ring["timestamp"][number], previous_time_s)
        self.total += 1

    def close(self) -> None:
        """Close the temporary file, so that the operating system removes it."""
        self._file.close()

    def _map_file(self, capacity: int) -> None:
        """Map the file to memory, with a size of `capacity` samples. The stored samples are unchanged."""
        self._ring = np.memmap(self._file, self._ring.dtype, "r+", shape=(capacity,))

    def overview(self) -> list[float]:
        """Return the largest force in each of `OVERVIEW_PIECES` pieces of the recording, N."""
        samples = self._ring[: self.total]
        start_s, end_s = self.span()
        elapsed = (samples["timestamp"] - start_s) / max(end_s - start_s, np.finfo(float).tiny)  # from 0 to 1
        piece_of_sample = np.minimum(elapsed * OVERVIEW_PIECES, OVERVIEW_PIECES - 1).astype(int)
        max_force_N = np.zeros(OVERVIEW_PIECES)
        np.maximum.at(max_force_N, piece_of_sample, np.nan_to_num(samples["force_N"], nan=0.0))
        return max_force_N.round(3).tolist()
