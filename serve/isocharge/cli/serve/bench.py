"""`isocharge serve bench`: measure the speed of a model on this machine, and print the errors of the model."""

from collections.abc import Iterator
from typing import Annotated

import typer

from isocharge.cli.shared.options import JsonOption, ModelsOption
from isocharge.cli.shared.terminal import show, show_json, shown_progress
from isocharge.serve import Model, Predictor, find_model, load_checked_model
from isocharge.serve.benchmark import Timing, in_process_contenders, machine, press_charges, take_turns

ERROR_NAMES = {
    "position, mm": ("position_median_mm", "position_rms_mm", "position_p99_mm"),
    "force, %": ("force_median_percent", "force_rms_percent", "force_p99_percent"),
}
"""Names of the errors in the metadata of a model: median, root mean square and 99th percentile."""


def bench_command(
    model: Annotated[
        str, typer.Argument(metavar="[MODEL]", help="Model: a name in `models/`, or a path.")
    ] = "three-25um-biaxial",
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.1, max=86400.0, help="Time for all measurements, s.")
    ] = 10.0,
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
    contenders = in_process_contenders(predictor, press_charges(predictor, loaded.golden.charge_pC))
    with shown_progress():
        timings = take_turns(contenders, seconds)

    # A model may have been released without some of the errors.
    reported_names = [name for names in ERROR_NAMES.values() for name in names]
    model_errors = loaded.metadata.errors
    errors = {name: model_errors[name] for name in reported_names if name in model_errors}

    if json:
        report = {"model": loaded.metadata.label, "seconds": seconds, "machine": machine()}
        report |= {"timings": [timing._asdict() for timing in timings], "errors": errors}
        show_json(report)
    else:
        show("\n".join(_report_lines(loaded, timings, errors)))


def _report_lines(model: Model, timings: list[Timing], errors: dict[str, float]) -> Iterator[str]:
    """Yield the lines of the report on the machine, the timings and the errors of the model.

    Args:
        model: The model.
        timings: Timing of each kind of call.
        errors: Errors of the model by the names in its metadata. A dash is printed for each error that is absent.
    """
    yield f"{model.metadata.label}, presses of its golden vectors; answers checked against golden.json"
    yield ", ".join(f"{name} {value}" for name, value in machine().items())
    yield ""
    yield f"{'call':30}{'p50, us':>10}{'p99, us':>10}{'presses/s':>12}"
    for timing in timings:
        yield f"{timing.name:30}{timing.p50_us:>10.1f}{timing.p99_us:>10.1f}{timing.presses_per_s:>12,.0f}"
    yield ""
    yield f"{'error of the model':30}{'median':>10}{'rms':>10}{'99 %':>12}"
    for title, names in ERROR_NAMES.items():
        median, rms, p99 = (f"{errors[name]:.3g}" if name in errors else "-" for name in names)
        yield f"{title:30}{median:>10}{rms:>10}{p99:>12}"
