"""Messages between the server and the live page: requests, samples, and the description of the film.

The modules of the page are run by Node.js, which decodes the samples of the server.
"""

import json
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from isocharge.common.errors import RequestError
from isocharge.common.structs import parse_json
from isocharge.serve import find_model, flags, load_model
from isocharge.serve.record.record import OtherContact, TrackedContact, Tracking
from isocharge.serve.viewer.deflection_field import read_deflection_field
from isocharge.serve.viewer.messages import (
    CONTACT_BIT,
    FLAG_BITS,
    LiveRequest,
    Marker,
    Record,
    ReplayRequest,
    SampleFormat,
    Seek,
    Speed,
    Tare,
    coalesce,
    confirmed_number,
    describe_film,
    find_deflection_field,
    samples_message,
)
from isocharge.simulate.forward.deflection import points_mm
from kept import ROOT


def parse(text, kind=LiveRequest | ReplayRequest):
    return parse_json(text, "", RequestError, kind)


@pytest.mark.parametrize(
    ("text", "request_"),
    [
        ('{"do": "tare"}', Tare()),
        ('{"do": "record", "on": true}', Record(on=True)),
        ('{"do": "marker", "text": "here"}', Marker("here")),
        ('{"do": "seek", "value": 12.5}', Seek(12.5)),
        ('{"do": "speed", "value": 24}', Speed(24.0)),
    ],
)
def test_requests_of_the_page_are_parsed(text, request_):
    assert parse(text) == request_


@pytest.mark.parametrize(
    "content",
    [
        {"do": "shutdown"},
        {"do": "record"},
        {"do": "record", "on": 1},
        {"do": "marker", "text": "x" * 81},
        {"do": "marker", "text": "a\nb"},
        {"do": "seek", "value": -1},
        {"do": "seek", "value": 1e99},
        {"do": "speed", "value": 0},
        {"do": "tare", "path": "/etc/passwd"},
        [],
        "tare",
    ],
)
def test_invalid_requests_are_refused(content):
    with pytest.raises(RequestError):
        parse(json.dumps(content))


def test_live_page_refuses_replay_requests():
    with pytest.raises(RequestError, match="one of tare, record, marker"):
        parse('{"do": "seek", "value": 1}', LiveRequest)


@settings(max_examples=20)
@given(st.text() | st.recursive(st.none() | st.text() | st.floats(), st.lists, max_leaves=5).map(json.dumps))
@example("[" * 5000)
@example('{"do": "seek", "value": NaN}')
@example('{"do": "seek", "value": 1' + "0" * 4000 + "}")
def test_any_text_is_parsed_or_refused_as_a_request(text):
    with pytest.raises(RequestError):
        parse(text)


def test_confirmations_have_four_bytes():
    assert confirmed_number(b"\x01\x02\x00\x00") == 513
    with pytest.raises(RequestError, match="four bytes"):
        confirmed_number(b"\x01")


FORMAT = SampleFormat(("A", "B", "C"))


def test_numbers_beyond_float32_are_clipped(record):
    sample_format = SampleFormat(("A",))
    sample = np.frombuffer(sample_format.pack(record(charge_pC={"A": -1e300}, misfit=1e200)), sample_format.dtype)[0]
    assert -sample["charge_pC"][0] == sample["misfit"] == np.finfo(np.float32).max


def test_sample_contains_the_tracked_contact(record):
    tracked = TrackedContact(2.0, 3.0, 0.4, 0.01, 0.02, 0.001, 0.0, 0.0, 0.1)
    tracking = Tracking(tracked, None, OtherContact(5.0, -1.0, 1.0, 0.25))
    followed = record(x_mm=1.0, misfit=0.5, xy_correlation=0.25, tracking=tracking)
    sample = np.frombuffer(FORMAT.pack(followed), FORMAT.dtype)[0]
    assert (sample["x_mm"], sample["misfit"], sample["xy_correlation"]) == (2.0, 0.5, 0.25)
    assert sample["x_std_mm"] == np.float32(0.01)
    assert (sample["other_x_mm"], sample["other_y_mm"]) == (5.0, -1.0)


