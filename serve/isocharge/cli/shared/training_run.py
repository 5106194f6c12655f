"""A fit that goes on after a kill, what it says when it ends or is stopped, and the options that its commands share."""

import json as json_module
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import shown_run
from isocharge.cli.shared.terminal import say
from isocharge.common.resumable_run import ResumableRun, resume_parts
from isocharge.train import Release

ModelFolderOption = Annotated[
    Path,
    typer.Option("--output", "-o", metavar="models/NAME", help="Model folder; its name becomes the model's name."),
]

VersionOption = Annotated[int, typer.Option("--version", min=1, help="Version of the model: the folder in NAME.")]


def release_resumably(
    fit_and_release: Callable[[ResumableRun], Release],
    identity: Mapping[str, Any],
    target: Path,
    *,
    fresh: bool,
    json: bool,
) -> None:
    """Fit into a version folder and print the errors; stopped, say how to go on.

    Args:
        fit_and_release: The work; it keeps its state in the run.
        identity: All that decides about the weights.
        target: The version folder.
        fresh: Throw away what an earlier run left.
        json: Print the folder and the errors as one JSON object.
    """
    with shown_run(target), resume_parts(target, identity, fresh=fresh) as run:
        release = fit_and_release(run)
    errors = release.metadata.errors
    if json:
        typer.echo(json_module.dumps({"folder": str(release.folder), "errors": dict(errors)}))
    measured = errors.get("measured_presses")
    presses = f"on {measured:.0f} measured presses that training never saw, " if measured else ""
    say(
        f"{release.folder}: {presses}position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"force {errors['force_rms_percent']:g} % rms"
    )
