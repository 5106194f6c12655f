"""Counters of models and traffic in the text format of Prometheus, for the path `/metrics`.

A request only increments plain integers, which takes a fraction of a microsecond. A histogram of the client library
would take several microseconds. The metric families are computed from the integers when Prometheus requests them.
"""

from collections.abc import Iterable
from itertools import accumulate

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
from isocharge.serve.network.traffic import LATENCY_BOUNDS_NS, STAGES, Statistics, Traffic

CONTENT_TYPE = b"text/plain; version=0.0.4; charset=utf-8"
"""Content type of the text format, which every version of Prometheus reads."""

VERSION_LABELS = ("model", "version")
"""Labels of the metrics of one version of a model."""

BUCKET_BOUNDS = (*(f"{ns / 1e9:g}" for ns in LATENCY_BOUNDS_NS), "+Inf")
"""Upper bounds of the latency histogram as texts, s."""

_Counters = dict[tuple[str, str], Statistics]


class Metrics(Collector):
    """Metrics of one server, computed for each scrape."""

    def __init__(self, store: ModelStore, traffic: Traffic, server_version: str) -> None:
        """Register the metrics of the server and of its process.

        Args:
            store: The models of the server.
            traffic: Counters of requests and connections.
            server_version: Version of isocharge.
        """
        self._store = store
        self._traffic = traffic
        self._version = server_version
        self._registry = CollectorRegistry(auto_describe=False)  # do not call `collect` at the registration
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """Return all metrics in the format of `CONTENT_TYPE`."""
        return generate_latest(self._registry)

    def collect(self) -> Iterable[Metric]:
        """Yield the metric families; the registry calls this method for each scrape."""
        counters = self._store.counters()
        versions = {"version": self._version, "onnxruntime": ort.__version__}
        yield InfoMetricFamily("isocharge", "Versions of the server.", versions)
        yield from _model_families(self._store)
        yield from _traffic_families(self._traffic)
        yield from _inference_families(counters)
        yield from _latency_families(counters)


def _model_families(store: ModelStore) -> Iterable[Metric]:
    """Return two metrics: the sensor and checksum of each loaded version, and the state of every version."""
    info = InfoMetricFamily("isocharge_model", "Loaded versions of the models.", labels=VERSION_LABELS)
    for loaded in store.loaded_versions():
        properties = {"sensor": loaded.metadata.frame_id, "sha256": loaded.model.golden.sha256}
        info.add_metric((loaded.metadata.name, loaded.version), properties)
    ready = GaugeMetricFamily(
        "isocharge_model_ready", "1 if the version is loaded, 0 if it was refused.", labels=VERSION_LABELS
    )
    for row in store.version_states():
        is_ready = row["state"] == "READY"  # exported as 1 or 0
        ready.add_metric((row["name"], row["version"]), is_ready)
    return info, ready


def _traffic_families(traffic: Traffic) -> Iterable[Metric]:
    """Return the metrics for requests, open connections and lost log lines."""
    requests = CounterMetricFamily(
        "isocharge_requests", "Requests that were answered or refused.", labels=("transport", "route", "status")
    )
    for labels, count in sorted(traffic.requests().items()):
        requests.add_metric(labels, count)
    opened = GaugeMetricFamily(
        "isocharge_open", "Open connections of HTTP and open calls of gRPC.", labels=("transport",)
    )
    for transport, count_open in traffic.open.items():  # one function for each transport: "http", "grpc"
        opened.add_metric((transport,), count_open())
    lost_lines = CounterMetricFamily("isocharge_log_lines_lost", "Lines of the log that could not be written.")
    lost_line_count = 0 if traffic.lost_lines is None else traffic.lost_lines()
    lost_lines.add_metric((), lost_line_count)
    return requests, opened, lost_lines


def _inference_families(counters: _Counters) -> Iterable[Metric]:
    """Yield one metric for each counter of presses and refused requests, with a value for each version of a model.

    Args:
        counters: Counters of each version, by the name and the version of the model.
    """
    metrics_of_attribute = {
        "presses": ("isocharge_presses", "Presses that were answered."),
        "checked": ("isocharge_misfit_checked", "Presses whose misfit was computed."),
        "alarms": ("isocharge_misfit_alarms", "Presses whose misfit is above the limit of the model."),
        "refused": ("isocharge_inferences_refused", "Requests for an inference that were refused."),
    }
    for attribute, (metric_name, description) in metrics_of_attribute.items():
        family = CounterMetricFamily(metric_name, description, labels=VERSION_LABELS)
        for name_and_version, statistics in counters.items():
            family.add_metric(name_and_version, getattr(statistics, attribute))
        yield family


def _latency_families(counters: _Counters) -> Iterable[Metric]:
    """Return the latency histogram and the time of each stage for each version of a model.

    Args:
        counters: Counters of each version, by the name and the version of the model.
    """
    latency = HistogramMetricFamily(
        "isocharge_inference_seconds",
        "Time to read, compute and write an inference, without the network.",
        labels=VERSION_LABELS,
    )
    stages = CounterMetricFamily(
        "isocharge_inference_stage_seconds",
        "Time of each stage of an inference, under the names of Triton.",
        labels=(*VERSION_LABELS, "stage"),
    )
    for name_and_version, statistics in counters.items():
        # A bucket of Prometheus includes all lower buckets.
        cumulative_counts = accumulate(statistics.latency)
        buckets = list(zip(BUCKET_BOUNDS, cumulative_counts, strict=True))
        total_s = sum(statistics.stages_ns) / 1e9
        latency.add_metric(name_and_version, buckets, total_s)
        for stage, stage_ns in zip(STAGES, statistics.stages_ns, strict=True):
            stages.add_metric((*name_and_version, stage), stage_ns / 1e9)
    return latency, stages
