"""The page and the numbers: paper.md and paper.json."""

import json
from collections.abc import Sequence

from choices import Choices
from entry import Entry

from isocharge.common.json_values import plain_values

INTRODUCTION = """# Mirbagheri et al. (2007), reproduced

A. Mirbagheri, S. Najarian, J. Dargahi, F. Tabatabai Ghomshe: Mathematical Modeling of a Tactile Sensor with
Applications in Minimally Invasive Surgery. American Journal of Applied Sciences 4 (10), 779-785.

Every figure and number of the paper, ours beside it, and what explains the difference. The figures are drawn from our
own film; where the paper gives no size the choice is ours ([what that changes](#what-the-paper-does-not-give)). The
same numbers are in `paper.json`.
"""


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
    parts = [INTRODUCTION, settings, "\n## Table\n", _table(entries)]
    for entry in entries:
        parts.append(f"\n## {entry.heading}\n\n{entry.caption}")
        if entry.figure is not None:
            parts.append(f"\n![{entry.heading}: {entry.caption}]({entry.slug}.png)\n\n[as SVG]({entry.slug}.svg)")
        else:
            parts.append("\n" + _table([entry], headings=False))
    return "\n".join(parts) + "\n"


def _table(entries: Sequence[Entry], headings: bool = True) -> str:
    lines = ["| figure | what | paper | ours | what explains it |", "|---|---|---|---|---|"]
    if not headings:
        lines = ["| what | paper | ours | what explains it |", "|---|---|---|---|"]
    for entry in entries:
        for row in entry.rows:
            cells = [row.what, row.paper, row.ours, row.why]
            lines.append("| " + " | ".join([entry.heading, *cells] if headings else cells) + " |")
    return "\n".join(lines)


def numbers(entries: Sequence[Entry]) -> dict[str, object]:
    """Everything by heading, rows included, as plain values."""
    return {
        entry.heading: {
            **entry.numbers,
            "rows": [{"what": r.what, "paper": r.paper, "ours": r.ours, "why": r.why} for r in entry.rows],
        }
        for entry in entries
    }


def as_json(entries: Sequence[Entry]) -> str:
    """The numbers as JSON; NaN becomes null."""
    return json.dumps(plain_values(numbers(entries)), indent=1, allow_nan=False) + "\n"
