"""MCAP files: read back by rosbags, which shares no code with the writer, and by the stock readers of MCAP."""

import json
import pickle
import signal
import subprocess
import sys
import time
from contextlib import closing, suppress
from io import BytesIO
from itertools import pairwise

import jsonschema_rs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import SeekingReader, make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, storage_mcap
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import get_types_from_msg

from isocharge.serve import PredictionRecord
from isocharge.serve.model.contact import Contact
from isocharge.serve.outputs.mcap_file import McapFile
from isocharge.serve.outputs.output import OutputContext
from isocharge.serve.outputs.ros_messages import DEFINITIONS, STRING
from isocharge.serve.outputs.targets import Outputs
from isocharge.serve.record.formats import record_schema
from isocharge.serve.record.record import TrackedContact

ELECTRODES = ("A", "B", "C")
ROS = get_typestore(Stores.ROS2_JAZZY)
"""Definitions as ROS 2 ships them."""

TIMES = st.floats(0.0, 2.0**31, exclude_max=True).filter(lambda t: round(t, 6) < 2.0**31)


NUMBERS = st.floats(-1e4, 1e4, allow_nan=False)


@st.composite
def records(draw):
    """Records as a stream writes them: pressed, at rest, or of a reading that was no number."""
    kind = draw(st.sampled_from(["contact", "rest", "invalid"]))
    contact = dict.fromkeys(Contact._fields)
    if kind == "rest":
        contact["force_N"] = 0.0
    if kind == "contact":
        contact = {name: draw(NUMBERS) for name in contact}
    charges = st.none() | st.fixed_dictionaries(dict.fromkeys(ELECTRODES, st.none() | NUMBERS))
    optional = {
        "t_device_us": st.integers(0, 1 << 62),
        "seq": st.integers(0, 1 << 40),
        "charge_pC": charges,
        "charge_raw_pC": charges,
        "tare_pC": charges,
        "latency_us": NUMBERS,
    }
    return PredictionRecord(
        timestamp=draw(TIMES),
        **contact,
        **{name: draw(st.none() | values) for name, values in optional.items()},
        contact=kind == "contact",
        flags=draw(st.sampled_from([(), ("tare",), ("gap", "outside")])),
        model="linear/1",
        frame_id=draw(st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=20)),
    )


@pytest.fixture
def press(record):
    """Return a function that makes the record of a press with a number."""
    plain = {"y_mm": -2.0, "force_N": 0.5, "x_std_mm": 0.03, "y_std_mm": 0.04, "misfit": 1.0, "flags": ()}

    def make(number, **changes):
        numbered = {"timestamp": 1763600000.0 + 0.005 * number, "x_mm": 3.0 + 1e-3 * number}
        return record(**(plain | numbered | {"charge_pC": {"A": 1.0, "B": None, "C": 2.0}} | changes))

    return make


def write(path, records, *, is_ros2=False):
    with closing(McapFile(path, ELECTRODES, is_ros2=is_ros2, is_live=False)) as file:
        for record in records:
            file.write(record)
    return path


@pytest.fixture
def rosbags_knows_json(monkeypatch):
    """rosbags 0.11 opens no file in which a schema has an encoding that it does not know, such as `jsonschema`."""
    known = storage_mcap.get_msgdef

    def get_msgdef(schema):
        if schema is not None and schema.encoding == "jsonschema":
            return MessageDefinition(MessageDefinitionFormat.NONE, "")
        return known(schema)

    monkeypatch.setattr(storage_mcap, "get_msgdef", get_msgdef)


def read_with_rosbags(path):
    """Messages by topic, each with its time."""
    topics = {"/isocharge/record": [], "/isocharge/wrench": [], "/isocharge/pose": []}
    with Reader(path) as reader:
        for connection, time_ns, data in reader.messages(reader.connections):
            if connection.ext.serialization_format == "json":
                message = bytes(data).decode()
            else:
                message = ROS.deserialize_cdr(data, connection.msgtype)
            topics[connection.topic].append((time_ns, message.data if connection.msgtype == STRING else message))
    return topics


