"""Colours and lines that the report's pictures have in common."""

from isocharge.simulate.plots.figure import FELT
from isocharge.train.report.limits import BAYES, CRAMER_RAO

GREY, RELEASED = "#8a95a5", FELT
"""Colours of what is beside the point, and of the released model."""

LINES = ("#2b6cb0", "#2f7f6f", "#c47f17", "#7a5195", "#8c564b", "#4c9be8")
"""Colours of methods where kinds do not tell them apart."""

LIMIT_STYLES = {BAYES: "-", CRAMER_RAO: ":"}
"""How the limits are drawn."""
