"""`serve stream --mcap` and `serve replay --mcap`: the lines on stdout, in a file that other tools open."""

import base64
import errno
import json
import os
import signal
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from isocharge.serve import Frame, VirtualSensor, encode_frame, wander


@pytest.fixture
def frames(tmp_path, film):
    """A file of bytes: rest, a press, rest."""
    rng, path = np.random.default_rng(5), tmp_path / "frames.bin"
    press = film.charge_pC([2.0], [1.0], [0.5])[0]
    rows = [rng.normal(0, 1, 3) + (press if 150 <= k < 250 else 0.0) for k in range(300)]
    path.write_bytes(b"".join(encode_frame(Frame(k, 5000 * k, tuple(row))) for k, row in enumerate(rows)))
    return path


def messages(path):
    with path.open("rb") as file:
        topics = {}
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, []).append(message)
    return topics


def test_stream_writes_what_it_prints(command, frames, models, tmp_path):
    path = tmp_path / "touch.mcap"
    code, out, _ = command("serve", "stream", "linear", "--port", frames, "--models", models, "--mcap", path)
    assert code == 0
    topics = messages(path)
    assert [message.data.decode() for message in topics["/isocharge/record"]] == out.splitlines()
    records = [json.loads(line) for line in out.splitlines()]
    assert len(records) == len(topics["/isocharge/wrench"]) == 300
    assert len(topics["/isocharge/pose"]) == sum(record["contact"] for record in records) > 90


@pytest.mark.parametrize("records", ["json", "ros2"])
def test_replay_converts_an_old_recording(command, frames, models, tmp_path, records):
    recording, path = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    command("serve", "stream", "linear", "--port", frames, "--models", models, "--record", recording)
    words = ["--models", models, "--mcap", path, "--mcap-records", records]
    code, out, _ = command("serve", "replay", recording, *words)
    assert code == 0
    if records == "json":
        assert [message.data.decode() for message in messages(path)["/isocharge/record"]] == out.splitlines()
    else:
        ros = get_typestore(Stores.ROS2_JAZZY)
        with Reader(path) as reader:
            topic = [each for each in reader.connections if each.topic == "/isocharge/record"]
            lines = [ros.deserialize_cdr(data, each.msgtype).data for each, _, data in reader.messages(topic)]
        assert lines == out.splitlines()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["frames.bin", "touch.mcap", "touch.rec"]
    before = path.read_bytes()
    code, out, err = command("serve", "replay", recording, *words)
    assert (code, out) == (1, "")
    assert f"OutputExists: {path} is already there" in err
    assert path.read_bytes() == before


def test_a_damaged_recording_leaves_no_file(command, frames, models, tmp_path):
    recording, path = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    command("serve", "stream", "linear", "--port", frames, "--models", models, "--record", recording)
    lines = recording.read_text().splitlines()
    recording.write_text("\n".join([*lines[:50], "damaged", *lines[50:], ""]))
    code, _, err = command("serve", "replay", recording, "--models", models, "--mcap", path)
    assert (code, "line 51: damaged" in err) == (2, True)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["frames.bin", "touch.rec"]


def test_a_recording_of_another_age_is_refused_with_the_reason(command, frames, models, tmp_path):
    recording, path = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    command("serve", "stream", "linear", "--port", frames, "--models", models, "--record", recording)
    header = recording.read_text().splitlines()[0]
    chunk = [-5.0, 1, 0.0, base64.b64encode(frames.read_bytes()).decode()]
    record = json.dumps({"timestamp": -5.0, "latency_us": 1.0})
    recording.write_text("\n".join([header, json.dumps({"chunk": chunk}), record, ""]))
    code, _, err = command("serve", "replay", recording, "--models", models, "--mcap", path)
    assert (code, "expected unix seconds from 1970 to 2038" in err) == (2, True)
    assert not path.exists()


def test_a_live_stream_that_is_stopped_ends_its_file(film, models, start_command, tmp_path):
    path = tmp_path / "touch.mcap"
    with VirtualSensor(film.charges, wander(seed=2, seconds=20.0)) as sensor:
        process = start_command("serve", "stream", "linear", "--port", sensor.url, "--models", models, "--mcap", path)
        lines = [process.stdout.readline() for _ in range(150)]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, "Traceback" in err) == (0, False)
    written = [message.data.decode() for message in messages(path)["/isocharge/record"]]
    assert written == [*map(str.rstrip, lines), *out.splitlines()]


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
    assert code == 1
    assert "'mcap', which is not installed; pip install 'isocharge[record]'" in err
    assert not path.exists()