def check_messages(topics, lines):
    """Every message against the line of JSON that it comes from."""
    assert topics["/isocharge/record"] == [(stamp_ns(json.loads(line)), line) for line in lines]
    parsed = [shown_values(json.loads(line)) for line in lines]
    forces = [record for record in parsed if record["force_N"] is not None]
    for (time_ns, wrench), record in zip(topics["/isocharge/wrench"], forces, strict=True):
        check_header(wrench.header, time_ns, record)
        position = 1e-3 * np.array([record["x_mm"] or 0.0, record["y_mm"] or 0.0, 0.0])
        force = np.array([0.0, 0.0, -record["force_N"]])
        np.testing.assert_array_equal(vector(wrench.wrench.force), force)
        np.testing.assert_allclose(vector(wrench.wrench.torque), np.cross(position, force), rtol=1e-15, atol=0.0)
    places = [record for record in parsed if record["x_mm"] is not None]
    for (time_ns, pose), record in zip(topics["/isocharge/pose"], places, strict=True):
        check_header(pose.header, time_ns, record)
        place, turn = pose.pose.pose.position, pose.pose.pose.orientation
        np.testing.assert_allclose(1e3 * vector(place), [record["x_mm"], record["y_mm"], 0.0], rtol=1e-15, atol=0.0)
        assert (*vector(turn), turn.w) == (0.0, 0.0, 0.0, 1.0)
        std = [1e-3 * record["x_std_mm"], 1e-3 * record["y_std_mm"], 5e-3, *[np.pi / np.sqrt(3.0)] * 3]
        expected = np.diag(np.square(std))
        expected[0, 1] = expected[1, 0] = std[0] * std[1] * (record["xy_correlation"] or 0.0)
        np.testing.assert_allclose(pose.pose.covariance.reshape(6, 6), expected, rtol=1e-14)


def shown_values(record):
    """Values of a record of JSON, in which a tracked contact replaces the contact of a frame with a known force."""
    return record if record["force_N"] is None else record | (record.get("tracked") or {})


def stamp_ns(record):
    """Time of a record of JSON, in whole microseconds."""
    return round(record["timestamp"] * 1e6) * 1000


def check_header(header, time_ns, record):
    assert header.stamp.sec * 10**9 + header.stamp.nanosec == time_ns == stamp_ns(record)
    assert header.frame_id == record["frame_id"]


def vector(value):
    return np.array([value.x, value.y, value.z])


@pytest.mark.parametrize("is_ros2", [False, True])
@pytest.mark.usefixtures("rosbags_knows_json")
@settings(max_examples=15, deadline=None)
@given(written=st.lists(records(), max_size=20, unique_by=lambda record: round(record.timestamp, 6)))
def test_rosbags_reads_every_message_of_an_mcap_file(tmp_path_factory, is_ros2, written):
    path = write(tmp_path_factory.mktemp("bag") / "touch.mcap", written, is_ros2=is_ros2)
    lines = [record.to_json() for record in sorted(written, key=lambda record: record.timestamp)]
    check_messages(read_with_rosbags(path), lines)


@pytest.mark.parametrize("name", DEFINITIONS)
def test_message_definitions_equal_those_of_ros2(name):
    for kind, fields in get_types_from_msg(DEFINITIONS[name], name).items():
        assert fields == ROS.fielddefs[kind], kind