def test_electrode_polygons_include_the_calibration(film):
    """A released model has squares. The other film has polygons with traces, turned by a right angle and shifted."""
    described = describe_film("left", load_model(find_model("three-25um-biaxial")).metadata, None)
    squares = np.array([described["outlines_mm"][name] for name in "ABC"])
    angle = np.radians([-90.0, 30.0, 150.0])
    np.testing.assert_allclose(squares.mean(axis=1), 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=1e-6)
    np.testing.assert_allclose(np.ptp(squares, axis=1), 3.0)
    assert "more_mm" not in described
    assert described["unnoticed"]["to_mm"] == pytest.approx(0.95 * 45.0, abs=0.05)  # near the clamp
    assert described["unnoticed"]["share"][8] == (1.0,) * 36  # 20 mm from the centre
    trace = {"more_mm": [[[2, 0], [2, -9], [3, -9]]], "back_mm": [[[2, 0], [3, 0], [2, 1]]]}
    electrodes = {name: {"polygon_mm": [[2, 0], [3, 0], [2, 1]]} | trace for name in "ABC"}
    turned = {"name": "mine", "electrodes": electrodes, "calibration": {"rotation_deg": 90.0, "shift_mm": [0.5, 0.25]}}
    described = describe_film("left", film.metadata(sensor=turned), None)
    np.testing.assert_allclose(described["outlines_mm"]["C"], [[0.5, 2.25], [0.5, 3.25], [-0.5, 2.25]], atol=1e-12)
    np.testing.assert_allclose(described["more_mm"]["C"], [[[0.5, 2.25], [9.5, 2.25], [9.5, 3.25]]], atol=1e-12)


def test_every_flag_has_its_own_bit():
    words = {value for name, value in vars(flags).items() if name.isupper() and isinstance(value, str)}
    assert set(FLAG_BITS) == words
    assert len(set(FLAG_BITS.values())) == len(words)
    assert max(FLAG_BITS.values()) < CONTACT_BIT


def samples(force_N, bits=None):
    """Return samples at intervals of 1 ms. They are contacts if the force is above zero."""
    rows = np.zeros(len(force_N), FORMAT.dtype)
    rows["timestamp"] = 1e-3 * np.arange(len(rows))
    rows["force_N"] = force_N
    rows["flags"] = np.where(np.array(force_N) > 0, CONTACT_BIT, 0) | (0 if bits is None else np.array(bits))
    rows["records"] = 1
    rows["latency_us"] = np.arange(len(rows))
    return rows


@given(
    force_N=st.lists(st.floats(0, 2, width=32), min_size=1, max_size=400),
    max_samples=st.integers(1, 50),
    seed=st.integers(0, 1000),
)
def test_coalesced_samples_represent_all_records(force_N, max_samples, seed):
    rows = samples(force_N, np.random.default_rng(seed).integers(0, 1 << 12, len(force_N)))
    shown = coalesce(rows, max_samples)
    assert len(shown) == min(max_samples, len(rows))
    assert shown["records"].sum() == len(rows)
    assert np.bitwise_or.reduce(shown["flags"]) == np.bitwise_or.reduce(rows["flags"])
    assert shown["latency_us"][-1] == len(rows) - 1
    assert (np.diff(shown["timestamp"]) > 0).all()
    assert set(shown["force_N"].tolist()) <= set(rows["force_N"].tolist())


@given(start=st.integers(0, 90), max_samples=st.integers(1, 30))
def test_short_tap_is_not_lost_by_coalescing(start, max_samples):
    force_N = np.zeros(100)
    force_N[start : start + 3] = (0.5, 1.0, 0.4)
    touching = coalesce(samples(force_N), max_samples)
    assert (touching["flags"] & CONTACT_BIT).any()
    assert touching["force_N"].max() >= 0.4


def test_coalescing_shows_the_latest_contact_of_a_run():
    """During a touch, the latest contact is shown, not the contact with the largest force."""
    shown = coalesce(samples(np.linspace(2.0, 1.0, 64)), 1)
    assert shown["timestamp"][0] == 0.063


VIEWER = Path(str(files("isocharge.serve.viewer")))


def node(script):
    """Run a script by Node.js, and return the JSON value that it prints."""
    if shutil.which("node") is None:
        pytest.skip("needs Node.js, which reads the page's modules as a browser does")
    command = ["node", "--input-type=module", "-e", script]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)


