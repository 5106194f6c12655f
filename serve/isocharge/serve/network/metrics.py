"""Metrics of the models of a server, for Prometheus and for the statistics of Triton's protocol.

The objects of the package `prometheus_client` are the only counters. A request updates them in a few microseconds.
"""

import time
from typing import Any

import onnxruntime as ort
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, ProcessCollector
from prometheus_client.metrics import MetricWrapperBase

from isocharge.common.versions import package_version

CONTENT_TYPE = b"text/plain; version=0.0.4; charset=utf-8"
"""Content type of the text format, which every version of Prometheus can read."""

VERSION_LABELS = ("model", "version")
"""Labels of the metrics that have one value for each version of a model."""

LATENCY_BOUNDS_S = (1e-5, 2e-5, 3e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 2e-2)
"""Upper bounds of the buckets of the latency histogram, s.

They range from half the latency of a single press to three times the latency of the largest batch.
"""


class ModelMetrics:
    """Metrics of all models of one server, in a registry that also contains the metrics of the process.

    Attributes:
        registry: The registry.
    """

    def __init__(self) -> None:
        """Create the metrics, which have no values before `of` is called."""
        registry = self.registry = CollectorRegistry(auto_describe=False)
        ProcessCollector(registry=registry)
        versions = Info("isocharge", "Versions of the server.", registry=registry)
        versions.info({"version": package_version(), "onnxruntime": ort.__version__})
        settings: dict[str, Any] = {"labelnames": VERSION_LABELS, "registry": registry}
        self.descriptions = Info("isocharge_model", "Versions of the models.", **settings)
        self.ready = Gauge("isocharge_model_ready", "Whether a version is loaded.", **settings)
        self.presses = Counter("isocharge_presses", "Presses that were answered.", **settings)
        self.alarms = Counter(
            "isocharge_misfit_alarms", "Presses whose misfit is above the limit of the model.", **settings
        )
        self.refused = Counter(
            "isocharge_inferences_refused", "Requests for an inference that were refused.", **settings
        )
        self.latency = Histogram(
            "isocharge_inference_seconds",
            "Time to read, compute and write an inference, without the network.",
            buckets=LATENCY_BOUNDS_S,
            **settings,
        )
        self.refused_time = Counter("isocharge_refused_seconds", "Time of refused requests.", **settings)
        self.latest = Gauge("isocharge_inference_latest_seconds", "Unix time of the latest inference.", **settings)


class Statistics:
    """Metrics of one version of a model since the start of the server. Any thread may call any method.

    Attributes:
        description: Sensor and checksum of the version.
        ready: 1 if the version is loaded, otherwise 0.
    """

    def __init__(self, metrics: ModelMetrics, name: str, version: int) -> None:
        """Create the values of a version in the metrics of the server."""
        labels = (name, str(version))
        self.description = metrics.descriptions.labels(*labels)
        self.ready = metrics.ready.labels(*labels)
        self._presses = metrics.presses.labels(*labels)
        self._alarms = metrics.alarms.labels(*labels)
        self._refused = metrics.refused.labels(*labels)
        self._latency = metrics.latency.labels(*labels)
        self._refused_time = metrics.refused_time.labels(*labels)
        self._latest = metrics.latest.labels(*labels)

    def count_answered(self, presses: int, duration_ns: int, alarms: int = 0) -> None:
        """Count a request that was answered.

        Args:
            presses: Number of presses in the request.
            duration_ns: Time to read the request, to run the model and to write the response, ns.
            alarms: Number of presses whose misfit is above the limit.
        """
        self._presses.inc(presses)
        self._alarms.inc(alarms)
        self._latency.observe(duration_ns / 1e9)
        self._latest.set(time.time())

    def count_refused(self, ns: int) -> None:
        """Count a request that was refused.

        Args:
            ns: Time from the complete request to the refusal, ns.
        """
        self._refused.inc()
        self._refused_time.inc(ns / 1e9)

    def to_json(self) -> dict[str, Any]:
        """Return the counters as a JSON object with the names that Triton uses in its statistics."""
        answered = int(_value(self._latency, "_count"))
        answered_ns = round(1e9 * _value(self._latency, "_sum"))
        refused = int(_value(self._refused, "_total"))
        refused_ns = round(1e9 * _value(self._refused_time, "_total"))
        return {
            "last_inference": round(1e3 * _value(self._latest, "")),
            "inference_count": int(_value(self._presses, "_total")),
            "execution_count": answered,
            "inference_stats": {
                "success": {"count": answered, "ns": answered_ns},
                "fail": {"count": refused, "ns": refused_ns},
            },
            "batch_stats": [],
        }


def _value(metric: MetricWrapperBase, ending: str) -> float:
    """Return the value of a metric with labels whose name has the given ending."""
    (family,) = metric.collect()
    return next(sample.value for sample in family.samples if sample.name == f"{family.name}{ending}")
