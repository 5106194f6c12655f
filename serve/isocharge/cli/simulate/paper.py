"""`isocharge simulate paper`: Mirbagheri et al. (2007) with our numbers beside the paper's."""

import time
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.terminal import progress_rows, say

ROWS = (("solving the films", "tasks"), ("triangulating", ""), ("drawing", "figures"))
"""Titles and units of the progress."""


def paper_command(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to make.")],
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, max=64, help="Processes; the numbers do not depend on them. (default: cores)"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer presses and films: a minute's look. (default: everything)")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="The numbers on stdout, as in paper.json.")] = False,
) -> None:
    """Reproduce Mirbagheri et al. (2007): every figure and number, ours beside it, and what explains the difference.

    Writes paper.md, paper.json and each figure (mm, pC, N) as PNG and SVG into a new folder.

    Example: isocharge simulate paper -o paper
    """
    from isocharge.files import refuse_existing
    from isocharge.simulate.execution.workers import cores, local_workers
    from isocharge.simulate.paper import Choices, write_paper

    refuse_existing(output)
    began = time.perf_counter()
    choices = Choices.quick() if quick else Choices()
    with local_workers(workers or min(cores(), 64)) as crew, progress_rows(*ROWS) as (solved, triangulated, drawn):
        write_paper(output, choices, crew, solved=solved, triangulated=triangulated, drawn=drawn)
    if json:
        typer.echo((output / "paper.json").read_text("utf-8"), nl=False)
    say(f"{output / 'paper.md'}, {time.perf_counter() - began:.0f} s")
