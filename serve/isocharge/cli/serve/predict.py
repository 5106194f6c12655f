"""`isocharge serve predict`: charges from a file to contacts.

Data go to stdout, words for people to stderr. Everything heavy is imported inside the command that needs it.
"""

import sys
from collections.abc import Iterable
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.serve.options import ModelsOption
from isocharge.cli.shared.stopping import until_stopped
from isocharge.errors import InputError

ModelArgument = Annotated[str, typer.Argument(metavar="MODEL", help="Model name, or path of a model folder.")]


def predict_command(
    model: ModelArgument,
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE.csv", help="CSV with the electrodes as header and touch charges in pC; - reads stdin."
        ),
    ],
    json: Annotated[
        bool, typer.Option("--json", help="One prediction record per line instead of CSV. (default: CSV)")
    ] = False,
    models: ModelsOption = None,
) -> None:
    """Turn touch charges (pC) into contacts (mm, N) with standard deviations.

    Example: isocharge serve predict three-25um-biaxial presses.csv > contacts.csv
    """
    from isocharge.serve import Predictor, read_charges, table_records, write_contacts

    predictor = Predictor(model, models=models)
    where = "stdin" if file == "-" else file
    charge_pC = read_charges(_text(file), predictor.metadata.electrodes, where)
    with until_stopped():
        if json:
            _print_lines(record.to_json() for record in table_records(charge_pC, predictor))
        else:
            write_contacts(predictor.predict_batch(charge_pC), sys.stdout)
            sys.stdout.flush()


def _text(file: str) -> TextIOWrapper:
    """A file, or stdin for `-`, as text for the csv module; a byte order mark is swallowed."""
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); expected a CSV file, or - for stdin") from error
    return TextIOWrapper(BytesIO(data), encoding="utf-8-sig", newline="")


def _print_lines(lines: Iterable[str]) -> None:
    """Data to stdout, each line at once."""
    for line in lines:
        print(line, flush=True)
