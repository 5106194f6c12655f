"""`isocharge serve bench`: measure the speed of a model on this machine, and print the errors of the model."""

from typing import Annotated

import typer

from isocharge.cli.shared.options import JsonOption, ModelsOption
from isocharge.cli.shared.terminal import show_result, shown_progress
from isocharge.serve import Predictor, find_model, load_checked_model
from isocharge.serve.benchmark import in_process_contenders, machine, press_charges, take_turns


def bench_command(
    model: Annotated[
        str, typer.Argument(metavar="[MODEL]", help="Name of a model, or path of a model folder.")
    ] = "three-25um-biaxial",
    seconds: Annotated[float, typer.Option(min=0.1, max=86400.0, help="Time for all measurements, s.")] = 10.0,
    models: ModelsOption = None,
    json: JsonOption = False,
) -> None:
    """Measure how fast a model computes contacts on this machine, and print the errors of the model.

    The charges (pC) are taken from the golden vectors of the model. After a warm-up round, the different kinds of calls
    are measured in turn.

    Example: isocharge serve bench three-25um-biaxial --seconds 10
    """
    loaded = load_checked_model(find_model(model, models))
    predictor = Predictor(loaded.folder)
    # A contender is one way to compute contacts, such as a method for one press or for a batch. The golden vectors are
    # charges that are stored with the model. `press_charges` repeats them to fill the largest batch.
    contenders = in_process_contenders(predictor, press_charges(predictor, loaded.golden.charge_pC))
    with shown_progress():
        timings = take_turns(contenders, seconds)

    report = {
        "model": loaded.metadata.label,
        "seconds": seconds,
        "machine": machine(),
        "timings": [timing._asdict() for timing in timings],
        "errors": loaded.metadata.errors,
    }
    show_result(report, json=json)
