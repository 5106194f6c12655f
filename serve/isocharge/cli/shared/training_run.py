"""A training under a progress bar, and what it says when it ends or is stopped."""

import json as json_module
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from isocharge.cli.shared.terminal import progress, say, this_command

if TYPE_CHECKING:
    from isocharge.train import Release


def train_and_say(train: "Callable[..., Release]", output: Path, version: int, *, fresh: bool, json: bool) -> None:
    """Run a training into a model folder and print its errors; stopped, say how to go on."""
    try:
        with progress("training") as advance:
            release = train(
                output,
                command=this_command(),
                version=version,
                fresh=fresh,
                progress=advance,
                warn=lambda message: say(f"caution: {message}"),
            )
    except KeyboardInterrupt:
        if (part := output / f"{version}.part").exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on from there")
        raise
    if json:
        typer.echo(json_module.dumps({"folder": str(release.folder), "errors": dict(release.metadata.errors)}))
    say(_summary(release))


def _summary(release: "Release") -> str:
    errors = release.metadata.errors
    measured = errors.get("measured_presses")
    presses = f"on {measured:.0f} measured presses that training never saw, " if measured else ""
    return (
        f"{release.folder}: {presses}position error {errors['position_median_mm']:g} mm median, "
        f"{errors['position_rms_mm']:g} mm rms, {errors['position_p95_mm']:g} mm at 95 %; "
        f"force {errors['force_rms_percent']:g} % rms"
    )
