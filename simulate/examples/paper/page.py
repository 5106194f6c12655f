"""What each figure gives to the page, and the page: paper.md and paper.json."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from choices import Choices
from matplotlib.figure import Figure

from isocharge.common.json_values import plain_values

INTRODUCTION = """# Mirbagheri et al. (2007), reproduced

A. Mirbagheri, S. Najarian, J. Dargahi, F. Tabatabai Ghomshe: Mathematical Modeling of a Tactile Sensor with
Applications in Minimally Invasive Surgery. American Journal of Applied Sciences 4 (10), 779-785.

Every figure and number of the paper, ours beside it, and what explains the difference. The figures are drawn from our
own film; where the paper gives no size the choice is ours ([what that changes](#what-the-paper-does-not-give)). The
same numbers are in `paper.json`.
"""


HEADS = ("what", "paper", "ours", "what explains it")
"""Heads of the columns of a table of rows."""


class Row(NamedTuple):
    """One number or claim: what, the paper's value, ours, and what explains the difference."""

    what: str
    paper: str
    ours: str
    why: str


@dataclass(frozen=True)
class Entry:
    """One figure or section of the page.

    Attributes:
        heading: "Fig. 6", "Eq. 4", ...
        caption: What the figure shows.
        figure: The picture.
        rows: Numbers and claims.
        numbers: For programs, units in the keys.
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
    """The whole page as Markdown."""
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
    lines = ["| " + " | ".join(cells) + " |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def as_json(entries: Sequence[Entry]) -> str:
    """The numbers by heading, rows included, as JSON; NaN becomes null."""
    numbers = {entry.heading: {**entry.numbers, "rows": [row._asdict() for row in entry.rows]} for entry in entries}
    return json.dumps(plain_values(numbers), indent=1, allow_nan=False) + "\n"
