"""The option `--probe`, and functions for commands that compute a forward map or simulate presses."""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from isocharge.cli.shared.terminal import say
from isocharge.common.defaults import FEW_ELECTRODES
from isocharge.common.errors import InputError, IsochargeError
from isocharge.simulate import Dataset, Film, NoiseModel, Probe, Sensor, read_dataset
from isocharge.simulate.execution import cores, dask_workers, local_workers
from isocharge.simulate.sensor.probe import PROBE_HELP

ProbeOption = Annotated[str, typer.Option(metavar="SHAPE", help=PROBE_HELP)]

DEFAULT_PROBE = "circle:1.0"
"""Notation of the probe if `--probe` is not given."""

ProbesOption = Annotated[
    list[str] | None,
    typer.Option(metavar="SHAPE", help=f"{PROBE_HELP} May be repeated. (default: {DEFAULT_PROBE})"),
]

ROUNDING_MARGIN = 1.0 + 1e-6
"""Factor by which the radius and the largest force of a forward map are increased, because rounding may move the
outermost presses beyond these limits.
"""


def executor_for(workers: int | None = None, cluster: str | None = None) -> AbstractContextManager[Executor | None]:
    """Return a context manager that yields the executor which the values of `--workers` and `--cluster` select.

    Args:
        workers: Number of processes on this computer; None for one process for each core, but at most 64.
        cluster: Address of a Dask scheduler; None to compute on this computer.

    Raises:
        InputError: If both options are given.
    """
    if workers and cluster:
        raise InputError("expected either --workers or --cluster, got both")
    return dask_workers(cluster) if cluster else local_workers(workers or min(cores(), 64))


def solving_executor(film: Film) -> AbstractContextManager[Executor | None]:
    """Return a context manager that yields the executor of a command which has no option for the number of workers.

    An axisymmetric film is solved within seconds, so no processes are started. For any other film, one process is
    started for each core.
    """
    return executor_for(1 if film.is_axisymmetric else None)


def sweep_radius(
    text: str,
    sensor: Sensor,
    probes: Sequence[Probe],
    force: tuple[float, float],
    executor: Executor | None,
    noise: NoiseModel | None = None,
) -> float:
    """Return the radius of a sweep, mm.

    Args:
        text: Value of `--radius`: a number, or `auto` for the radius of the smallest working area of the probes. A
            number is returned as it is, so the caller must check its range.
        sensor: The sensor.
        probes: The probes.
        force: Smallest and largest force, N.
        executor: Executor that runs the solves; None for this process.
        noise: Noise with which the working area is determined; None for the noise level `reference`.

    Raises:
        InputError: If the text is neither a number nor `auto`, or there is no working area with this noise.
    """
    if text != "auto":
        try:
            return float(text)
        except ValueError as error:
            raise InputError(f"--radius: expected a number of mm or 'auto', got {text!r}") from error
    # imported late, because these imports load the solver and the noise levels
    from isocharge.simulate import ChargeSpline, noise_model, working_area
    from isocharge.simulate.identifiability.identification import map_to_search

    radii = []
    for probe in probes:
        forward_map = map_to_search(sensor, probe, force, executor=executor)  # covers the largest possible working area
        area = working_area(ChargeSpline.of(forward_map), noise or noise_model("reference"))
        say(f"{probe.notation}: {area.summary}")
        radii.append(area.radius)
    smallest_radius = min(radii)
    if smallest_radius == 0.0:
        raise InputError(
            "--radius auto: the charges determine the contact nowhere well enough; see 'isocharge simulate identify', "
            "or give a radius in mm"
        )
    return smallest_radius


def warn_of_stress(film: Film, probes: Iterable[Probe], max_force: float) -> None:
    """Print a warning for each probe that can stress the film beyond `DEFAULT_STRESS_LIMIT`.

    Args:
        film: The film.
        probes: The probes.
        max_force: Largest force, N.
    """
    from isocharge.simulate.solver.stress_limit import stress_caution  # imported late, because it loads the solver

    for probe in probes:
        with suppress(IsochargeError):  # the caller computes the same press later, and then reports the error
            caution = stress_caution(film, probe, max_force)
            if caution:
                say(f"caution: {caution}")


N_SIMULATED_PRESSES = 24_000
"""Number of presses that `simulated_presses` returns for a sensor with at most `FEW_ELECTRODES` electrodes."""

MANY_SIMULATED_PRESSES = 96_000
"""Number of presses for a sensor with more electrodes, and therefore with a larger working area. Networks that are
trained on fewer presses have larger errors near the rim of the working area."""


def simulated_presses(
    sensor: Sensor, probes: Sequence[Probe], radius: float, executor: Executor | None = None
) -> Dataset:
    """Simulate presses with the default settings of a sweep, except for its radius and its number of presses.

    A sensor with few electrodes gets `N_SIMULATED_PRESSES` presses. A sensor with more electrodes has a larger working
    area, and gets four times as many.

    Args:
        sensor: The sensor.
        probes: The probes.
        radius: Largest distance of a press from the centre, mm.
        executor: Executor that runs the solves; None for this process.
    """
    from isocharge.simulate import Sweep, run_sweep  # imports the solver

    has_few_electrodes = len(sensor.electrodes) <= FEW_ELECTRODES
    n_press = N_SIMULATED_PRESSES if has_few_electrodes else MANY_SIMULATED_PRESSES
    sweep = Sweep(radius, samples=n_press)
    with TemporaryDirectory() as folder:
        return read_dataset(run_sweep(Path(folder) / "presses", sensor, probes, sweep, executor=executor))
