"""Charges from a CSV file; contacts to one, or to prediction records.

The header of the charges names the electrodes, in any order, and may have further columns. The rows are touch charges
in pC: no tare is subtracted, and every row is a contact.
"""

import csv
import math
from array import array
from collections.abc import Callable, Iterable, Iterator
from typing import TextIO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError
from isocharge.serve.prediction.contact import Contacts
from isocharge.serve.prediction.csv_numbers import CsvNumbers, ignored_words
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.record import PredictionRecord
from isocharge.serve.prediction.validity import Validity

BLOCK = 4096
"""Rows that are worked on at a time."""

CHARGE = "a charge in pC"


def read_charges(
    lines: Iterable[str],
    electrodes: tuple[str, ...],
    where: str,
    warn: Callable[[str], None] = lambda _: None,
) -> Array:
    """Read a CSV of charges.

    Args:
        lines: Lines of the file; CRLF, blank lines and lines that begin with # do not matter.
        electrodes: The columns that are read; a file of measured presses may have more.
        where: The file, for messages.
        warn: Called with a sentence if columns are ignored.

    Returns:
        Charges in the order of `electrodes`, shape (n, electrodes), pC.

    Raises:
        ChargeError: If a column is missing or there twice, or a cell is not a finite number.
    """
    expected = f"a header with one column for each of the electrodes {electrodes} and charges in pC"
    table = CsvNumbers(lines, electrodes, where, ChargeError, expected)
    columns = table.columns(electrodes)
    ignored = [name for name in table.header if name not in columns]
    if ignored:
        warn(ignored_words(where, ignored))
    charges = array("d")
    for line, row in table.rows(columns, dict.fromkeys(electrodes, CHARGE)):
        if math.isnan(sum(row)):
            name = electrodes[[math.isnan(value) for value in row].index(True)]
            raise ChargeError(f"{where}, line {line}, column {name!r}: expected {CHARGE}, got an empty cell")
        charges.extend(row)
    return np.frombuffer(charges, dtype=np.float64).reshape(-1, len(electrodes))


def write_contacts(contacts: Contacts, out: TextIO, validity: Validity | None = None) -> None:
    """Write contacts as CSV, a row for each press, columns as in `Contact`, numbers to six decimals.

    Args:
        contacts: The contacts.
        out: Receives the text.
        validity: Where their model may be trusted: adds a column `flags`, words with blanks between.
    """
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(Contacts._fields + ("flags",) * (validity is not None))
    for block in blocks(np.column_stack(contacts)):
        flags = [] if validity is None else validity.batch_flags(Contacts(*block.T))
        words: list[tuple[str, ...]] = [(" ".join(one),) for one in flags] or [()] * len(block)
        writer.writerows((*map("{:.6f}".format, row), *flags) for row, flags in zip(block.tolist(), words, strict=True))


def blocks(rows: Array) -> Iterator[Array]:
    """Rows a block at a time: as Python's numbers, which take five times as much memory."""
    for start in range(0, len(rows), BLOCK):
        yield rows[start : start + BLOCK]


def table_records(charge_pC: Array, predictor: Predictor) -> Iterator[PredictionRecord]:
    """A record for each row of charges, shape (n, electrodes), pC; what a table does not have is None.

    Raises:
        ChargeError: If the charges do not fit the model.
    """
    metadata = predictor.metadata
    for block in blocks(charge_pC):
        contacts = predictor.predict_batch(block)
        flags = predictor.validity.batch_flags(contacts)
        for charges, contact, its_flags in zip(block.tolist(), np.column_stack(contacts).tolist(), flags, strict=True):
            yield PredictionRecord(
                timestamp=None,
                t_device_us=None,
                seq=None,
                **dict(zip(Contacts._fields, contact, strict=True)),
                contact=True,
                charge_pC=dict(zip(metadata.electrodes, charges, strict=True)),
                charge_raw_pC=None,
                tare_pC=None,
                flags=its_flags,
                latency_us=None,
                model=metadata.label,
                frame_id=metadata.frame_id,
            )
