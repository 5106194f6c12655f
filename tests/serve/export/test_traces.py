"""Traces of a recording: no peak is lost, however long it is, and memory stays bounded."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import RecordingError
from isocharge.common.tables import Table
from isocharge.serve.export import traces as module
from isocharge.serve.export.traces import TraceCollector

FIELDS = ("x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N", "misfit")
numbers = st.floats(-100.0, 100.0, width=32)


@st.composite
def recordings(draw):
    """Records every 5 ms: presses and pauses, flags now and then."""
    rows = []
    for number in range(draw(st.integers(1, 40))):
        contact = draw(st.booleans())
        values = {name: draw(numbers) if contact else None for name in FIELDS}
        values["force_N"] = values["force_N"] if contact else 0.0
        charges = draw(st.none() | st.fixed_dictionaries({"A": numbers, "B": st.none() | numbers}))
        flags = draw(st.sampled_from([[], ["tare"], ["outside"], ["gap", "misfit"]]))
        times = {"timestamp": 1e9 + 0.005 * number, "latency_us": 1.0}
        rows.append(times | values | {"charge_pC": charges, "charge_raw_pC": {"A": 1.0, "B": 2.0}, "flags": flags})
    return rows


def table(row):
    return Table(row, "", RecordingError)


def collect(rows):
    collector = TraceCollector(table(rows[0]))
    for row in rows:
        collector.add(table(row))
    return collector.traces()


def column(rows, name):
    return np.array([np.nan if row[name] is None else row[name] for row in rows])


@pytest.fixture(params=[(6, 4, 8), (4096, 1024, 20_000)], ids=["coarse", "fine"])
def sizes(request, monkeypatch):
    """Sizes small enough that a short recording has to be thinned again and again, and the real ones."""
    for name, size in zip(("MOST_GROUPS", "BLOCK", "MOST_POINTS"), request.param, strict=True):
        monkeypatch.setattr(module, name, size)
    return request.param


def check_envelope(envelope, values, members):
    """Each group holds exactly its smallest and its largest value."""
    for low, high, rows in zip(envelope.low, envelope.high, members, strict=True):
        inside = values[rows][~np.isnan(values[rows])]
        expected = (inside.min(), inside.max()) if inside.size else (np.nan, np.nan)
        np.testing.assert_array_equal((low, high), expected)


@pytest.mark.usefixtures("sizes")
@settings(max_examples=20, deadline=None)
@given(rows=recordings())
def test_each_group_has_the_extremes_of_its_records(rows):
    traces = collect(rows)
    time = column(rows, "timestamp") - 1e9
    members = [(time >= a) & (time <= b) for a, b in zip(traces.start, traces.end, strict=True)]
    np.testing.assert_array_equal(np.sum(members, axis=0), 1)  # every record in one group
    assert len(members) <= module.MOST_GROUPS
    for name in ("x_mm", "y_mm", "force_N", "misfit"):
        check_envelope(traces.values[name], column(rows, name), members)
    for name, std in (("x_mm", "x_std_mm"), ("y_mm", "y_std_mm"), ("force_N", "force_std_N")):
        check_envelope(traces.values[f"{name} - std"], column(rows, name) - column(rows, std), members)
        check_envelope(traces.values[f"{name} + std"], column(rows, name) + column(rows, std), members)
    for name in ("A", "B"):
        charge = [row["charge_pC"][name] if row["charge_pC"] else None for row in rows]
        values = np.array([np.nan if q is None else q for q in charge])
        check_envelope(traces.charge_pC[name], values, members)
    for word in {word for row in rows for word in row["flags"]}:
        flagged = np.array([word in row["flags"] for row in rows])
        np.testing.assert_array_equal(traces.flags[word], [flagged[inside].any() for inside in members])
    assert (traces.records, traces.begin) == (len(rows), 1e9)


@pytest.mark.usefixtures("sizes")
@settings(max_examples=20, deadline=None)
@given(rows=recordings())
def test_the_path_has_contacts_in_their_order(rows):
    traces = collect(rows)
    contacts = {round(row["timestamp"] - 1e9, 6): row for row in rows if row["x_mm"] is not None}
    assert len(traces.path) <= module.MOST_POINTS
    assert bool(traces.path) == bool(contacts)
    times = [point.time for point in traces.path]
    assert times == sorted(set(times))
    for point in traces.path:
        row = contacts[round(point.time, 6)]
        assert (point.x_mm, point.y_mm, point.force_N) == (row["x_mm"], row["y_mm"], row["force_N"])
    for point in traces.doubts:
        row = contacts[round(point.time, 6)]
        assert {"outside", "misfit"} & set(row["flags"])
        assert (point.x_mm, point.y_mm) == (row["x_mm"], row["y_mm"])
    assert len(traces.doubts) <= module.MOST_POINTS
    assert bool(traces.doubts) == any({"outside", "misfit"} & set(row["flags"]) for row in contacts.values())
    for point in traces.path:
        before = [row["x_mm"] is not None for row in rows[: round(point.time / 0.005) + 1]]
        assert point.press == sum(b and not a for a, b in zip([False, *before], before, strict=False))


def test_a_doubt_that_comes_and_goes_costs_no_points():
    rest = dict.fromkeys(FIELDS, 0.1) | {"charge_pC": None, "charge_raw_pC": None}
    flags = [[], [], ["misfit"], ["misfit"], [], ["gap"], ["outside"]]
    traces = collect([rest | {"timestamp": 0.1 * k, "flags": words} for k, words in enumerate(flags)])
    assert [round(point.time, 6) for point in traces.path] == [0.0]
    assert [round(point.time, 6) for point in traces.doubts] == [0.2]


def test_jumps_all_over_the_film_are_thinned_evenly(monkeypatch):
    """A longer step would leave none of them."""
    monkeypatch.setattr(module, "MOST_POINTS", 400)
    places = np.random.default_rng(2).uniform(-10.0, 10.0, (5000, 2))
    rest = dict.fromkeys(FIELDS, 0.1) | {"charge_pC": None, "charge_raw_pC": None, "flags": []}
    path = collect(
        [rest | {"timestamp": 0.001 * k, "x_mm": x, "y_mm": y} for k, (x, y) in enumerate(places.tolist())]
    ).path
    assert 50 <= len(path) <= 400
    assert path[-1].time > 4.5
    assert np.ptp([point.x_mm for point in path]) > 18.0


def test_a_slow_spiral_keeps_its_shape(monkeypatch):
    """Many times more contacts than points: the points that are left are near every contact."""
    monkeypatch.setattr(module, "MOST_POINTS", 300)
    angle = np.linspace(0.0, 20.0 * np.pi, 8_000)
    x, y = 0.1 * angle * np.cos(angle), 0.1 * angle * np.sin(angle)
    rest = dict.fromkeys(FIELDS, 0.1) | {"charge_pC": None, "charge_raw_pC": None, "flags": []}
    path = collect(
        [rest | {"timestamp": 0.001 * k, "x_mm": a, "y_mm": b} for k, (a, b) in enumerate(zip(x, y, strict=True))]
    ).path
    points = np.array([(point.x_mm, point.y_mm) for point in path])
    distance = np.hypot(x[:, None] - points[:, 0], y[:, None] - points[:, 1]).min(axis=1)
    assert len(points) <= 300
    assert distance.max() < 1.5


@pytest.mark.parametrize(
    "change",
    [
        {"timestamp": None},
        {"timestamp": "now"},
        {"x_mm": "1"},
        {"x_mm": math.inf},
        {"flags": "tare"},
        {"flags": None},
        {"charge_pC": 3.0},
        {"charge_pC": {"A": 1.0}},
        {"charge_raw_pC": {str(k): 0.0 for k in range(65)}, "charge_pC": None},
    ],
)
def test_what_is_no_record_is_refused(change):
    row = dict.fromkeys(FIELDS, 0.1) | {"timestamp": 1.0, "charge_pC": {"A": 1.0, "B": 2.0}, "flags": []}
    row |= {"charge_raw_pC": {"A": 1.0, "B": 2.0}}
    collect([row])
    with pytest.raises(RecordingError, match=r"expected|missing"):
        collect([row | change])


def test_words_without_end_are_refused():
    row = dict.fromkeys(FIELDS, 0.1) | {"timestamp": 1.0, "charge_pC": None, "charge_raw_pC": None}
    with pytest.raises(RecordingError, match="expected up to 62 different flags"):
        collect([row | {"flags": [f"word{k}"]} for k in range(63)])
