"""What each figure of the paper gives to the page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure


@dataclass(frozen=True)
class Row:
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
        return f"{word}-{int(number):02d}" if number.isdigit() else "-".join(self.heading.lower().split())
