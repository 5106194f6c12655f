"""Samples of a stream, which the live page draws, and the tape that stores the samples under consecutive numbers.

A sample contains the numbers of a prediction record that the page shows. All numbers are stored in 64-bit
floating-point format: the numbers of the record with the names `RECORD_NUMBERS`, the position of the other contact, the
flags as a sum of bits, whether there is a contact, the number of coalesced records, and the touch charge of each
electrode. An unknown number is NaN. If contacts are tracked, a sample contains the tracked contact instead of the
contact of the frame.
"""

from bisect import bisect_right
from typing import Any

import numpy as np

from isocharge.serve.flags import MEANINGS
from isocharge.serve.record.record import PredictionRecord

FLAG_BITS = {word: 1 << position for position, word in enumerate(MEANINGS)}
"""Bit that represents each flag in a sample."""

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in the order of their times, shape (n,), with the named fields of `sample_type`."""

RECORD_NUMBERS = (
    "timestamp",
    "x_mm",
    "y_mm",
    "force_N",
    "x_std_mm",
    "y_std_mm",
    "force_std_N",
    "misfit",
    "xy_correlation",
    "latency_us",
)
"""Names of the numbers of the record in a sample."""


def sample_type(electrodes: tuple[str, ...]) -> "np.dtype[Any]":
    """Return the NumPy type of a sample, with one field for each number.

    Args:
        electrodes: Names of the electrodes. The charge of the electrode A is the field `charge_pC.A`.
    """
    charges = [f"charge_pC.{electrode}" for electrode in electrodes]
    names = [*RECORD_NUMBERS, "other_x_mm", "other_y_mm", "flags", "contact", "records", *charges]
    return np.dtype([(name, float) for name in names])


def sample_values(record: PredictionRecord, electrodes: tuple[str, ...]) -> tuple[float | None, ...]:
    """Return the numbers of a record in the order of `sample_type`.

    Args:
        record: The record.
        electrodes: Names of the electrodes, in the order of the charges.
    """
    # If there is a tracked contact, its numbers replace the numbers of the record. A tracked contact has only some of
    # the numbers: the position and the force, for example, but not the time. The other numbers come from the record.
    best_source = record.tracked or record
    values = [getattr(best_source, name, getattr(record, name)) for name in RECORD_NUMBERS]
    other_position = (None, None) if record.other is None else (record.other.x_mm, record.other.y_mm)
    flags = sum(FLAG_BITS.get(flag, 0) for flag in record.flags)
    record_count = 1  # `coalesce` adds the counts of the samples that it replaces by a single sample
    charge_pC = record.charge_pC or {}
    charges = [charge_pC.get(electrode) for electrode in electrodes]
    # `record.contact` is true while something touches the film.
    return *values, *other_position, flags, float(record.contact), record_count, *charges


def coalesce(samples: Samples, max_samples: int) -> Samples:
    """Reduce the number of samples by replacing each run of neighbouring samples with one sample of the run.

    By default, the latest sample of a run is chosen. If only earlier samples of the run are contacts, the contact with
    the largest force is chosen instead, so that short taps are not lost. The chosen sample gets the flags of all
    samples of the run, and the total number of records in the run.

    Args:
        samples: The samples, shape (n,).
        max_samples: Largest number of samples to return, which is at least 1.

    Returns:
        The chosen samples, shape (max_samples,). If n is at most `max_samples`, the given samples are returned.
    """
    if len(samples) <= max_samples:
        return samples
    return np.concatenate([_coalesced_run(run) for run in np.array_split(samples, max_samples)])


def _coalesced_run(run: Samples) -> Samples:
    """Return the sample that replaces a run, which is a sequence of neighbouring samples, shape (1,).

    It is one of these samples, as `coalesce` describes, with the flags of all samples and the sum of their records.
    """
    # Choose the latest sample, unless only earlier samples are contacts.
    is_contact = run["contact"] == 1.0
    chosen_index = len(run) - 1
    if is_contact.any() and not is_contact[-1]:
        force_N = np.where(is_contact, run["force_N"], -np.inf)
        chosen_index = int(force_N.argmax())

    # Combine the flags and the numbers of records of all samples.
    chosen = run[[chosen_index]]  # a copy
    # All fields of a sample are stored as floating-point numbers, but flags are sums of bits.
    chosen["flags"] = np.bitwise_or.reduce(run["flags"].astype(np.int64))
    chosen["records"] = run["records"].sum()
    return chosen


LIVE_SAMPLES = 1 << 14
"""Number of stored samples of a live stream.

The stored samples cover 16 s at 1 kHz. A browser that falls further behind misses samples.
"""

HISTORY_S = 10.0
"""Time span of the earlier samples that a new browser receives, s. The traces of the page have this length.

