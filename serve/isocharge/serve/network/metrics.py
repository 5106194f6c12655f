"""Metrics in the text format of Prometheus, which the server returns under the path `/metrics`.

While a request is answered, only plain integers are incremented, which takes a fraction of a microsecond. Updating a
histogram of the package `prometheus_client` would take several microseconds. The metrics are computed from these
integers only when Prometheus requests the metrics.
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
"""Content type of the text format, which every version of Prometheus can read."""

VERSION_LABELS = ("model", "version")
"""Labels of the metrics that have one value for each version of a model."""

BUCKET_BOUNDS = (*(f"{ns / 1e9:g}" for ns in LATENCY_BOUNDS_NS), "+Inf")
"""Upper bounds of the buckets of the latency histogram, s, as texts."""

_Counters = dict[tuple[str, str], Statistics]
"""Counters of each version of each model, by the name of the model and the number of the version."""


class Metrics(Collector):
    """Metrics of one server, which are computed whenever Prometheus requests them."""

    def __init__(self, store: ModelStore, traffic: Traffic, server_version: str) -> None:
        """Create a registry, and register the metrics of the server and of its process.

        Args:
            store: Store of the models that the server uses.
            traffic: Counters of the requests and connections of the server.
            server_version: Installed version of isocharge.
        """
        self._store = store
        self._traffic = traffic
        self._version = server_version
        self._registry = CollectorRegistry(auto_describe=False)  # so that `register` does not call `collect`
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """Return all metrics as text in the format of `CONTENT_TYPE`."""
        return generate_latest(self._registry)

    def collect(self) -> Iterable[Metric]:
        """Yield all metrics of the server. The registry calls this method whenever Prometheus requests the metrics."""
        counters = self._store.counters()
        versions = {"version": self._version, "onnxruntime": ort.__version__}
        yield InfoMetricFamily("isocharge", "Versions of the server.", versions)
        yield from _model_families(self._store)
        yield from _traffic_families(self._traffic)
        yield from _inference_families(counters)
        yield from _latency_families(counters)


def _model_families(store: ModelStore) -> Iterable[Metric]:
    """Return the metrics `isocharge_model` and `isocharge_model_ready`.

    The metric `isocharge_model` contains the sensor and the checksum of each loaded version. The metric
    `isocharge_model_ready` states whether each version is loaded.
    """
    info = InfoMetricFamily("isocharge_model", "Loaded versions of the models.", labels=VERSION_LABELS)
    for loaded in store.loaded_versions():
        properties = {"sensor": loaded.metadata.frame_id, "sha256": loaded.model.golden.sha256}
        info.add_metric((loaded.metadata.name, loaded.version), properties)
    ready = GaugeMetricFamily(
        "isocharge_model_ready", "1 if the version is loaded, 0 if it was refused.", labels=VERSION_LABELS
    )
    for row in store.version_states():
        is_ready = row["state"] == "READY"  # Prometheus receives 1 or 0
        ready.add_metric((row["name"], row["version"]), is_ready)
    return info, ready


def _traffic_families(traffic: Traffic) -> Iterable[Metric]:
    """Return the metrics that count requests, open connections and lost log lines."""
    requests = CounterMetricFamily(
        "isocharge_requests", "Requests that were answered or refused.", labels=("transport", "route", "status")
    )
    for labels, count in sorted(traffic.requests().items()):
        requests.add_metric(labels, count)
    open_connections = GaugeMetricFamily(
        "isocharge_open", "Open connections of HTTP and open calls of gRPC.", labels=("transport",)
    )
    for transport, count_open in traffic.open.items():  # the transports are "http" and "grpc"
        open_connections.add_metric((transport,), count_open())
    lost_lines = CounterMetricFamily("isocharge_log_lines_lost", "Lines of the log that could not be written.")
    lost_line_count = 0 if traffic.lost_lines is None else traffic.lost_lines()
    lost_lines.add_metric((), lost_line_count)
    return requests, open_connections, lost_lines


def _inference_families(counters: _Counters) -> Iterable[Metric]:
    """Yield the metrics that count presses and refused inferences.

    Each metric has one value for each version of a model.

    Args:
        counters: Counters of each version, by name and version of the model.
    """
    # For each attribute of `Statistics`: name and description of the metric that contains the values of this attribute
    metrics_of_attribute = {
        "presses": ("isocharge_presses", "Presses that were answered."),
        "alarms": ("isocharge_misfit_alarms", "Presses whose misfit is above the limit of the model."),
        "refused": ("isocharge_inferences_refused", "Requests for an inference that were refused."),
    }
    for attribute, (metric_name, description) in metrics_of_attribute.items():
        family = CounterMetricFamily(metric_name, description, labels=VERSION_LABELS)
        for name_and_version, statistics in counters.items():
            family.add_metric(name_and_version, getattr(statistics, attribute))
        yield family


def _latency_families(counters: _Counters) -> Iterable[Metric]:
    """Return the metrics with the latency histogram and with the total time of each stage of an inference.

    Both metrics have values for each version of a model.

    Args:
        counters: Counters of each version, by name and version of the model.
    """
    latency = HistogramMetricFamily(
        "isocharge_inference_seconds",
        "Time to read, compute and write an inference, without the network.",
        labels=VERSION_LABELS,
    )
    stage_times = CounterMetricFamily(
        "isocharge_inference_stage_seconds",
        "Time of each stage of an inference, under the names of Triton.",
        labels=(*VERSION_LABELS, "stage"),
    )
    for name_and_version, statistics in counters.items():
        # In Prometheus, the count of a bucket includes the counts of all lower buckets.
        cumulative_counts = accumulate(statistics.latency)
        buckets = list(zip(BUCKET_BOUNDS, cumulative_counts, strict=True))
        total_s = sum(statistics.stages_ns) / 1e9
        latency.add_metric(name_and_version, buckets, total_s)
        for stage, stage_ns in zip(STAGES, statistics.stages_ns, strict=True):
            stage_times.add_metric((*name_and_version, stage), stage_ns / 1e9)
    return latency, stage_times
