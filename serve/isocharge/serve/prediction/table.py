"""Charges from a CSV file; contacts to one, or to prediction records.

The header of the charges names the electrodes, in any order. The rows are touch charges in pC: no tare is subtracted,
and every row is a contact.
"""

import csv
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import TextIO

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import ChargeError
from isocharge.number_text import number_of
from isocharge.serve.prediction.predictor import Contacts, Predictor
from isocharge.serve.prediction.record import PredictionRecord
from isocharge.serve.prediction.validity import Domain
from isocharge.tables import cut, shown

BLOCK = 16384
"""Rows that are worked on at a time."""


def read_charges(lines: Iterable[str], electrodes: tuple[str, ...], where: str) -> Array:
    """Read a CSV of charges.

    Args:
        lines: Lines of the file; CRLF and blank lines do not matter.
        electrodes: The columns that are expected.
        where: The file, for messages.

    Returns:
        Charges in the order of `electrodes`, shape (n, electrodes), pC.

    Raises:
        ChargeError: If a column is missing, unknown or there twice, or a cell is not a finite number.
    """
    rows = _numbered_rows(lines, where)
    _, header = next(rows, (0, None))
    if header is None:
        raise ChargeError(f"{where}: empty; expected a header with the electrodes {electrodes} and charges in pC")
    columns = _columns([name.strip() for name in header], electrodes, where)
    charges = array("d")  # eight bytes a number: a list of lists has twenty times as many
    for line, row in rows:
        charges.extend(_charges(row, header, columns, f"{where}, line {line}"))
    return np.frombuffer(charges, dtype=np.float64).reshape(-1, len(electrodes))


def _numbered_rows(lines: Iterable[str], where: str) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not blank, with their line numbers from 1."""
    reader = csv.reader(lines)
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield reader.line_num, row
    except (csv.Error, ValueError) as error:  # ValueError: of the lines, which are no UTF-8, or too long
        raise ChargeError(f"{where}, line {reader.line_num + 1}: not CSV text in UTF-8 ({error})") from error


def _columns(header: list[str], electrodes: tuple[str, ...], where: str) -> list[int]:
    """The column of each electrode."""
    unknown = [name for name in header if name not in electrodes]
    missing = [name for name in electrodes if name not in header]
    twice = sorted(name for name, count in Counter(header).items() if count > 1)
    for what, names in (("unknown", unknown), ("missing", missing), ("repeated", twice)):
        if names:
            raise ChargeError(
                f"{where}: expected one column for each of the electrodes {electrodes}, got the header "
                f"{shown(header)}; {what}: {cut(', '.join(map(repr, names)))}"
            )
    return [header.index(name) for name in electrodes]


def _charges(row: list[str], header: list[str], columns: list[int], where: str) -> list[float]:
    if len(row) != len(header):
        raise ChargeError(f"{where}: expected {len(header)} cells as in the header, got {len(row)}: {shown(row)}")
    return [_charge(row[column], header[column].strip(), where) for column in columns]


def _charge(cell: str, electrode: str, where: str) -> float:
    try:
        value = number_of(cell)
    except ValueError:
        value = np.nan
    if not abs(value) <= float(np.finfo(np.float32).max):
        raise ChargeError(f"{where}: electrode {electrode!r}: expected a charge in pC, got {shown(cell)}")
    return value


def write_contacts(contacts: Contacts, out: TextIO) -> None:
    """Write contacts as CSV, a row for each press, columns as in `Contact`, numbers to six decimals."""
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(Contacts._fields)
    for block in blocks(np.column_stack(contacts)):
        writer.writerows([f"{value:.6f}" for value in row] for row in block.tolist())


def blocks(rows: Array) -> Iterator[Array]:
    """Rows a block at a time: as Python's numbers, which take five times as much memory."""
    for start in range(0, len(rows), BLOCK):
        yield rows[start : start + BLOCK]


def table_records(charge_pC: Array, predictor: Predictor) -> Iterator[PredictionRecord]:
    """A record for each row of charges, shape (n, electrodes), pC; what a table does not have is None.

    Raises:
        ChargeError: If the charges do not fit the model.
    """
    for block in blocks(charge_pC):
        yield from _block_records(block, predictor)


def _block_records(charge_pC: Array, predictor: Predictor) -> Iterator[PredictionRecord]:
    metadata, contacts = predictor.metadata, predictor.predict_batch(charge_pC)
    flags = Domain.of(metadata).batch_flags(contacts)
    for charges, contact, its_flags in zip(charge_pC.tolist(), np.column_stack(contacts).tolist(), flags, strict=True):
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
