"""How often a served model was asked, and where the time went: the counters of Triton's statistics extension."""

import threading
import time
from dataclasses import dataclass, field
from typing import Any

STAGES = ("compute_input", "compute_infer", "compute_output")
"""Reading the request, running the model, writing the answer."""


@dataclass
class Duration:
    """How often something happened and how long it took altogether, ns."""

    count: int = 0
    ns: int = 0

    def add(self, ns: int) -> None:
        """Once more, ns long."""
        self.count += 1
        self.ns += ns


@dataclass
class Statistics:
    """Counters of one version of a model; any thread may add to them."""

    inference_count: int = 0
    execution_count: int = 0
    last_inference_ms: int = 0
    success: Duration = field(default_factory=Duration)
    fail: Duration = field(default_factory=Duration)
    stages: tuple[Duration, ...] = field(default_factory=lambda: tuple(Duration() for _ in STAGES))
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def succeeded(self, rows: int, stages_ns: tuple[int, ...]) -> None:
        """A request for so many presses was answered; `stages_ns` in the order of STAGES."""
        with self._lock:
            self.inference_count += rows
            self.execution_count += 1
            self.last_inference_ms = time.time_ns() // 1_000_000
            self.success.add(sum(stages_ns))
            for stage, ns in zip(self.stages, stages_ns, strict=True):
                stage.add(ns)

    def failed(self, ns: int) -> None:
        """A request was refused after so long."""
        with self._lock:
            self.fail.add(ns)

    def to_json(self) -> dict[str, Any]:
        """The counters as Triton words them; nothing queues here and nothing is cached."""
        with self._lock:
            spent = dict(zip(STAGES, self.stages, strict=True))
            durations = {"success": self.success, "fail": self.fail, "queue": Duration(self.success.count), **spent}
            return {
                "last_inference": self.last_inference_ms,
                "inference_count": self.inference_count,
                "execution_count": self.execution_count,
                "inference_stats": {name: {"count": of.count, "ns": of.ns} for name, of in durations.items()},
                "batch_stats": [],
            }
