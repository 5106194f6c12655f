"""`serve stream --mcap` and `serve replay --mcap`: the lines on stdout, in a file that other tools open."""

import base64
import errno
import json
import os
import sys

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

pytestmark = pytest.mark.xdist_group("clock")


def messages(path):
    with path.open("rb") as file:
        topics = {}
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, []).append(message)
    return topics


def lines_in(path):
    return [message.data.decode() for message in messages(path)["/isocharge/record"]]


def test_stream_writes_what_it_prints(run, frames, models, tmp_path):
    path = tmp_path / "touch.mcap"
    out = run("stream", "linear", "--port", frames, "--models", models, "--mcap", path).stdout
    topics = messages(path)
    assert lines_in(path) == out.splitlines()
    records = [json.loads(line) for line in out.splitlines()]
    assert len(records) == len(topics["/isocharge/wrench"]) == 300
    assert len(topics["/isocharge/pose"]) == sum(record["contact"] for record in records) > 90


@pytest.mark.parametrize("records", ["json", "ros2"])
def test_replay_converts_an_old_recording(command, recorded, models, tmp_path, records):
    (recording, printed), path = recorded, tmp_path / "touch.mcap"
    words = ["--models", models, "--mcap", path, "--mcap-records", records]
    code, out, _ = command("serve", "replay", recording, *words)
    assert (code, out) == (0, printed)
    if records == "json":
        assert lines_in(path) == out.splitlines()
    else:
        ros = get_typestore(Stores.ROS2_JAZZY)
        with Reader(path) as reader:
            topic = [each for each in reader.connections if each.topic == "/isocharge/record"]
            lines = [ros.deserialize_cdr(data, each.msgtype).data for each, _, data in reader.messages(topic)]
        assert lines == out.splitlines()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["touch.mcap", "touch.rec"]
    before = path.read_bytes()
    code, out, err = command("serve", "replay", recording, *words)
    assert (code, out, f"OutputExists: {path} is already there" in err) == (1, "", True)
    assert path.read_bytes() == before


def test_a_damaged_recording_leaves_no_file(command, recorded, models, tmp_path):
    recording, _ = recorded
    lines = recording.read_text().splitlines()
    recording.write_text("\n".join([*lines[:50], "damaged", *lines[50:], ""]))
    code, _, err = command("serve", "replay", recording, "--models", models, "--mcap", tmp_path / "touch.mcap")
    assert (code, "line 51: damaged" in err) == (2, True)
    assert list(tmp_path.iterdir()) == [recording]


def test_a_recording_of_another_age_is_refused_with_the_reason(command, recorded, frames, models, tmp_path):
    (recording, _), path = recorded, tmp_path / "touch.mcap"
    header = recording.read_text().splitlines()[0]
    chunk = [-5.0, 1, 0.0, base64.b64encode(frames.read_bytes()).decode()]
    record = json.dumps({"timestamp": -5.0, "latency_us": 1.0})
    recording.write_text("\n".join([header, json.dumps({"chunk": chunk}), record, ""]))
    code, _, err = command("serve", "replay", recording, "--models", models, "--mcap", path)
    assert (code, "expected unix seconds from 1970 to 2038" in err, path.exists()) == (2, True, False)


def test_a_live_stream_that_is_stopped_ends_its_file(board_until, models, run, tmp_path):
    path = tmp_path / "touch.mcap"
    with board_until(400) as board:
        out = run("stream", "linear", "--port", board.url, "--models", models, "--mcap", path).stdout
    assert lines_in(path) == out.splitlines() != []


def test_a_full_disk_costs_the_file_and_an_exit_code(command, frames, models, tmp_path, monkeypatch):
    path, os_write = tmp_path / "touch.mcap", os.write

    def write(descriptor, data):
        if descriptor > 2 and len(data) > 100:  # the file, after its header
            raise OSError(errno.ENOSPC, "No space left on device")
        return os_write(descriptor, data)

    monkeypatch.setattr("isocharge.serve.export.mcap_file.os.write", write)
    code, _, err = command("serve", "stream", "linear", "--port", frames, "--models", models, "--mcap", path)
    assert code == 1
    assert f"{path}: stopped (No space left on device); what was written until now is whole" in err
    assert " frames, 0 lost" in err


def test_without_the_extra(command, frames, models, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("mcap", "isocharge.serve.export.mcap"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap", None)
    path = tmp_path / "touch.mcap"
    code, _, err = command("serve", "stream", "linear", "--port", frames, "--models", models, "--mcap", path)
    assert (code, path.exists()) == (1, False)
    assert "'mcap', which is not installed; pip install 'isocharge[record]'" in err
