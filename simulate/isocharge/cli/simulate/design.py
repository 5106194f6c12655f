"""`isocharge simulate design`: where the electrodes should lie."""

import json as json_module
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.options import (
    ClusterOption,
    FreshOption,
    JsonOption,
    NewFolderOption,
    NoiseOption,
    SensorArgument,
    WorkersOption,
    most_workers,
)
from isocharge.cli.shared.terminal import progress, say
from isocharge.common.errors import InputError
from isocharge.common.number_text import number_of

if TYPE_CHECKING:
    from isocharge.simulate import Nuisances
    from isocharge.simulate.execution.workers import Workers
    from isocharge.simulate.layout.costs import ErrorMap
    from isocharge.simulate.layout.design import Design
    from isocharge.simulate.layout.placing import Zone
    from isocharge.simulate.layout.task import DesignTask

SENSOR, SVG, DXF, NUMBERS, PAGE = "sensor.toml", "layout.svg", "layout.dxf", "design.json", "design.html"
"""Files in the output folder."""


def design_command(
    sensor: SensorArgument,
    output: NewFolderOption,
    electrodes: Annotated[
        int, typer.Option("--electrodes", metavar="N", help="Number of electrodes, 3 to 8, with those that stay.")
    ],
    radius: Annotated[
        float, typer.Option("--radius", metavar="MM", help="Largest distance of a press from the film's centre, mm.")
    ],
    goal: Annotated[
        str,
        typer.Option(
            "--goal",
            metavar="worst|rms|MAP",
            help="What is made small: the worst error, its root mean square, or that weighted with a map of what "
            "matters, a CSV file with the columns x_mm, y_mm, weight.",
        ),
    ] = "worst",
    keep: Annotated[
        str | None,
        typer.Option("--keep", metavar="NAMES", help="Electrodes of SENSOR that stay, like A,B. (default: none)"),
    ] = None,
    probe: Annotated[
        list[str] | None,
        typer.Option("--probe", metavar="SHAPE", help="Round footprint, mm. May be repeated. (default: circle:1.0)"),
    ] = None,
    force: Annotated[
        list[float] | None,
        typer.Option("--force", metavar="N", help="Force of the presses, N. May be repeated. (default: 1)"),
    ] = None,
    pretension: Annotated[
        list[float] | None,
        typer.Option(
            "--pretension",
            metavar="MPA",
            help="Pretension of the film, MPa. May be repeated: the design is then for all of them. (default: "
            "SENSOR's)",
        ),
    ] = None,
    noise: NoiseOption = "reference",
    known: Annotated[
        bool,
        typer.Option(
            "--known",
            help="Take probe radius, pressure profile, pretension and gains as exactly known. (default: unknown by "
            "0.3 mm, from uniform to a rigid punch's, by 0.1 MPa and 0.2 %)",
        ),
    ] = False,
    side: Annotated[
        str | None,
        typer.Option(
            "--side",
            metavar="MM|MIN:MAX",
            help="Side of the new squares, mm, or a range to choose from. (default: that of SENSOR's squares)",
        ),
    ] = None,
    gap: Annotated[float, typer.Option("--gap", metavar="MM", help="Smallest gap between electrodes, mm.")] = 0.5,
    rim: Annotated[
        float, typer.Option("--rim", metavar="MM", help="Smallest distance of an electrode from the rim, mm.")
    ] = 1.0,
    keep_out: Annotated[
        list[str] | None,
        typer.Option(
            "--keep-out",
            metavar="X,Y,R",
            help="Disk without electrodes and leads, mm. May be repeated. (default: none)",
        ),
    ] = None,
    symmetry: Annotated[
        str,
        typer.Option(
            "--symmetry",
            metavar="NAME",
            help="Symmetry of the new squares: none, mirror (in the drawn direction), or 2-fold to 8-fold.",
        ),
    ] = "none",
    trade_off: Annotated[
        bool,
        typer.Option(
            "--trade-off",
            help="Also draw the error against radius for 3 to 8 electrodes and against their size: some minutes. "
            "(default: no)",
        ),
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the search; the same seed, the same design.")] = 0,
    starts: Annotated[
        int,
        typer.Option(
            "--starts", min=1, help="Descents from random layouts; more find better layouts of many electrodes."
        ),
    ] = 24,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    fresh: FreshOption = False,
    json: JsonOption = False,
) -> None:
    """Search the places of electrodes that determine presses best, and write sensor file, drawings and a page.

    Errors are Cramer-Rao limits, mm, with what nobody knows exactly as nuisances. A search that was stopped goes on
    with the same command.

    Example: isocharge simulate design four-25um-biaxial --electrodes 4 --radius 15 -o over-15mm
    """
    from isocharge.common.resumable_run import refuse_finished
    from isocharge.simulate import load_sensor, noise_model, parse_probe
    from isocharge.simulate.artwork import dxf  # noqa: F401  (a missing extra is said before the search)
    from isocharge.simulate.layout.goal import Goal
    from isocharge.simulate.layout.task import DesignTask

    if workers and cluster:
        raise InputError("expected either --workers or --cluster, got both")
    refuse_finished(output)
    task = DesignTask(
        load_sensor(sensor),
        electrodes,
        1e-3 * radius,
        Goal.of(goal),
        tuple(name.strip() for name in (keep or "").split(",") if name.strip()),
        tuple(parse_probe(text) for text in probe or ["circle:1.0"]),
        tuple(force or [1.0]),
        tuple(1e6 * value for value in pretension or []),
        noise_model(noise),
        _nuisances(known),
        _sides(side),
        1e-3 * gap,
        1e-3 * rim,
        tuple(_zone(text) for text in keep_out or []),
        symmetry,
        seed,
    )
    task.check()
    try:
        with _workers(workers, cluster) as pool, progress("designing") as advance:
            numbers = _run(_Request(task, output, starts, trade_off, fresh), pool, advance)
    except KeyboardInterrupt:
        if (part := output.with_name(f"{output.name}.part")).exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on from there")
        raise
    typer.echo(json_module.dumps(numbers) if json else _table(numbers))
    say(f"{_verdict(numbers)}; files in {output}")


@dataclass(frozen=True)
class _Request:
    """What is to be written, and where."""

    task: "DesignTask"
    output: Path
    starts: int
    trade_off: bool
    fresh: bool


def _run(request: _Request, pool: "Workers", advance: Callable[..., None]) -> dict[str, Any]:
    """Design, or go on with a stopped one, and write the folder; gives the numbers."""
    from isocharge.common.resumable_run import resume_folder
    from isocharge.simulate import sensor_to_dict
    from isocharge.simulate.execution.checkpointed_map import CheckpointedMap
    from isocharge.simulate.execution.code_version import code_fingerprint
    from isocharge.simulate.layout.costs import trade_off
    from isocharge.simulate.layout.design import run_design

    task = request.task
    identity = {
        "made_by": code_fingerprint(),
        "sensor": sensor_to_dict(task.sensor),
        "task": task.to_dict(),
        "weights": task.goal.weights.tolist(),
        "starts": request.starts,
        "trade_off": request.trade_off,
    }
    with resume_folder(request.output, identity, fresh=request.fresh, warn=say) as run:
        map_jobs = CheckpointedMap(run, "search", pool.in_order)
        design = run_design(task, map_jobs=map_jobs, progress=advance, starts=request.starts)
        trade = (
            trade_off(task, map_jobs=CheckpointedMap(run, "trade-off", pool.in_order), progress=advance)
            if request.trade_off
            else None
        )
        files, numbers = _files(design, trade)
        for name, data in files.items():
            run.save(name, data, final=True)
    return numbers


def _files(design: "Design", trade: Any) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Contents of all files by name, and the numbers."""
    from isocharge.common.json_values import plain_values
    from isocharge.simulate import sensor_to_toml
    from isocharge.simulate.artwork.dxf import layout_dxf
    from isocharge.simulate.artwork.leads import route
    from isocharge.simulate.artwork.page import design_page
    from isocharge.simulate.artwork.svg import layout_svg
    from isocharge.simulate.layout.costs import ErrorMap, design_to_dict

    task = design.task
    zones = tuple((*zone.centre, zone.radius) for zone in task.zones)
    leads = route(design.sensor, keep_out=zones)
    comparable = len(task.sensor.electrodes) >= 3
    before = [ErrorMap.of(task.sensor, charges, task) for charges in design.charges] if comparable else []
    after = [ErrorMap.of(design.sensor, charges, task) for charges in design.charges]
    numbers = design_to_dict(design, before, after)
    numbers["leads"] = {
        "words": leads.words,
        "length_mm": {lead.electrode: round(1e3 * lead.length, 3) for lead in leads.leads},
    }
    numbers["trade_off"] = trade.to_dict() if trade else None
    plain: Any = plain_values(numbers)
    toml = sensor_to_toml(design.sensor, _comment(plain))
    svg = layout_svg(design.sensor, leads)
    pictures = _pictures(design, before, after, trade)
    page = design_page(plain, toml, svg, leads.words, pictures)
    return {
        SENSOR: toml.encode(),
        SVG: svg.encode(),
        DXF: layout_dxf(design.sensor, leads).encode(),
        NUMBERS: (json_module.dumps(plain, indent=1, allow_nan=False) + "\n").encode(),
        PAGE: page.encode(),
    }, plain


def _pictures(design: "Design", before: "list[ErrorMap]", after: "list[ErrorMap]", trade: Any) -> dict[str, bytes]:
    """PNG files by caption."""
    from isocharge.simulate.layout.costs import tolerance_costs
    from isocharge.simulate.plots.figure import picture_bytes
    from isocharge.simulate.plots.layout_maps import error_maps_picture, tolerance_picture, trade_off_picture

    task, scene = design.task, design.task.scenes[0]
    title = f"{scene.force:g} N, {scene.probe.notation}, noise {task.noise.name}, with the nuisances of the task"
    first = (task.sensor, before[0]) if before else None
    pictures = {
        "Least position error before and after, on one scale": error_maps_picture(
            first, (design.sensor, after[0]), task.radius, title
        ),
        "What placement tolerances cost": tolerance_picture(tolerance_costs(design), float(after[0].task.max())),
    }
    if trade:
        pictures["Error of the best layouts against radius and against size (rough searches)"] = trade_off_picture(
            trade, task.goal.kind, task.sides[0]
        )
    return {caption: picture_bytes(figure) for caption, figure in pictures.items()}


def _workers(workers: int | None, cluster: str | None) -> AbstractContextManager["Workers"]:
    from isocharge.simulate.execution.workers import dask_workers, local_workers

    return dask_workers(cluster) if cluster else local_workers(most_workers(workers))


def _nuisances(known: bool) -> "Nuisances":
    from isocharge.simulate.layout.scene import Nuisances

    return Nuisances.none() if known else Nuisances()


def _sides(text: str | None) -> tuple[float, float] | None:
    """Smallest and largest side, m."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    return 1e-3 * _number(low, "--side", text), 1e-3 * _number(high or low, "--side", text)


def _zone(text: str) -> "Zone":
    from isocharge.simulate.layout.placing import Zone

    parts = text.split(",")
    if len(parts) != 3:
        raise InputError(f"--keep-out: expected X,Y,RADIUS in mm like '0,5,3', got {text!r}")
    x, y, radius = (1e-3 * _number(part.strip(), "--keep-out", text) for part in parts)
    return Zone((x, y), radius)


def _number(part: str, option: str, text: str) -> float:
    try:
        return number_of(part)
    except ValueError as error:
        raise InputError(f"{option}: expected numbers of mm, got {text!r}") from error


def _comment(numbers: dict[str, Any]) -> list[str]:
    task, errors = numbers["task"], numbers["scenes"][0]["after"]["nuisances_of_the_task"]
    return [
        f"Places searched for {task['electrodes']} electrodes over {task['radius_mm']:g} mm, goal {task['goal']}:",
        f"least position error {errors['worst_mm']:.3f} mm at worst, {errors['rms_mm']:.3f} mm rms.",
    ]


def _table(numbers: dict[str, Any]) -> str:
    rows = [f"{name:<10} {x:9.3f} {y:9.3f} mm" for name, (x, y) in numbers["electrodes_mm"].items()]
    rows.append("least position error, mm               before: worst    rms   after: worst    rms")
    for scene in numbers["scenes"]:
        for level in ("noise_alone", "probe_and_pretension_unknown", "nuisances_of_the_task"):
            before, after = (scene["before"] or {}).get(level), scene["after"][level]
            first = f"{before['worst_mm']:13.3f} {before['rms_mm']:6.3f}" if before else " " * 20
            head = f"{scene['force_N']:g} N, {level.replace('_', ' ')}"
            rows.append(f"{head:<38} {first} {after['worst_mm']:14.3f} {after['rms_mm']:6.3f}")
    return "\n".join(rows)


def _verdict(numbers: dict[str, Any]) -> str:
    if numbers["unambiguous"]:
        return f"no folds, no twins; {numbers['leads']['words']}"
    return f"caution: {numbers['folds_and_twins']}; {numbers['leads']['words']}"
