"""`/metrics`: the counters of models and traffic in the text format of Prometheus.

Requests only add to plain counters; the families are built when somebody asks for them. So a request pays a fraction of
a microsecond, where a histogram of the client library would cost it several.
"""

from collections.abc import Iterable
from itertools import accumulate, chain

import onnxruntime as ort
from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.traffic import LATENCY_NS, STAGES, Statistics, Traffic

CONTENT_TYPE = b"text/plain; version=0.0.4; charset=utf-8"
"""The format that every Prometheus reads, whatever it asks for."""

VERSION = ("model", "version")
"""Labels of what is counted for each version of a model."""

BOUNDS = (*(f"{ns / 1e9:g}" for ns in LATENCY_NS), "+Inf")

_Counters = dict[tuple[str, str], Statistics]


class Metrics(Collector):
    """The metrics of one server; its families are built anew for each scrape."""

    def __init__(self, store: ModelStore, traffic: Traffic, server_version: str) -> None:
        """Report the models of a store and the traffic of their servers."""
        self._store, self._traffic, self._version = store, traffic, server_version
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """All metrics, in the format of CONTENT_TYPE."""
        return generate_latest(self._registry)

    def collect(self) -> Iterable[Metric]:
        counters = self._store.counters()
        versions = {"version": self._version, "onnxruntime": ort.__version__}
        yield InfoMetricFamily("isocharge", "Versions of the server.", versions)
        yield from chain(_models(self._store), _traffic(self._traffic), _inferences(counters), _latencies(counters))


def _models(store: ModelStore) -> Iterable[Metric]:
    info = InfoMetricFamily("isocharge_model", "Versions of models that serve.", labels=VERSION)
    for loaded in store.all():
        facts = {"sensor": loaded.metadata.frame_id, "sha256": loaded.model.golden.sha256}
        info.add_metric((loaded.metadata.name, loaded.version), facts)
    ready = GaugeMetricFamily("isocharge_model_ready", "1 if the version serves, 0 if it was refused.", labels=VERSION)
    for row in store.known():
        ready.add_metric((row["name"], row["version"]), row["state"] == "READY")
    return info, ready


def _traffic(traffic: Traffic) -> Iterable[Metric]:
    requests = CounterMetricFamily(
        "isocharge_requests", "Requests that were answered or refused.", labels=("transport", "route", "status")
    )
    for kind, count in sorted(traffic.requests().items()):
        requests.add_metric(kind, count)
    opened = GaugeMetricFamily("isocharge_open", "Open connections of HTTP, open calls of gRPC.", labels=("transport",))
    for transport, number in traffic.open.items():
        opened.add_metric((transport,), number())
    lost = CounterMetricFamily("isocharge_log_lines_lost", "Lines of the log that nobody took.")
    lost.add_metric((), traffic.lost_lines() if traffic.lost_lines else 0)
    return requests, opened, lost


def _inferences(counters: _Counters) -> Iterable[Metric]:
    plain = {
        "presses": ("presses", "Presses that were answered."),
        "misfit_checked": ("checked", "Presses whose misfit was computed."),
        "misfit_alarms": ("alarms", "Presses whose misfit is above the limit of the model."),
        "inferences_refused": ("refused", "Requests for an inference that were refused."),
    }
    for name, (attribute, text) in plain.items():
        family = CounterMetricFamily(f"isocharge_{name}", text, labels=VERSION)
        for labels, of in counters.items():
            family.add_metric(labels, getattr(of, attribute))
        yield family


def _latencies(counters: _Counters) -> Iterable[Metric]:
    latency = HistogramMetricFamily(
        "isocharge_inference_seconds",
        "Time to read, compute and write an inference, without the network.",
        labels=VERSION,
    )
    stages = CounterMetricFamily(
        "isocharge_inference_stage_seconds", "The same by stage, under the names of Triton.", labels=(*VERSION, "stage")
    )
    for labels, of in counters.items():
        buckets = list(zip(BOUNDS, accumulate(of.latency), strict=True))
        latency.add_metric(labels, buckets, sum(of.stages_ns) / 1e9)
        for stage, ns in zip(STAGES, of.stages_ns, strict=True):
            stages.add_metric((*labels, stage), ns / 1e9)
    return latency, stages
