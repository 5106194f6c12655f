"""Requests to a model, and the time they took: the counters of Triton's statistics extension."""

import threading
import time
from dataclasses import dataclass, field
from typing import Any

STAGES = ("compute_input", "compute_infer", "compute_output")
"""Triton's names for reading the request, running the model, writing the answer."""


@dataclass
class Statistics:
    """Counters of one version of a model; any thread may add to them.

    Attributes:
        presses: Rows that were answered.
        answered, refused: Numbers of requests.
        stages_ns: Time spent on the answered ones in each of STAGES.
        refused_ns: Time spent on the others.
        last_ms: Time of the last answer, unix time, ms.
    """

    presses: int = 0
    answered: int = 0
    refused: int = 0
    stages_ns: list[int] = field(default_factory=lambda: [0] * len(STAGES))
    refused_ns: int = 0
    last_ms: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def succeeded(self, presses: int, stages_ns: tuple[int, int, int]) -> None:
        """Count an answered request: its number of presses, and its time in each of STAGES."""
        spent = self.stages_ns
        with self._lock:
            self.presses += presses
            self.answered += 1
            spent[0] += stages_ns[0]
            spent[1] += stages_ns[1]
            spent[2] += stages_ns[2]
            self.last_ms = time.time_ns() // 1_000_000

    def failed(self, ns: int) -> None:
        """Count a refused request and the time that it took."""
        with self._lock:
            self.refused += 1
            self.refused_ns += ns

    def to_json(self) -> dict[str, Any]:
        """The counters under Triton's names; no request waits in a queue."""
        with self._lock:
            spent = dict(zip(STAGES, self.stages_ns, strict=True)) | {"queue": 0, "success": sum(self.stages_ns)}
            durations = {name: {"count": self.answered, "ns": ns} for name, ns in spent.items()}
            return {
                "last_inference": self.last_ms,
                "inference_count": self.presses,
                "execution_count": self.answered,
                "inference_stats": {**durations, "fail": {"count": self.refused, "ns": self.refused_ns}},
                "batch_stats": [],
            }