@pytest.mark.parametrize(("radius_mm", "middle"), [(None, [30.0, 0.0]), (45.0, [0.0, 0.0])])
def test_page_shows_the_whole_area_of_a_film_whose_corner_is_the_origin(radius_mm, middle):
    """The area has x from 0 to 60 mm. It is in the middle of the view unless the film has a radius."""
    film = {
        "working_area_mm": [[0, -15], [60, -15], [60, 15], [0, 15]],
        "outlines_mm": {},
        "force_range_N": [0.2, 5.0],
        "radius_mm": radius_mm,
        "electrodes": [],
    }
    at, reach, on_pad, beyond = node(
        f"""globalThis.document = {{ createElement: () => ({{}}), documentElement: {{}} }};
        globalThis.getComputedStyle = () => ({{ getPropertyValue: () => "" }});
        globalThis.matchMedia = () => ({{ addEventListener() {{}} }});
        const {{ Plan }} = await import("{(VIEWER / "page/plan.js").as_uri()}");
        const plan = new Plan({{ width: 400, height: 400, clientWidth: 400 }}, {json.dumps(film)});
        const shown = (x, y) => {{ const place = plan.inView({{ x, y }}); return [place.x, place.y]; }};
        console.log(JSON.stringify([[plan.middle.x, plan.middle.y], plan.reach, shown(50, 0), shown(500, 0)]));"""
    )
    assert at == middle
    assert reach == pytest.approx(1.16 * np.hypot(60.0 - middle[0], 15.0))
    assert on_pad == [50.0, 0.0]
    assert middle[0] + 0.9 * reach < beyond[0] < middle[0] + reach


def test_page_decodes_the_samples_of_the_server(record):
    sample_format = SampleFormat(("A", "B", "C"))
    changes = {
        "charge_pC": {"A": 1.5, "B": None, "C": -3.0},
        "y_mm": 2.5,
        "flags": ("gap", "misfit"),
        "latency_us": 9.0,
        "tracking": Tracking(other=OtherContact(5.0, -1.5, 1.0, 0.25)),
    }
    data = sample_format.pack(record(**changes)) + sample_format.pack(record(contact=False, x_mm=None, flags=()))
    message = samples_message(77, 123.5, np.frombuffer(data, sample_format.dtype), 4, begin_anew=True)
    got = node(
        f"""import {{ decode }} from "{(VIEWER / "page/decode.js").as_uri()}";
        const bytes = Uint8Array.from([{",".join(map(str, message))}]);
        const layout = {json.dumps(sample_format.describe())};
        const other = {json.dumps(SampleFormat(tuple("ABCDEF")).describe())};
        console.log(JSON.stringify([decode(bytes.buffer, layout, 3), decode(bytes.buffer.slice(0, 90), layout, 3),
          decode(new ArrayBuffer(3), layout, 3), decode(bytes.buffer, other, 6)]));"""
    )
    whole, *broken = got
    assert broken == [None, None, None]
    header = {"number": 77, "sent_s": 123.5, "missed": 4, "beginsAnew": True}
    assert header.items() <= whole.items()
    first, second = whole["samples"]
    expected = {"charges": [1.5, None, -3.0], "contact": True, "y": 2.5, "t": 1763600000.1234567, "latency": 9.0}
    expected |= {"otherX": 5.0, "otherY": -1.5}
    assert expected.items() <= first.items()
    assert bin(first["bits"]).count("1") == 2
    assert {"contact": False, "x": None, "bits": 0}.items() <= second.items()


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "models").iterdir() if path.is_dir()))
def test_every_released_model_has_a_deflection_field(name):
    metadata = load_model(ROOT / "models" / name / "1").metadata
    field = find_deflection_field(ROOT / "models" / name / "1", metadata)
    assert field.fits(metadata.sensor["film"])


def test_page_interpolates_the_deflection_field():
    """At the nodes of the table, the page computes the values of the table, also if the press is turned or mirrored."""
    path = next((VIEWER / "fields").glob("*.json"))
    field = read_deflection_field(path)
    column, ring, angle, turn = 2, 9, 5, 0.7
    distance = field.distance_mm[column]
    at = points_mm(field.film["radius_mm"], field.probe_radius_mm, distance, np.array(field.rings), 13)[ring, angle]
    for mirrored in (at, at.conjugate()):
        place = mirrored * np.exp(1j * turn)
        press = distance * np.exp(1j * turn)
        got = node(
            f"""import {{ readFileSync }} from "node:fs";
            import {{ Deflection }} from "{(VIEWER / "page/deflection.js").as_uri()}";
            const field = new Deflection(JSON.parse(readFileSync("{path}", "utf8")));
            field.press({press.real}, {press.imag}, {field.force_N[1]});
            const node = field.node({ring}, {angle if mirrored is at else 24 - angle});
            const at = field.at({place.real}, {place.imag}), flat = (field.press(0, 0, 0), field.at(1, 1));
            console.log(JSON.stringify([...node, at, flat]));"""
        )
        w = field.deflection_mm[1, column, ring, angle]
        assert got == pytest.approx([place.real, place.imag, w, w, 0.0], abs=2e-3)
