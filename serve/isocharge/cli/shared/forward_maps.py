"""Who solves for a command, what a stopped one says, the radius of a sweep and its presses, their stress."""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from isocharge.cli.shared.options import most_workers, radius_mm_of
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.resumable_run import draft_of
from isocharge.simulate import (
    Dataset,
    Film,
    Probe,
    Sensor,
    Sweep,
    noise_model,
    read_dataset,
    run_sweep,
    working_area,
)
from isocharge.simulate.execution.workers import dask_workers, local_workers
from isocharge.simulate.identifiability.identification import map_to_search
from isocharge.simulate.solver.stress_limit import stress_caution

SLACK = 1.0 + 1e-6
"""Factor on the radius that a map is asked for: rounding may put the outermost presses just outside it."""


def executor_for(workers: int | None, cluster: str | None) -> AbstractContextManager[Executor | None]:
    """The workers that `--workers` and `--cluster` ask for.

    Raises:
        InputError: If both are given.
    """
    if workers and cluster:
        raise InputError("expected either --workers or --cluster, got both")
    return dask_workers(cluster) if cluster else local_workers(most_workers(workers))


@contextmanager
def shown_run(target: Path) -> Iterator[None]:
    """Progress of a resumable run as bars; if the user stops it, say that the same command goes on."""
    try:
        with shown_progress():
            yield
    except KeyboardInterrupt:
        if (part := draft_of(target)).exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on from there")
        raise


def sweep_radius(text: str, sensor: Sensor, probes: Sequence[Probe], force: tuple[float, float]) -> float:
    """The radius of a sweep, mm, from `--radius`: a number, or `auto` for the working area of every probe.

    Raises:
        InputError: If the text is neither, or there is no working area under `reference` noise.
    """
    if text != "auto":
        return radius_mm_of(text)
    areas = []
    for probe in probes:
        areas.append(working_area(map_to_search(sensor, probe, force), noise_model("reference")))
        say(f"{probe.notation}: {areas[-1].summary}")
    radius = min(area.radius for area in areas)
    if radius == 0.0:
        raise InputError(
            "--radius auto: the charges determine the contact nowhere well enough; see 'isocharge simulate identify', "
            "or give a radius in mm"
        )
    return radius


def caution_of_stress(
    film: Film, probes: Iterable[Probe], most_force: float, limit: float = DEFAULT_STRESS_LIMIT
) -> None:
    """Say which probes stress the film beyond a limit (MPa) at the largest force (N)."""
    for probe in probes:
        with suppress(IsochargeError):  # what asked for the press meets the same error, and says it
            if caution := stress_caution(film, probe, most_force, limit):
                say(f"caution: {caution}")


SAMPLES = 24_000
"""Number of presses."""


def simulated_presses(sensor: Sensor, probes: Sequence[Probe], radius: float, force: tuple[float, float]) -> Dataset:
    """A sweep within a radius (mm) and a range of forces (N), else with its defaults, deleted once it is read.

    It takes a few seconds, so one process is enough.
    """
    with TemporaryDirectory() as folder:
        sweep = Sweep(radius, force, samples=SAMPLES)
        return read_dataset(run_sweep(Path(folder) / "presses", sensor, probes, sweep))
