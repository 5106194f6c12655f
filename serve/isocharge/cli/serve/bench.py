"""`isocharge serve bench`: how fast a model is on this machine, and how accurate."""

import json as json_module
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer

from isocharge.cli.serve.options import ModelsOption
from isocharge.cli.shared.options import JsonOption
from isocharge.cli.shared.terminal import progress, say
from isocharge.common.errors import MissingExtra

if TYPE_CHECKING:
    from isocharge.serve import Model
    from isocharge.serve.benchmark import HttpLoad, Timing

CONNECTIONS = 16
"""Connections of the last row."""

HTTP_BATCH = 256
"""Presses in the batch that goes over HTTP."""

ERRORS = {
    "position, mm": ("position_median_mm", "position_rms_mm", "position_p99_mm"),
    "force, %": ("force_median_percent", "force_rms_percent", "force_p99_percent"),
}
"""Errors that a model states: median, rms, 99 %."""


def bench_command(
    model: Annotated[
        str, typer.Argument(metavar="[MODEL]", help="Model: a name in `models/`, or a path.")
    ] = "three-25um-biaxial",
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.1, max=86400.0, help="Time for all measurements, s.")
    ] = 40.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the order of presses.")] = 0,
    json: JsonOption = False,
    models: ModelsOption = None,
) -> None:
    """Measure how fast a model predicts on this machine, in process and over HTTP, with its error beside it.

    The presses are the model's golden vectors, in pC. All take turns, after one round to warm up. HTTP goes to a
    server of its own on this machine, and is left out where the extra `http` is not installed.

    Example: isocharge serve bench three-25um-biaxial --seconds 10
    """
    from isocharge.serve import check_golden, find_model, load_model
    from isocharge.serve.benchmark import machine

    folder = find_model(model, models)
    loaded = load_model(folder)
    check_golden(loaded)
    with _server(folder) as (load, why_not), progress("measuring") as advance:
        timings = list(_timings(loaded, load, seconds, seed, advance))
    errors = {name: value for names in ERRORS.values() for name in names if (value := _error(loaded, name)) is not None}
    if json:
        report = {"model": loaded.metadata.label, "seconds": seconds, "seed": seed, "machine": machine()}
        report |= {"timings": [asdict(timing) for timing in timings], "errors": errors, "without_http": why_not}
        typer.echo(json_module.dumps(report, allow_nan=False))
        return
    if why_not:
        say(why_not)
    typer.echo("\n".join(_lines(loaded, timings, machine(), seed)))


def _timings(
    model: "Model", load: "HttpLoad | None", seconds: float, seed: int, advance: Callable[[int, int], object]
) -> Iterator["Timing"]:
    """A timing for each contender, those over HTTP last."""
    from isocharge.serve import Predictor
    from isocharge.serve.benchmark import in_process_contenders, press_charges, take_turns

    charges = press_charges(model.golden.charge_pC, seed)
    contenders = in_process_contenders(Predictor(model.folder), charges)
    if load is None:
        yield from take_turns(contenders, seconds, advance)
        return
    contenders += [load.contender(charges[:1]), load.contender(charges[:HTTP_BATCH])]
    share = len(contenders) / (len(contenders) + 1)
    yield from take_turns(contenders, share * seconds, advance)
    yield load.many(charges[:1], CONNECTIONS, (1.0 - share) * seconds)


@contextmanager
def _server(folder: Path) -> Iterator[tuple["HttpLoad | None", str | None]]:
    """A client of a server of this model in a process of its own, or None and why there is none."""
    from isocharge.serve.benchmark import HttpLoad

    try:
        import isocharge.serve.network.http  # noqa: F401 (whether it can be imported)
    except MissingExtra as error:
        yield None, f"HTTP was left out: {error}"
        return
    words = [sys.executable, "-m", "isocharge.cli", "serve", "http", "--port", "0", "--models", str(folder.parents[1])]
    environment = {name: value for name, value in os.environ.items() if name != "ISOCHARGE_TOKEN"}
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, env=environment) as server:
        try:
            assert server.stdout is not None
            url = urlsplit(server.stdout.readline().strip())
            if url.hostname is None or url.port is None:
                reason = server.communicate()[1].strip().splitlines()
                yield None, f"HTTP was left out: the server did not start: {reason[-1] if reason else 'no reason'}"
                return
            with HttpLoad(url.hostname, url.port, f"{folder.parent.name}/versions/{folder.name}") as load:
                yield load, None
        finally:
            with suppress(OSError):
                server.terminate()


def _error(model: "Model", name: str) -> float | None:
    return model.metadata.errors.get(name)


def _lines(model: "Model", timings: list["Timing"], machine: dict[str, Any], seed: int) -> Iterator[str]:
    """The table for people."""
    yield f"{model.metadata.label}, presses of its golden vectors, seed {seed}; answers checked against golden.json"
    yield ", ".join(f"{name} {value}" for name, value in machine.items())
    yield ""
    yield f"{'call':30}{'p50, us':>10}{'p99, us':>10}{'presses/s':>12}"
    for timing in timings:
        yield f"{timing.name:30}{timing.p50_us:>10.1f}{timing.p99_us:>10.1f}{timing.presses_per_s:>12,.0f}"
    yield ""
    yield f"{'error of the model':30}{'median':>10}{'rms':>10}{'99 %':>12}"
    for title, names in ERRORS.items():
        values = [_error(model, name) for name in names]
        texts = ["-" if value is None else f"{value:.3g}" for value in values]
        yield f"{title:30}{texts[0]:>10}{texts[1]:>10}{texts[2]:>12}"
