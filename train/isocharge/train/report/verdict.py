"""One computed sentence: is any method both faster and more accurate than the released model?"""

from collections.abc import Sequence
from typing import Any

from isocharge.train.report.methods import competes

PLOTS = {
    "latency": ("p50_us", 1.0, "single predictions"),
    "throughput": ("per_second", -1.0, "batches"),
}
"""What is compared: a figure, whether less (1) or more (-1) of it is better, and its words."""


def verdict(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Which methods beat the released model, in sentences and as labels.

    Args:
        records: Of all methods, the released one first.

    Returns:
        "sentences", and "both": for latency and throughput the labels of methods that are faster and more accurate.
    """
    released, others = records[0], [record for record in records[1:] if competes(record)]
    both = {plot: [r["label"] for r in others if _beats(r, released, *PLOTS[plot][:2])] for plot in PLOTS}
    rivals = [record for record in others if record["kind"] != "network"]
    networks = [record for record in others if record["kind"] == "network"]
    groups = [(rivals, "other methods"), (networks, "networks that give the contact alone")]
    sentences = [_sentence(plot, released, group, words) for group, words in groups if group for plot in PLOTS]
    return {"both": both, "sentences": sentences}


def _faster(record: dict[str, Any], released: dict[str, Any], key: str, sign: float) -> bool:
    return bool(sign * record[key] < sign * released[key])


def _beats(record: dict[str, Any], released: dict[str, Any], key: str, sign: float) -> bool:
    more_accurate = record["errors"]["position_rms_mm"] < released["errors"]["position_rms_mm"]
    return bool(more_accurate) and _faster(record, released, key, sign)


def _sentence(plot: str, released: dict[str, Any], others: Sequence[dict[str, Any]], kind: str) -> str:
    key, sign, words = PLOTS[plot]
    both = [record for record in others if _beats(record, released, key, sign)]
    if both:
        listed = "; ".join(_compared(record, released, key, sign) for record in both)
        count = f"{len(both)} of {len(others)} {kind}"
        return f"In {words}, both faster and more accurate than the released model: {count}. {listed}."
    faster = [record for record in others if _faster(record, released, key, sign)]
    if not faster:
        return f"In {words}, none of {len(others)} {kind} is faster than the released model."
    nearest = min(faster, key=lambda record: float(record["errors"]["position_rms_mm"]))
    return (
        f"In {words}, none of {len(others)} {kind} is both faster and more accurate than the released model. Of those "
        f"that are faster the most accurate is {_compared(nearest, released, key, sign)}."
    )


def _compared(record: dict[str, Any], released: dict[str, Any], key: str, sign: float) -> str:
    ratio = (released[key] / record[key]) ** sign
    error = 100.0 * (record["errors"]["position_rms_mm"] / released["errors"]["position_rms_mm"] - 1.0)
    more = f"{abs(error):.2g} % {'less' if error < 0.0 else 'more'} error" if error else "the same error"
    return f"{record['label']} ({ratio:.3g} times as fast, {more})"