def test_mcap_reader_finds_schemas_index_and_checksums(tmp_path, press):
    """What Foxglove, Lichtblick and PlotJuggler need to open a file at any time in it."""
    written = [press(number) for number in range(5000)]
    path = write(tmp_path / "touch.mcap", written)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert isinstance(reader, SeekingReader)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics.message_count == 15000
        assert len(summary.chunk_indexes) > 1
        assert all(len(chunk.message_index_offsets) == 3 for chunk in summary.chunk_indexes)
        assert all(a.message_end_time <= b.message_start_time for a, b in pairwise(summary.chunk_indexes))
        start = 1763600020 * 10**9  # the time of record 4000
        (schema, channel, message), *_ = reader.iter_messages("/isocharge/record", starting_at=start)
        assert message.data.decode() == written[4000].to_json()
        assert message.log_time == message.publish_time == start
        assert (schema.name, schema.encoding) == ("isocharge.PredictionRecord", "jsonschema")
        assert channel.message_encoding == "json"
        assert json.loads(schema.data) == record_schema(ELECTRODES)
        pose = next(reader.iter_decoded_messages("/isocharge/pose")).decoded_message
        assert (pose.pose.pose.position.x, pose.header.frame_id) == (3e-3, "linear-film")


SCHEMA = jsonschema_rs.Draft7Validator(record_schema(ELECTRODES))


@settings(max_examples=40, deadline=None)
@given(record=records())
def test_every_record_is_valid_under_its_schema(record):
    content = json.loads(record.to_json())
    SCHEMA.validate(content)
    assert not SCHEMA.is_valid(content | {"charge_pC": {"A": "1"}})


def test_wrench_and_pose_describe_the_tracked_contact(tmp_path, press):
    tracked = TrackedContact(1.0, -4.0, 0.25, 0.01, 0.02, 0.001, 5.0, 0.0, 0.9)
    records = [
        press(0, sections=("track",), tracked=tracked, event="slide", xy_correlation=0.5),
        press(1, sections=("track",), tracked=tracked, x_mm=None, force_N=None, flags=("invalid",)),
    ]
    topics = read_with_rosbags(write(tmp_path / "a.mcap", records, is_ros2=True))
    check_messages(topics, [record.to_json() for record in records])
    ((_, pose),) = topics["/isocharge/pose"]
    assert pose.pose.pose.position.x == 1e-3


def whole_messages(data):
    """The records in a file that may have no end."""
    messages = []
    with suppress(EndOfFile):
        messages.extend(StreamReader(BytesIO(data), validate_crcs=True).records)
    return [each.data.decode() for each in messages if isinstance(each, Message) and each.data.startswith(b"{")]


def test_killed_process_leaves_a_file_with_all_but_the_last_second(tmp_path, press):
    path = tmp_path / "touch.mcap"
    code = f"""
import os, pickle, signal, sys, time
from pathlib import Path
from isocharge.serve.outputs.mcap_file import McapFile
clock = [0.0]
time.monotonic = lambda: clock[0]
file = McapFile(Path({str(path)!r}), ("A", "B", "C"), is_ros2=False, is_live=True)
for record in pickle.load(sys.stdin.buffer):
    file.write(record)
    clock[0] += 0.02
os.kill(os.getpid(), signal.SIGKILL)
"""
    written = [press(number) for number in range(120)]
    done = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(written), timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    recovered = whole_messages(path.read_bytes())
    assert recovered == [record.to_json() for record in written[: len(recovered)]]
    assert 69 <= len(recovered) < 120  # of 2.4 s, written every second


def test_full_disk_ends_the_mcap_file_but_not_the_stream(tmp_path, press, fill_disk, caplog, monkeypatch):
    path = tmp_path / "touch.mcap"
    monkeypatch.setattr("isocharge.serve.outputs.mcap_file.FLUSH_INTERVAL_S", 0.01)
    fill_disk(12000)
    written = [press(number, misfit=np.pi * number) for number in range(2000)]
    outputs = Outputs([str(path)], OutputContext(electrodes=ELECTRODES, is_live=True))
    with outputs:
        for record in written:
            outputs.write(record)
            time.sleep(2e-4)
    assert outputs.not_written == {str(path): None}
    assert outputs.has_incomplete_file
    reason = f"{path} cannot be written: No space left on device; choose another output"
    assert caplog.messages == [f"{path}: stopped ({reason}); the records after that are missing"]
    recovered = whole_messages(path.read_bytes())
    assert 20 < len(recovered) < 2000
    assert recovered == [record.to_json() for record in written[: len(recovered)]]
