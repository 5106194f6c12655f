"""From nothing to the folder: solve, triangulate, draw, write."""

import time
from collections.abc import Iterator
from pathlib import Path

from isocharge.common.files import new_folder
from isocharge.common.progress import Progress
from isocharge.simulate.execution.workers import Workers
from isocharge.simulate.paper.choices import Choices
from isocharge.simulate.paper.claims import claims, what_choices_change
from isocharge.simulate.paper.entry import Entry
from isocharge.simulate.paper.equation_4 import eq_4
from isocharge.simulate.paper.figure_contours import fig_9, fig_10, fig_11
from isocharge.simulate.paper.figure_curves import fig_6, fig_8, fig_12
from isocharge.simulate.paper.figure_layouts import fig_1, fig_2, fig_3, fig_4, fig_5, fig_7
from isocharge.simulate.paper.page import as_json, page
from isocharge.simulate.paper.solves import Solves, solve_all
from isocharge.simulate.paper.triangulation_errors import Accuracy
from isocharge.simulate.plots.figure import save_picture

FIGURES = 15
"""Number of entries of the page."""


def write_paper(
    output: Path,
    choices: Choices | None = None,
    workers: Workers | None = None,
    *,
    solved: Progress | None = None,
    triangulated: Progress | None = None,
    drawn: Progress | None = None,
) -> tuple[Entry, ...]:
    """Reproduce the paper in a new folder: paper.md, paper.json, and every figure as PNG and SVG.

    Args:
        output: The folder to make.
        choices: What the paper leaves open.
        workers: Worker processes; this process if absent. The result does not depend on them.
        solved: Called with the number of solved jobs, and all.
        triangulated: Called with the number of finished triangulation methods, and all.
        drawn: Called with the number of drawn figures, and all.

    Returns:
        The entries of the page.

    Raises:
        OutputExists: If the folder exists.
    """
    began = time.perf_counter()
    choices, workers = choices or Choices(), workers or Workers()
    with new_folder(output) as draft:
        solves = solve_all(choices, workers, solved)
        accuracy = Accuracy.of(solves, workers, triangulated)
        entries = []
        for entry in make_entries(solves, accuracy):
            if entry.figure is not None:
                save_picture(entry.figure, draft / f"{entry.slug}.png")
                entry.figure.set_layout_engine("none")  # as it was laid out, which takes as long as drawing it
                save_picture(entry.figure, draft / f"{entry.slug}.svg")
            entries.append(entry)
            if drawn:
                drawn(len(entries), FIGURES)
        seconds = time.perf_counter() - began
        (draft / "paper.json").write_text(as_json(entries), "utf-8")
        (draft / "paper.md").write_text(page(entries, choices, seconds), "utf-8")
    return tuple(entries)


def make_entries(solves: Solves, accuracy: Accuracy) -> Iterator[Entry]:
    """Every figure in the paper's order, then eq. 4, the claims and our choices."""
    for make in (fig_1, fig_2, fig_3, fig_4, fig_5, fig_6, fig_7, fig_8):
        yield make(solves)
    yield fig_9(solves, accuracy)
    yield fig_10(solves, accuracy)
    yield fig_11(solves)
    yield fig_12(solves)
    yield eq_4(solves)
    yield claims(solves, accuracy)
    yield what_choices_change(solves, accuracy)
