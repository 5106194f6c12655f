"""The metrics of the server, read by the parser of prometheus_client: counts, labels, and access by the token."""

import numpy as np
import orjson
from prometheus_client.parser import text_string_to_metric_families

from infer_requests import BODY, INFER, infer_request
from isocharge.serve.flags import MISFIT


def scrape(handler):
    """Return the value of each sample by its name and its sorted labels."""
    status, headers, text = handler.answer("GET", "/metrics", [], b"")
    assert status == 200
    assert dict(headers)[b"content-type"].startswith(b"text/plain; version=0.0.4")
    samples = [sample for family in text_string_to_metric_families(text.decode()) for sample in family.samples]
    samples = [sample for sample in samples if not sample.name.endswith("_created")]
    values = {(sample.name, *sorted(sample.labels.items())): sample.value for sample in samples}
    assert len(values) == len(samples)
    return values


def value(samples, name, **labels):
    return samples[(f"isocharge_{name}", *sorted(labels.items()))]


def test_clients_cannot_create_series(handler):
    """The number of series stays small with any number of paths, models, versions and methods."""
    rng = np.random.default_rng(0)
    before = len(scrape(handler))
    for number in range(500):
        name = rng.bytes(8).decode("latin-1")
        for path in (f"/{name}", f"/v2/models/{name}/infer", f"/v2/models/linear/versions/{number}/infer"):
            handler.answer(f"M{number}", path, [(b"authorization", name.encode())], name.encode())
    after = scrape(handler)
    assert len(after) - before <= 6
    requests = {key: count for key, count in after.items() if key[0] == "isocharge_requests_total"}
    assert sum(count for key, count in requests.items() if ("route", "/metrics") not in key) == 1500


def test_misfit_alarms_are_the_flags_of_records(handler, predictor):
    """Single presses and batches are sent, with and without the misfit among the requested outputs."""
    charges = np.float32([[100.0, 200.0, 300.0], [900.0, -9.0, 300.0], [900.0, 300.0, -4.0]])
    assert [MISFIT in predictor.flags(predictor.predict(press)) for press in charges] == [False, True, False]
    for requested in ({}, {"outputs": [{"name": "contact"}]}):
        for presses in (charges, *charges):
            handler.answer("POST", INFER, [], orjson.dumps(infer_request(presses, **requested)))
    samples = scrape(handler)
    of = {"model": "linear", "version": "2"}
    assert [value(samples, f"{name}_total", **of) for name in ("presses", "misfit_alarms")] == [12, 4]


def test_counters_do_not_fall_when_a_model_is_loaded_again(handler):
    for action in ("load", "unload", "load"):
        handler.answer("POST", INFER, [], BODY)
        assert handler.answer("POST", f"/v2/repository/models/linear/{action}", [], b"").status == 200
        samples = scrape(handler)
        assert value(samples, "model_ready", model="linear", version="2") == (action == "load")
    assert value(samples, "presses_total", model="linear", version="2") == 2  # the third met no model
