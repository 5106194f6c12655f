"""Requests to a model, the time they took, and its misfit alarms: what Triton's statistics and `/metrics` report."""

import threading
import time
from bisect import bisect_left
from dataclasses import dataclass, field, replace
from typing import Any

STAGES = ("compute_input", "compute_infer", "compute_output")
"""Triton's names for reading the request, running the model, writing the answer."""

LATENCY_NS = (10_000, 20_000, 30_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000, 5_000_000, 20_000_000)
"""Upper bounds of the latency histogram: from half the time of one press to three times that of the largest batch."""


@dataclass
class Statistics:
    """Counters of one version of a model, from the start of the server; any thread may add to them.

    Attributes:
        presses: Rows that were answered.
        unchecked: Those of them whose misfit was not computed.
        alarms: Those of them whose misfit is above the limit of the model.
        answered, refused: Numbers of requests.
        latency: Answered requests by their time, those beyond the last of LATENCY_NS at the end.
        stages_ns: Time spent on the answered ones in each of STAGES.
        refused_ns: Time spent on the others.
        last_ms: Time of the last answer, unix time, ms.
    """

    presses: int = 0
    unchecked: int = 0
    alarms: int = 0
    answered: int = 0
    refused: int = 0
    latency: list[int] = field(default_factory=lambda: [0] * (len(LATENCY_NS) + 1))
    stages_ns: list[int] = field(default_factory=lambda: [0] * len(STAGES))
    refused_ns: int = 0
    last_ms: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock, compare=False)

    def succeeded(self, presses: int, stages_ns: tuple[int, int, int], unchecked: int = 0, alarms: int = 0) -> None:
        """Count an answered request.

        Args:
            presses: Rows of it.
            stages_ns: Its time in each of STAGES.
            unchecked: Rows whose misfit was not computed.
            alarms: Rows whose misfit is above the limit.
        """
        with self._lock:
            self.presses += presses
            self.unchecked += unchecked
            self.alarms += alarms
            self.answered += 1
            self.latency[bisect_left(LATENCY_NS, sum(stages_ns))] += 1
            self.stages_ns = [before + ns for before, ns in zip(self.stages_ns, stages_ns, strict=True)]
            self.last_ms = time.time_ns() // 1_000_000

    def failed(self, ns: int) -> None:
        """Count a refused request and the time that it took."""
        with self._lock:
            self.refused += 1
            self.refused_ns += ns

    @property
    def checked(self) -> int:
        """Presses whose misfit was computed."""
        return self.presses - self.unchecked

    def snapshot(self) -> "Statistics":
        """A copy, all of whose counters belong to the same moment."""
        with self._lock:
            return replace(self, latency=[*self.latency], _lock=threading.Lock())

    def to_json(self) -> dict[str, Any]:
        """The counters under Triton's names; no request waits in a queue."""
        now = self.snapshot()
        spent = dict(zip(STAGES, now.stages_ns, strict=True)) | {"queue": 0, "success": sum(now.stages_ns)}
        durations = {name: {"count": now.answered, "ns": ns} for name, ns in spent.items()}
        return {
            "last_inference": now.last_ms,
            "inference_count": now.presses,
            "execution_count": now.answered,
            "inference_stats": {**durations, "fail": {"count": now.refused, "ns": now.refused_ns}},
            "batch_stats": [],
        }
