"""`isocharge serve predict`: compute contacts from the charges in a file."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.options import DeviceOption, ModelArgument, ModelsOption
from isocharge.cli.shared.terminal import until_stopped
from isocharge.serve import Predictor, read_charges, table_records, write_contacts


def predict_command(
    model: ModelArgument,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.csv",
            help="CSV file with the electrodes' names in the header and a press in each row, charges in pC; further "
            "columns are ignored. The file name - reads stdin.",
        ),
    ],
    json: Annotated[
        bool, typer.Option("--json", help="Print one prediction record per line as JSON. (default: CSV)")
    ] = False,
    device: DeviceOption = None,
    models: ModelsOption = None,
) -> None:
    """Compute positions (mm) and forces (N) with their standard deviations from the charges of presses (pC).

    The column `flags` states why a contact may be wrong. For example, the contact may be outside the working area or
    the range of forces, or the charges may fit no single contact. Of the device file, only the section [noise] is used:
    the standard deviations are those for this noise.

    Example: isocharge serve predict three-25um-biaxial presses.csv > contacts.csv
    """
    predictor = Predictor(model, models=models)
    if device is not None:
        # This late import loads all stages of a stream, for which a command without --device need not wait.
        from isocharge.serve.live.device import load_device, predictor_for

        predictor = predictor_for(load_device(device), predictor)
    charge_pC = read_charges(file, predictor.metadata.electrodes)
    with until_stopped():
        if json:
            for record in table_records(charge_pC, predictor):
                print(record.to_json(), flush=True)  # a reader of a pipe receives each record at once
        else:
            write_contacts(charge_pC, predictor, sys.stdout)
            sys.stdout.flush()
