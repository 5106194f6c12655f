"""One computed sentence: is any method both faster and more accurate than the released model?"""

from collections.abc import Sequence
from typing import Any

from isocharge.train.report.measures import COST_SIGNS, MethodRecord, Plot

WORDS: dict[Plot, str] = {"latency": "single predictions", "throughput": "batches"}
"""The plots that are compared, and their names in a sentence."""


def verdict(records: Sequence[MethodRecord]) -> dict[str, Any]:
    """Which methods beat the released model, in sentences and as labels.

    Args:
        records: Of all methods, the released one first.

    Returns:
        "sentences", and "both": for latency and throughput the labels of methods that are faster and more accurate.
    """
    released, others = records[0], [record for record in records[1:] if record.competes]
    both = {
        plot: [
            record.label
            for record in others
            if record.error_mm < released.error_mm and _speed(record, released, plot) > 1.0
        ]
        for plot in WORDS
    }
    groups = {
        "other methods": [record for record in others if record.kind != "network"],
        "networks that give the contact alone": [record for record in others if record.kind == "network"],
    }
    sentences = [_sentence(plot, released, group, kind) for kind, group in groups.items() if group for plot in WORDS]
    return {"both": both, "sentences": sentences}


def _speed(record: MethodRecord, released: MethodRecord, plot: Plot) -> float:
    """How many times as fast as the released model a method is."""
    return float((released.cost(plot) / record.cost(plot)) ** COST_SIGNS[plot])


def _sentence(plot: Plot, released: MethodRecord, others: Sequence[MethodRecord], kind: str) -> str:
    faster = [record for record in others if _speed(record, released, plot) > 1.0]
    if not faster:
        return f"In {WORDS[plot]}, none of {len(others)} {kind} is faster than the released model."
    nearest = min(faster, key=lambda record: record.error_mm)
    both = sum(record.error_mm < released.error_mm for record in faster)
    error = 100.0 * (nearest.error_mm / released.error_mm - 1.0)
    more = f"{abs(error):.2g} % {'less' if error < 0.0 else 'more'} error"
    return (
        f"In {WORDS[plot]}, {both or 'none'} of {len(others)} {kind} {'are' if both > 1 else 'is'} both faster and "
        f"more accurate than the released model. Of those that are faster the most accurate is {nearest.label} "
        f"({_speed(nearest, released, plot):.3g} times as fast, {more})."
    )