The frame rate of the board is computed over the same time span.
"""

MAX_DRAWN_SAMPLES = 600
"""Largest number of samples in a line on the page. A line shows the response to one request, or an overview."""


class Tape:
    """Ring buffer that stores the latest samples of a live stream.

    One thread appends samples. Any other thread may read samples at the same time.

    Attributes:
        total: Number of samples that were appended since the tape was created.
    """

    def __init__(self, dtype: "np.dtype[Any]", capacity: int = LIVE_SAMPLES) -> None:
        """Create a tape without samples.

        Args:
            dtype: NumPy type of a sample.
            capacity: Number of samples that are stored.
        """
        self.total = 0
        self._ring: Samples = np.zeros(capacity, dtype)

    @property
    def oldest(self) -> int:
        """Number of the oldest stored sample."""
        return max(0, self.total - len(self._ring))

    def append(self, values: tuple[float | None, ...]) -> None:
        """Append a sample. If the buffer is full, the sample replaces the oldest sample.

        Args:
            values: The numbers of the sample, in the order of the fields of the type `dtype`. None is stored as NaN.
        """
        place = self.total % len(self._ring)  # after the last place, the first place is used again
        self._ring[place] = values
        self.total += 1  # only now, because other threads read all samples that are counted

    def samples(self, start: int, stop: int) -> Samples:
        """Return the samples with the numbers from `start` to `stop` - 1, except those that were overwritten."""
        numbers = np.arange(max(start, self.oldest), stop)
        samples: Samples = self._ring[numbers % len(self._ring)]
        return samples[numbers >= self.oldest]  # samples may have been appended while the others were copied

    def timestamp(self, number: int) -> float:
        """Return the Unix time of the stored sample that has the given number, s. Without samples, return 0."""
        return float(self._ring[number % len(self._ring)]["timestamp"])

    def first_number_after(self, time_s: float) -> int:
        """Return the number of the first stored sample after a given Unix time, s.

        If all stored samples are earlier, the result is the number of the next sample that will be appended.
        """
        return bisect_right(range(self.total), time_s, lo=self.oldest, key=self.timestamp)

    def span(self) -> tuple[float, float]:
        """Return the Unix times of the oldest and the latest stored sample, s. Without samples, return two zeros."""
        return self.timestamp(self.oldest), self.timestamp(self.total - 1)

    def extent(self) -> dict[str, Any]:
        """Return a description of a complete recording; empty for a live stream."""
        return {}

    def rate_Hz(self) -> float | None:
        """Compute the frame rate of the last `HISTORY_S` seconds, Hz. Return None if the rate is unknown."""
        _, end_s = self.span()
        first = self.first_number_after(end_s - HISTORY_S)
        duration_s = end_s - self.timestamp(first)
        return (self.total - 1 - first) / duration_s if duration_s > 0.0 else None  # None also if a time is NaN


class RecordedTape(Tape):
    """Tape that stores all samples of a recording."""

    def append(self, values: tuple[float | None, ...]) -> None:
        """Append a sample. If the buffer is full, double its size first, so that no sample is replaced.

        The samples are searched by their times, which must therefore not decrease. If the clock was set back, a sample
        with an earlier time gets the time of the previous sample, as does a sample without a time.

        Args:
            values: The numbers of the sample, in the order of the fields of the type `dtype`. The first number is the
                Unix time, s. None is stored as NaN.
        """
        is_full = self.total == len(self._ring)
        if is_full:
            larger_ring: Samples = np.zeros(2 * self.total, self._ring.dtype)  # uses no memory until it is written
            larger_ring[: self.total] = self._ring
            self._ring = larger_ring
        time_s, *others = values
        # The time of the previous sample is the time with the number `total` - 1, or 0 for the first sample.
        super().append((max(self.timestamp(self.total - 1), time_s or 0.0), *others))

    def extent(self) -> dict[str, Any]:
        """Return the times of the first and the last sample, the number of samples, and an overview of the forces.

        The overview contains the largest force in each of `MAX_DRAWN_SAMPLES` pieces of the recording, N.
        """
        samples = self._ring[: self.total]  # all samples, because a recording never overwrites any
        start_s, end_s = self.span()
        elapsed = (samples["timestamp"] - start_s) / max(end_s - start_s, np.finfo(float).tiny)  # from 0 to 1
        piece_of_sample = (elapsed * MAX_DRAWN_SAMPLES).clip(0, MAX_DRAWN_SAMPLES - 1).astype(int)
        max_force_N = np.zeros(MAX_DRAWN_SAMPLES)
        np.fmax.at(max_force_N, piece_of_sample, samples["force_N"])  # ignores forces that are NaN
        return {"span": (start_s, end_s), "samples": self.total, "overview": max_force_N.round(3).tolist()}
