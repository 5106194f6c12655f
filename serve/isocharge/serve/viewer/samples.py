"""Samples of a stream, from which the live page draws.

A sample contains the numbers of a prediction record that the page shows. All of them are stored as 64-bit floating
point numbers: the timestamp, the numbers that are marked for the live page in the declaration of the record, the
position of the other contact, the flags as a sum of bits, whether there is a contact, the number of coalesced records,
and the touch charge of each electrode. An unknown number is NaN. If contacts are tracked, a sample contains the tracked
contact instead of the contact of the frame.
"""

from typing import Any

import numpy as np

from isocharge.serve.flags import MEANINGS
from isocharge.serve.record.record import RECORD_FIELDS, PredictionRecord

FLAG_BITS = {word: 1 << position for position, word in enumerate(MEANINGS)}
"""Bit that represents each flag in a sample."""

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in the order of their times, shape (n,), with the named fields of `sample_type`."""

RECORD_NUMBERS = tuple(field.name for field in RECORD_FIELDS if field.meaning.is_shown_live and field.kind == "number")
"""Names of the numbers of the record in a sample."""

OTHER_NUMBERS = tuple(
    part.name for field in RECORD_FIELDS if field.name == "other" for part in field.parts if part.meaning.is_shown_live
)
"""Names of the numbers of the other contact in a sample, where they have the prefix `other_`."""


def sample_type(electrodes: tuple[str, ...]) -> "np.dtype[Any]":
    """Return the NumPy type of a sample, with one field for each number.

    Args:
        electrodes: Names of the electrodes. The charge of the electrode A is the field `charge_pC.A`.
    """
    others = [f"other_{name}" for name in OTHER_NUMBERS]
    charges = [f"charge_pC.{electrode}" for electrode in electrodes]
    return np.dtype([(name, float) for name in (*RECORD_NUMBERS, *others, "flags", "contact", "records", *charges)])


def sample_values(record: PredictionRecord, electrodes: tuple[str, ...]) -> tuple[float | None, ...]:
    """Return the numbers of a record in the order of `sample_type`.

    Args:
        record: The record.
        electrodes: Names of the electrodes, in the order of the charges.
    """
    values = [getattr(record, name) for name in RECORD_NUMBERS]
    if record.tracked is not None:  # the tracked contact has only some of the numbers
        values = [getattr(record.tracked, name, value) for name, value in zip(RECORD_NUMBERS, values, strict=True)]
    others = [None if record.other is None else getattr(record.other, name) for name in OTHER_NUMBERS]
    flags = sum(FLAG_BITS[flag] for flag in record.flags)
    record_count = 1  # `coalesce` adds the counts of the samples that it replaces by a single sample
    charge_pC = record.charge_pC or {}
    charges = [charge_pC.get(electrode) for electrode in electrodes]
    return *values, *others, flags, float(record.contact), record_count, *charges


def coalesce(samples: Samples, max_samples: int) -> Samples:
    """Reduce the number of samples by replacing each run of neighbouring samples with one sample of the run.

    By default, the latest sample of a run is chosen. If the latest sample is not a contact, but the run contains
    contacts, the contact with the largest force is chosen instead, so that short taps are not lost. The chosen sample
    gets the flags of all samples of the run, the largest latency in the run, and the total number of records in the
    run.

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
    """Return the sample that replaces a run of neighbouring samples, as `coalesce` describes, shape (1,)."""
    is_contact = run["contact"] == 1.0
    chosen_index = len(run) - 1
    if is_contact.any() and not is_contact[-1]:
        force_N = np.where(is_contact, run["force_N"], -np.inf)
        chosen_index = int(force_N.argmax())
    chosen = run[[chosen_index]]  # a copy
    chosen["flags"] = np.bitwise_or.reduce(run["flags"].astype(np.int64))
    chosen["records"] = run["records"].sum()
    chosen["latency_us"] = np.fmax.reduce(run["latency_us"])  # ignores latencies that are NaN
    return chosen
