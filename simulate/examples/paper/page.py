"""Entries of the page about the paper, and the files paper.md and paper.json."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from choices import Choices
from matplotlib.figure import Figure

from isocharge.common.structs import plain_values

INTRODUCTION = """# Mirbagheri et al. (2007), reproduced

A. Mirbagheri, S. Najarian, J. Dargahi, F. Tabatabai Ghomshe: Mathematical Modeling of a Tactile Sensor with
Applications in Minimally Invasive Surgery. American Journal of Applied Sciences 4 (10), 779-785.

This page compares every figure and number of the paper with ours, and explains the differences. Our figures are
computed for our own film. Where the paper does not state a value, we have chosen one
([influence of these choices](#what-the-paper-does-not-give)). The file `paper.json` contains the same numbers.
"""


HEADS = ("what", "paper", "ours", "what explains it")
"""Headers of the columns of a table of rows."""


class Row(NamedTuple):
    """One number or claim of the paper.

    Attributes:
        what: Name of the number, or the claim.
        paper: Value in the paper.
        ours: Our value.
        why: Explanation of the difference.
    """

    what: str
    paper: str
    ours: str
    why: str


@dataclass(frozen=True)
class Entry:
    """One figure or section of the page.

    Attributes:
        heading: Heading of the section, such as "Fig. 6" or "Eq. 4".
        caption: Caption of the figure.
        figure: The picture; None if the section has no picture.
        rows: Numbers and claims.
        numbers: Numbers for programs, with the units in the keys.
    """

    heading: str
    caption: str
    figure: Figure | None = None
    rows: Sequence[Row] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)

    @property
    def slug(self) -> str:
        """File name of the picture, without suffix: "fig-06"."""
        word, _, number = self.heading.lower().partition(". ")
        return f"{word}-{int(number):02d}"


def page(entries: Sequence[Entry], choices: Choices, seconds: float) -> str:
    """Return the whole page as Markdown.

    Args:
        entries: Figures and sections of the page.
        choices: Values that the paper does not state.
        seconds: Duration of the computation, s.
    """
    film = choices.sensor("three").film
    probes = ", ".join(probe.notation for probe in (choices.triangle, choices.rectangle, choices.circle))
    settings = (
        f"Film: radius {film.radius:g} mm, {1e3 * film.thickness:g} um, E {1e-3 * film.young:g} GPa, nu "
        f"{film.poisson:g}, no pretension. Probes, mm: {probes}. Readout: {choices.readout} (eq. 3). Force 1 N. "
        f"Working area: {choices.radius:g} mm, up to {choices.presses} presses spread over it. Computed in "
        f"{seconds:.0f} s."
    )
    rows = [(entry.heading, *row) for entry in entries for row in entry.rows]
    parts = [INTRODUCTION, settings, "\n## Table\n", _table(("figure", *HEADS), rows)]
    for entry in entries:
        shown = (
            _table(HEADS, entry.rows)
            if entry.figure is None
            else f"![{entry.heading}: {entry.caption}]({entry.slug}.png)\n\n[as SVG]({entry.slug}.svg)"
        )
        parts += [f"\n## {entry.heading}\n\n{entry.caption}", f"\n{shown}"]
    return "\n".join(parts) + "\n"


def _table(heads: Sequence[str], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a table in Markdown from the headers of its columns and its rows."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def as_json(entries: Sequence[Entry]) -> str:
    """Return the numbers and the rows of all entries by their headings, as JSON. NaN becomes null."""
    numbers = {entry.heading: {**entry.numbers, "rows": [row._asdict() for row in entry.rows]} for entry in entries}
    return json.dumps(plain_values(numbers), indent=1, allow_nan=False) + "\n"
