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
    both = {plot: [record.label for record in others if _beats(record, released, plot)] for plot in WORDS}
    rivals = [record for record in others if record.kind != "network"]
    networks = [record for record in others if record.kind == "network"]
    groups = [(rivals, "other methods"), (networks, "networks that give the contact alone")]
    sentences = [_sentence(plot, released, group, words) for group, words in groups if group for plot in WORDS]
    return {"both": both, "sentences": sentences}


def _faster(record: MethodRecord, released: MethodRecord, plot: Plot) -> bool:
    return COST_SIGNS[plot] * record.cost(plot) < COST_SIGNS[plot] * released.cost(plot)


def _beats(record: MethodRecord, released: MethodRecord, plot: Plot) -> bool:
    return record.error_mm < released.error_mm and _faster(record, released, plot)


def _sentence(plot: Plot, released: MethodRecord, others: Sequence[MethodRecord], kind: str) -> str:
    both = [record for record in others if _beats(record, released, plot)]
    if both:
        listed = "; ".join(_compared(record, released, plot) for record in both)
        count = f"{len(both)} of {len(others)} {kind}"
        return f"In {WORDS[plot]}, both faster and more accurate than the released model: {count}. {listed}."
    faster = [record for record in others if _faster(record, released, plot)]
    if not faster:
        return f"In {WORDS[plot]}, none of {len(others)} {kind} is faster than the released model."
    nearest = min(faster, key=lambda record: record.error_mm)
    return (
        f"In {WORDS[plot]}, none of {len(others)} {kind} is both faster and more accurate than the released model. Of "
        f"those that are faster the most accurate is {_compared(nearest, released, plot)}."
    )


def _compared(record: MethodRecord, released: MethodRecord, plot: Plot) -> str:
    ratio = (released.cost(plot) / record.cost(plot)) ** COST_SIGNS[plot]
    error = 100.0 * (record.error_mm / released.error_mm - 1.0)
    more = f"{abs(error):.2g} % {'less' if error < 0.0 else 'more'} error" if error else "the same error"
    return f"{record.label} ({ratio:.3g} times as fast, {more})"
