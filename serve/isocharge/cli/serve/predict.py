"""`isocharge serve predict`: charges from a file to contacts."""

import sys
from collections.abc import Iterator
from contextlib import nullcontext
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.options import ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import say, until_stopped
from isocharge.common.errors import InputError
from isocharge.common.files import bounded_lines
from isocharge.serve import Predictor, read_charges, table_records, write_contacts
from isocharge.serve.prediction.parquet import SUFFIX, parquet_lines


def predict_command(
    model: ModelArgument,
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE.csv",
            help="CSV or Parquet file with the electrodes' names in the header and a press in each row, charges in pC; "
            "further columns are ignored. - reads CSV from stdin.",
        ),
    ],
    json: Annotated[
        bool, typer.Option("--json", help="Print one prediction record per line as JSON. (default: CSV)")
    ] = False,
    models: ModelsOption = None,
) -> None:
    """Turn charges of presses (pC) into positions (mm) and forces (N) with their standard deviations.

    The column `flags` says why not to trust a row: outside the working area or forces, misfit, far beyond both.

    Example: isocharge serve predict three-25um-biaxial presses.csv > contacts.csv
    """
    predictor = Predictor(model, models=models)
    where = "stdin" if file == "-" else file
    charge_pC = read_charges(_lines(file), predictor.metadata.electrodes, where, say)
    with until_stopped():
        if json:
            for record in table_records(charge_pC, predictor):
                print(record.to_json(), flush=True)  # at once: a reader on a pipe waits for it
        else:
            write_contacts(predictor.predict_batch(charge_pC), sys.stdout, predictor.validity, charge_pC)
            sys.stdout.flush()


def _lines(file: str) -> Iterator[str]:
    """Lines of a file, or of stdin for `-`, for the csv module, without a byte order mark."""
    if file.endswith(SUFFIX):
        yield from parquet_lines(Path(file))
        return
    try:
        with nullcontext(sys.stdin.buffer) if file == "-" else Path(file).open("rb") as data:
            text = TextIOWrapper(data, encoding="utf-8-sig", newline="")
            try:
                yield from bounded_lines(text)
            finally:
                if not text.closed:
                    text.detach()  # or it closes stdin
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); expected a CSV file, or - for stdin") from error
