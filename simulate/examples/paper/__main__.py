"""The paper's figures and numbers, ours beside them: `python simulate/examples/paper -o paper`.

Writes paper.md, paper.json, and every figure as PNG and SVG into a new folder; five minutes on two cores.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

from choices import QUICK, Choices
from claims import claims, what_choices_change
from equation_4 import eq_4
from figure_contours import fig_9, fig_10, fig_11
from figure_curves import fig_6, fig_8, fig_12
from figure_layouts import fig_1, fig_2, fig_3, fig_4, fig_5, fig_7
from page import Entry, as_json, page
from solves import Solves, solve_all
from triangulation_errors import Accuracy

from isocharge.cli.shared.terminal import shown_progress
from isocharge.common.files import new_folder
from isocharge.common.progress import track
from isocharge.simulate import local_workers
from isocharge.simulate.execution.workers import cores
from isocharge.simulate.plots.figure import save_picture

ENTRIES = 15
"""Number of entries of the page."""


def write_paper(output: Path, choices: Choices, workers: int) -> None:
    """Reproduce the paper in a new folder; the result does not depend on the number of worker processes."""
    began = time.perf_counter()
    with new_folder(output) as draft, local_workers(workers) as executor:
        solves = solve_all(choices, executor)
        entries = []
        for entry in track(make_entries(solves, Accuracy.of(solves, executor)), "drawing", ENTRIES):
            entries.append(entry)
            if entry.figure is not None:
                save_picture(entry.figure, draft / f"{entry.slug}.png")
                entry.figure.set_layout_engine("none")  # as it was laid out, which takes as long as drawing it
                save_picture(entry.figure, draft / f"{entry.slug}.svg")
        (draft / "paper.json").write_text(as_json(entries), "utf-8")
        (draft / "paper.md").write_text(page(entries, choices, time.perf_counter() - began), "utf-8")


def make_entries(solves: Solves, accuracy: Accuracy) -> Iterator[Entry]:
    """Every figure in the paper's order, then eq. 4, the claims and our choices."""
    for make in (fig_1, fig_2, fig_3, fig_4, fig_5, fig_6, fig_7, fig_8):
        yield make(solves)
    yield fig_9(solves, accuracy)
    yield fig_10(solves, accuracy)
    for make in (fig_11, fig_12, eq_4):
        yield make(solves)
    yield claims(solves, accuracy)
    yield what_choices_change(solves, accuracy)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder to make")
    parser.add_argument("--quick", action="store_true", help="fewer presses and films, coarser numbers; a minute")
    parser.add_argument("--workers", type=int, default=cores(), help="processes (default: one per core)")
    given = parser.parse_args()
    with shown_progress():
        write_paper(given.output, QUICK if given.quick else Choices(), given.workers)
