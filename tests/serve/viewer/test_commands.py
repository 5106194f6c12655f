"""`serve stream --live` and `serve replay --live` as a person starts them, followed by the stock client."""

import asyncio
import json
import os
import re
import signal
import socket
import struct
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from websockets.asyncio.client import connect

from isocharge.serve import Recording, Script, VirtualSensor
from isocharge.serve.viewer.messages import HEADER
from isocharge.serve.viewer.samples import CONTACT_BIT, SampleFormat

FORM = SampleFormat(("A", "B", "C"))


@pytest.fixture
def sensor(film):
    """A press at (3, -2) mm of 1 N for 0.6 s, each 2 s."""
    touching = (np.arange(400) % 400) > 280
    script = Script(
        np.where(touching, 3.0, np.nan), np.where(touching, -2.0, np.nan), np.where(touching, 1.0, 0.0), rate_Hz=200.0
    )
    with VirtualSensor(film.charges, script) as playing:
        yield playing


def url_in(process):
    """The address that a command says on stderr."""
    while line := process.stderr.readline():
        if match := re.search(r"page: (http\S+?);?\s", line):
            return match[1]
    raise AssertionError(process.communicate())


def stop(process):
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    return out, err


async def follow(url, until, ask=()):
    """Samples (and the last state) until there are enough."""
    rows, state = [], {}
    async with connect(url.replace("http", "ws", 1) + "/live") as client:
        for request in ask:
            await client.send(json.dumps(request))
        end = time.monotonic() + 20
        while time.monotonic() < end:
            data = await asyncio.wait_for(client.recv(), 10)
            if isinstance(data, str):
                state |= json.loads(data).get("state", {})
            else:
                rows.append(np.frombuffer(data, FORM.dtype, offset=HEADER.size))
                await client.send(struct.pack("<I", HEADER.unpack_from(data)[3]))
            seen = np.concatenate([np.zeros(0, FORM.dtype), *rows])
            if until(seen, state):
                return seen, state
    raise AssertionError((state, len(rows)))


def touched(rows, _):
    return ((rows["flags"] & CONTACT_BIT) != 0).sum() > 10


def test_a_press_is_on_the_page_where_it_is(sensor, models, start_command):
    process = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live", "127.0.0.1:0"),
        *("--count", 600),
    )
    url = url_in(process)
    rows, state = asyncio.run(follow(url, lambda rows, state: touched(rows, state) and "counters" in state))
    contacts = rows[(rows["flags"] & CONTACT_BIT) != 0]
    assert np.median(contacts["x_mm"]) == pytest.approx(3.0, abs=1e-3)
    assert np.median(contacts["force_N"]) == pytest.approx(1.0, abs=1e-3)
    assert state["counters"]["lost"] == 0
    session = json.load(urllib.request.urlopen(url + "/session.json"))
    assert session["film"]["model"] == "linear/1"
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert len(out.splitlines()) == 600
    assert "Traceback" not in err


def test_a_recording_begun_on_the_page_is_repeated_bit_for_bit(
    sensor, models, start_command, command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    process = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live", "127.0.0.1:0")
    )
    url = url_in(process)
    asyncio.run(follow(url, lambda rows, _: len(rows) > 50))
    record, marker = {"do": "record", "on": True}, {"do": "marker", "text": "here"}
    asyncio.run(follow(url, lambda _, state: state.get("recording"), [record]))
    asyncio.run(follow(url, touched, [marker]))
    asyncio.run(follow(url, lambda _, state: state and not state["recording"], [{"do": "record", "on": False}]))
    out, _ = stop(process)
    (path,) = tmp_path.glob("linear-1-*.rec")
    written = [line for line in path.read_text().splitlines() if line.startswith('{"timestamp"')]
    assert "\n".join(written) in out
    code, replayed, _ = command("serve", "replay", path, "--models", models)
    assert code == 0
    assert replayed.splitlines() == written
    assert any(json.loads(line)["contact"] for line in written)
    (marked,) = [moment for moment in Recording(path).events() if hasattr(moment, "text")]
    assert marked.text == "here"


def test_a_replay_is_sought_and_played_fast(sensor, models, start_command, tmp_path):
    """Ctrl-C is the only end of such a replay: its MCAP file is whole before."""
    path, mcap = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    recorded = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--record", path, "--count", 600)
    )
    assert len(recorded.communicate(timeout=30)[0].splitlines()) == 600
    process = start_command(
        *("serve", "replay", path, "--models", models, "--live", "127.0.0.1:0", "--output", "none", "--mcap", mcap)
    )
    url = url_in(process)

    def played(rows, state):
        return rows["records"].sum() >= 600 and state.get("samples") == 600

    rows, state = asyncio.run(follow(url, played, [{"do": "speed", "value": 24}]))
    assert rows["records"].sum() == 600
    assert state["is_complete"]
    assert max(state["overview"]) == pytest.approx(1.0, abs=0.05)
    begun = time.monotonic()
    rows, _ = asyncio.run(follow(url, lambda rows, _: rows["records"].sum() > 480, [{"do": "seek", "value": 2.5}]))
    assert time.monotonic() - begun < 2.4
    assert mcap.exists()
    stop(process)
    with mcap.open("rb") as file:
        assert 600 in make_reader(file).get_summary().statistics.channel_message_counts.values()


def test_a_taken_port_is_said(models, sensor, start_command):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        process = start_command(
            *("serve", "stream", "linear", "--models", models, "--port", sensor.url),
            *("--live", f"127.0.0.1:{taken.getsockname()[1]}"),
        )
        _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "another program listens there" in err
    assert "Traceback" not in err


def test_others_are_let_in_on_purpose_only(models, command):
    code, _, err = command("serve", "stream", "linear", "--models", models, "--port", "x", "--live", "[::]:0")
    assert code == 2
    assert "--token" in err


def test_the_stream_goes_on_without_its_page(sensor, models, start_command):
    process = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live", "127.0.0.1:0"),
        *("--count", 400),
    )
    url_in(process)
    (page,) = (
        each.split()[0]
        for each in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if "resource_tracker" not in Path(f"/proc/{each}/cmdline").read_text()
    )
    os.kill(int(page), signal.SIGKILL)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert len(out.splitlines()) == 400
    assert "goes on without it" in err
