"""Command `isocharge simulate sweep`, which writes a dataset of many simulated presses."""

import json as json_module
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from isocharge.cli.shared.forward_maps import executor_for, sweep_radius, warn_of_stress, write_deflection
from isocharge.cli.shared.options import (
    ClusterOption,
    ForceRangeOption,
    RadiusOption,
    SensorArgument,
    StressLimitOption,
    WorkersOption,
)
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS, DEFAULT_STRESS_LIMIT
from isocharge.common.errors import InputError, OutputExists
from isocharge.common.extras import require
from isocharge.common.files import refuse_existing
from isocharge.serve import MeasuredPresses, write_presses
from isocharge.serve.presses.measured_presses import MAX_ROWS
from isocharge.simulate import Dataset, Sweep, load_sensor, parse_probe, read_dataset, run_sweep
from isocharge.simulate.sensor.probe import PROBE_HELP

TABLES = (".csv", ".parquet")
"""Suffixes of the files that contain a table of presses."""

SOLVER_POSITION_STD_mm = 0.01
"""Standard deviation of the position in tables of simulated presses, mm.

This value corresponds to an error of the solver of 0.05 % of the charge.
"""

SOLVER_FORCE_STD = 1e-3
"""Relative standard deviation of the force in tables of simulated presses, dimensionless.

This value corresponds to an error of the solver of 0.05 % of the charge.
"""


def sweep_command(
    sensor: SensorArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="New folder for the dataset, which must not exist yet. For NAME.csv or NAME.parquet, the dataset is "
            "written to the folder NAME, and a table of its presses for other programs is written beside it.",
        ),
    ],
    probe: Annotated[
        list[str] | None,
        typer.Option("--probe", metavar="SHAPE", help=f"{PROBE_HELP} May be repeated. (default: circle:1.0)"),
    ] = None,
    radius: RadiusOption = f"{DEFAULT_RADIUS}",
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    samples: Annotated[int, typer.Option("--samples", help="Number of presses of all probes together.")] = 20_000,
    orientation: Annotated[
        Literal["fixed", "random"],
        typer.Option("--orientation", help="Angle of the probe: as given, or random for each press."),
    ] = "fixed",
    sampling: Annotated[
        Literal["sobol", "random", "grid"],
        typer.Option("--sampling", help="Sampling of positions and forces. A grid has at most --samples presses."),
    ] = "sobol",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the presses. Equal seeds give equal data.")] = 0,
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Simulate many presses at different positions and forces, and write their charges as a dataset for training.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    film_sensor = load_sensor(sensor)
    probes = [parse_probe(text) for text in probe or ["circle:1.0"]]

    # The output is a dataset folder, or a table beside which the dataset folder is written.
    folder = output
    table = None
    if output.suffix.lower() in TABLES:
        table = output
        folder = output.with_suffix("")
        has_one_orientation = len(probes) == 1 and orientation == "fixed"
        _check_table(table, folder, samples, has_one_orientation=has_one_orientation)
    refuse_existing(folder)

    _, max_force = force
    warn_of_stress(film_sensor.film, probes, max_force, stress_limit)
    with shown_progress(), executor_for(workers, cluster) as executor:
        largest_distance = sweep_radius(radius, film_sensor, probes, force)
        sweep = Sweep(largest_distance, force, samples, seed, orientation, sampling)
        run_sweep(folder, film_sensor, probes, sweep, executor=executor)
    write_deflection(folder, film_sensor.film, probes)
    if table is not None:
        write_presses(table, _presses(read_dataset(folder)))

    manifest = json_module.loads((folder / "manifest.json").read_text())
    written_paths = f"{folder} and {table}" if table is not None else f"{folder}"
    say(f"{manifest['samples']} presses in {written_paths}")


def _check_table(table: Path, folder: Path, samples: int, *, has_one_orientation: bool) -> None:
    """Before a sweep starts, raise an error if its presses cannot be written as a table.

    Args:
        table: Path of the table, a CSV or Parquet file.
        folder: Folder of the dataset, which is written beside the table.
        samples: Number of presses of the sweep.
        has_one_orientation: Whether all presses have the same probe in the same orientation.

    Raises:
        OutputExists: If the table or the folder exists.
        InputError: If a table cannot contain the presses.
        MissingExtra: If the table is Parquet and pyarrow is not installed.
    """
    refuse_existing(table)
    if not has_one_orientation:
        raise InputError(f"{table}: a table of presses has one probe in one orientation; give a folder, -o {folder}")
    if folder.exists():
        raise OutputExists(
            f"{folder}, the dataset that belongs beside {table}, is already there and is not overwritten; choose "
            "another name, or write its table as simulate/docs/datasets.md does"
        )
    if samples > MAX_ROWS:
        raise InputError(
            f"{table}: a table has at most {MAX_ROWS:,} presses, got --samples {samples}; give a folder, -o {folder}"
        )
    if table.suffix.lower() == ".parquet":
        with require("parquet"):  # raises MissingExtra if the import fails
            import pyarrow  # noqa: F401


def _presses(dataset: Dataset) -> MeasuredPresses:
    """Convert the simulated presses of a dataset into measured presses with small uncertainties.

    The row numbers start at 1.
    """
    samples = dataset.samples
    count = len(samples)
    return MeasuredPresses(
        np.column_stack([samples.x_mm, samples.y_mm, samples.force_N]),
        samples.charge_pC,
        np.full(count, SOLVER_POSITION_STD_mm),
        np.full(count, SOLVER_FORCE_STD),
        dataset.sensor.electrode_names,
        tuple(range(1, count + 1)),
    )
