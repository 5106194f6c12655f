"""Reproduce the figures and numbers of the paper: `python simulate/examples/paper -o paper`.

The files paper.md and paper.json, and each figure as PNG and SVG, are written into a new folder. This takes five
minutes on two cores.
"""

import argparse
import time
from functools import partial
from pathlib import Path

from choices import FIG_8_DEG, QUICK, Choices
from claims import claims, what_choices_change
from equation_4 import eq_4
from figure_contours import fig_9, fig_10, fig_11
from figure_curves import fig_6, fig_8, fig_12
from figure_layouts import FIG_4_DEG, fig_1, fig_2, fig_3, fig_5, scheme
from page import as_json, page
from solves import solve_all
from triangulation_errors import Accuracy

from isocharge.cli.shared.terminal import shown_progress
from isocharge.common.files import new_folder
from isocharge.common.progress import track
from isocharge.simulate import local_workers
from isocharge.simulate.execution import cores
from isocharge.simulate.plots.figure import save_picture


def write_paper(output: Path, choices: Choices, workers: int) -> None:
    """Reproduce the paper in a new folder.

    Args:
        output: Folder to create.
        choices: Values that the paper does not state.
        workers: Number of worker processes, on which the result does not depend.
    """
    began = time.perf_counter()
    with new_folder(output) as draft, local_workers(workers) as executor:
        solves = solve_all(choices, executor)
        accuracy = Accuracy.of(solves, executor)
        makers = (  # functions that create the entries of the page, in their order
            *(partial(make, solves) for make in (fig_1, fig_2, fig_3)),
            partial(scheme, solves, "Fig. 4", "A", FIG_4_DEG),
            *(partial(make, solves) for make in (fig_5, fig_6)),
            partial(scheme, solves, "Fig. 7", "B", FIG_8_DEG),
            partial(fig_8, solves),
            *(partial(make, solves, accuracy) for make in (fig_9, fig_10)),
            *(partial(make, solves) for make in (fig_11, fig_12, eq_4)),
            *(partial(make, solves, accuracy) for make in (claims, what_choices_change)),
        )
        entries = []
        for make in track(makers, "drawing"):
            entry = make()
            entries.append(entry)
            if entry.figure is not None:
                save_picture(entry.figure, draft / f"{entry.slug}.png")
                entry.figure.set_layout_engine("none")  # keep the layout of the PNG, because a new layout takes long
                save_picture(entry.figure, draft / f"{entry.slug}.svg")
        (draft / "paper.json").write_text(as_json(entries), "utf-8")
        (draft / "paper.md").write_text(page(entries, choices, time.perf_counter() - began), "utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder to create")
    parser.add_argument("--quick", action="store_true", help="use fewer presses and films; takes a minute")
    parser.add_argument("--workers", type=int, default=cores(), help="processes (default: one per core)")
    arguments = parser.parse_args()
    with shown_progress():
        write_paper(arguments.output, QUICK if arguments.quick else Choices(), arguments.workers)
