"""`isocharge simulate paper`: Mirbagheri et al. (2007), our numbers next to the paper's."""

import time
from typing import Annotated

import typer

from isocharge.cli.shared.options import NewFolderOption, WorkersOption, most_workers
from isocharge.cli.shared.terminal import progress_rows, say

ROWS = (("solving the films", "tasks"), ("triangulating", ""), ("drawing", "figures"))
"""Titles and units of the progress bars."""


def paper_command(
    output: NewFolderOption,
    workers: WorkersOption = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer presses and films, in about a minute. (default: everything)")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the numbers, as in paper.json. (default: no)")] = False,
) -> None:
    """Reproduce Mirbagheri et al. (2007): its figures and numbers next to ours, and why they differ.

    Writes paper.md, paper.json and each figure (mm, pC, N) as PNG and SVG into a new folder.

    Example: isocharge simulate paper -o paper
    """
    from isocharge.common.files import refuse_existing
    from isocharge.simulate.execution.workers import local_workers
    from isocharge.simulate.paper import Choices, write_paper

    refuse_existing(output)
    began = time.perf_counter()
    choices = Choices.quick() if quick else Choices()
    with local_workers(most_workers(workers)) as pool, progress_rows(*ROWS) as (solved, triangulated, drawn):
        write_paper(output, choices, pool, solved=solved, triangulated=triangulated, drawn=drawn)
    if json:
        typer.echo((output / "paper.json").read_text("utf-8"), nl=False)
    say(f"{output / 'paper.md'}, {time.perf_counter() - began:.0f} s")
