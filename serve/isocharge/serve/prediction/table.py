"""Reading of charges from a file, and writing of contacts as CSV or as prediction records.

A file of charges has a header with the names of the electrodes in any order, and may have other columns. Each row
contains touch charges in pC. No tare is subtracted from the charges. If the charges of a row do not exceed the noise,
no contact is reported for the row.
"""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ChargeError
from isocharge.serve.model.contact import CORRELATION_COLUMNS, Contact
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.presses.number_columns import CHARGE_RULE
from isocharge.serve.presses.table_file import open_table
from isocharge.serve.record.formats import cell_text
from isocharge.serve.record.record import NO_CONTACT, PredictionRecord

MAX_CHARGE_ROWS = 10_000_000
"""Largest number of rows of a file of charges."""


def read_charges(path: Path, electrodes: tuple[str, ...]) -> Array:
    """Read the charges from a CSV file.

    Args:
        path: The file. The path `-` is standard input.
        electrodes: Names of the columns that are read. The file may contain other columns.

    Returns:
        Charges in the order of `electrodes`, shape (n, electrodes), pC.

    Raises:
        ChargeError: If the file cannot be read, a column is missing or occurs twice, a cell is not a finite number, or
            there are more rows than `MAX_CHARGE_ROWS`.
    """
    expected_header = f"a header with one column for each of the electrodes {electrodes} and charges in pC"
    charge_rule = replace(CHARGE_RULE, may_be_empty=False)  # a model needs the charges of all electrodes
    with open_table(path, electrodes, ChargeError, expected_header) as table:
        # All columns are required, and no columns are optional.
        columns = table.read(dict.fromkeys(electrodes, charge_rule), {}, MAX_CHARGE_ROWS)
    return np.column_stack([columns.values[name] for name in electrodes])


def write_contacts(charge_pC: Array, predictor: Predictor, out: TextIO) -> None:
    """Write the contacts of a table of charges as CSV, with one row for each press.

    The columns are the attributes of `Contact` without the correlations, followed by `flags`. In the last column,
    blanks separate the flags of a press. Numbers have six decimals. If the charges of a press do not exceed the noise
    of the model, its force is 0, and its other cells are empty.

    Args:
        charge_pC: Charges, shape (n, electrodes), pC.
        predictor: The model.
        out: Text file to which the rows are written.

    Raises:
        ChargeError: If the charges do not fit the model.
    """
    names = (*Contact._fields[: CORRELATION_COLUMNS.start], "flags")  # the correlations are the last fields
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    for record in table_records(charge_pC, predictor):
        writer.writerow(cell_text(getattr(record, name)) for name in names)


def table_records(charge_pC: Array, predictor: Predictor) -> Iterator[PredictionRecord]:
    """Yield a prediction record for each row of charges.

    A table contains no times, no counters and no raw charges. The fields of the records for times, counters and raw
    charges are therefore None. If the charges of a row do not exceed the noise of the model, the record has the force
    0, no position and no flags.

    Args:
        charge_pC: Charges, shape (n, electrodes), pC.
        predictor: The model.

    Raises:
        ChargeError: If the charges do not fit the model.
    """
    metadata = predictor.metadata
    # Only a few rows are predicted at a time, because the model and Python numbers need a hundred times as much memory
    # as the array.
    for start in range(0, len(charge_pC), MAX_BATCH):
        block = np.asarray(charge_pC[start : start + MAX_BATCH])
        contacts = predictor.predict_batch(block)
        # Each row has the flags of its contact, and the information whether its charges exceed the noise.
        flags_of_rows = predictor.validity.batch_flags(contacts)
        is_touch_of_rows = predictor.validity.is_touch(block).tolist()
        rows = zip(block.tolist(), np.asarray(contacts).tolist(), flags_of_rows, is_touch_of_rows, strict=True)
        for charges, values, flags, is_touch in rows:
            contact_fields = dict(zip(Contact._fields, values, strict=True)) if is_touch else NO_CONTACT
            yield PredictionRecord(
                timestamp=None,
                t_device_us=None,
                seq=None,
                **contact_fields,
                contact=is_touch,
                charge_pC=dict(zip(metadata.electrodes, charges, strict=True)),
                charge_raw_pC=None,
                tare_pC=None,
                flags=flags if is_touch else (),
                latency_us=None,
                model=metadata.label,
                frame_id=metadata.frame_id,
            )
