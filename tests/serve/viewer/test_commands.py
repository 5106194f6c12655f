"""`serve stream --live`, `serve replay --live`, `serve live` as a person starts them, followed by the stock client."""

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
from isocharge.serve.viewer.sample import CONTACT_BIT, SampleFormat

FORM = SampleFormat(("A", "B", "C"))


@pytest.fixture
def sensor(film):
    """A press at (3, -2) mm of 1 N for 0.6 s, each 2 s."""
    touching = (np.arange(400) % 400) > 280
    script = Script(
        np.where(touching, 3.0, np.nan), np.where(touching, -2.0, np.nan), np.where(touching, 1.0, 0.0), rate_Hz=200.0
    )
    with VirtualSensor(film.charge_pC, script) as playing:
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
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live", "--live-port", 0),
        *("--count", 1200),
    )
    url = url_in(process)
    rows, state = asyncio.run(follow(url, lambda rows, state: touched(rows, state) and "counters" in state))
    contacts = rows[(rows["flags"] & CONTACT_BIT) != 0]
    assert np.median(contacts["x_mm"]) == pytest.approx(3.0, abs=1e-3)
    assert np.median(contacts["force_N"]) == pytest.approx(1.0, abs=1e-3)
    assert state["counters"]["lost"] == 0
    session = json.load(urllib.request.urlopen(url + "/session.json"))
    assert session["films"][0]["model"] == "linear/1"
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert len(out.splitlines()) == 1200
    assert "Traceback" not in err


def test_a_recording_begun_on_the_page_is_repeated_bit_for_bit(
    sensor, models, start_command, command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    process = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live", "--live-port", 0)
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
    (marked,) = [moment for moment in Recording(path).events_and_markers() if hasattr(moment, "text")]
    assert marked.text == "here"


def test_a_replay_is_sought_and_played_fast(sensor, models, start_command, tmp_path):
    path = tmp_path / "touch.rec"
    made = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--record", path, "--count", 1000)
    )
    assert len(made.communicate(timeout=30)[0].splitlines()) == 1000
    process = start_command(
        *("serve", "replay", path, "--models", models, "--live", "--live-port", 0, "--output", "none")
    )
    url = url_in(process)

    def played(rows, state):
        return rows["records"].sum() >= 1000 and state.get("samples") == 1000

    rows, state = asyncio.run(follow(url, played, [{"do": "speed", "value": 24}]))
    assert rows["records"].sum() == 1000
    assert state["is_complete"]
    assert max(state["overview"]) == pytest.approx(1.0, abs=0.05)
    begun = time.monotonic()
    rows, _ = asyncio.run(follow(url, lambda rows, _: rows["records"].sum() > 790, [{"do": "seek", "value": 4.0}]))
    assert time.monotonic() - begun < 4.0
    stop(process)


def test_two_films_by_a_file(film, models, start_command, tmp_path):
    touching = np.arange(400) > 200
    scripts = [
        Script(np.where(touching, x, np.nan), np.where(touching, 0.0, np.nan), np.where(touching, 1.0, 0.0), 200.0)
        for x in (-4.0, 4.0)
    ]
    with VirtualSensor(film.charge_pC, scripts[0]) as left, VirtualSensor(film.charge_pC, scripts[1]) as right:
        streams = tmp_path / "two.toml"
        streams.write_text(
            "".join(
                f'[[stream]]\nname = "{name}"\nmodel = "linear"\nport = "{playing.url}"\n'
                for name, playing in (("left", left), ("right", right))
            )
        )
        process = start_command("serve", "live", streams, "--models", models, "--live-port", 0)
        url = url_in(process)

        def both(rows, _):
            places = rows["x_mm"][(rows["flags"] & CONTACT_BIT) != 0]
            return (places > 3.9).any() and (places < -3.9).any()

        asyncio.run(follow(url, both))
        stop(process)


def test_a_taken_port_is_said(models, sensor, start_command):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        process = start_command(
            *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live"),
            *("--live-port", taken.getsockname()[1]),
        )
        _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "another program listens there" in err
    assert "Traceback" not in err


def test_others_are_let_in_on_purpose_only(models, command):
    code, _, err = command(
        "serve", "stream", "linear", "--models", models, "--port", "x", "--live", "--live-host", "::"
    )
    assert code == 2
    assert "--token" in err


def test_a_film_without_a_sensor_says_why(models, tmp_path, start_command):
    streams = tmp_path / "one.toml"
    streams.write_text('[[stream]]\nmodel = "linear"\nport = "nowhere"\n')
    process = start_command("serve", "live", streams, "--models", models, "--live-port", 0)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "nowhere: cannot be opened" in err
    assert "Traceback" not in err


def test_the_stream_goes_on_without_its_page(sensor, models, start_command):
    process = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--live", "--live-port", 0),
        *("--count", 1000),
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
    assert len(out.splitlines()) == 1000
    assert "goes on without it" in err


def test_a_replay_on_the_page_leaves_its_mcap_file(sensor, models, start_command, tmp_path):
    """Ctrl-C is the only end of such a replay: the file is whole before."""
    path, mcap = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    made = start_command(
        *("serve", "stream", "linear", "--models", models, "--port", sensor.url, "--record", path, "--count", 200)
    )
    made.communicate(timeout=30)
    process = start_command(
        *("serve", "replay", path, "--models", models, "--live", "--live-port", 0, "--output", "none"),
        *("--mcap", mcap),
    )
    asyncio.run(follow(url_in(process), lambda _, state: state.get("is_complete")))
    assert mcap.exists()
    stop(process)
    with mcap.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert 200 in summary.statistics.channel_message_counts.values()


def test_readers_end_when_their_page_is_killed(sensor, models, start_command, tmp_path):
    """Else they would hold their ports for ever."""
    streams = tmp_path / "one.toml"
    streams.write_text(f'[[stream]]\nmodel = "linear"\nport = "{sensor.url}"\n')
    process = start_command("serve", "live", streams, "--models", models, "--live-port", 0)
    asyncio.run(follow(url_in(process), lambda rows, _: len(rows) > 0))
    process.kill()
    _, err = process.communicate(timeout=20)  # returns once the reader, too, has closed stderr
    assert "this stream ends with it" in err


def test_the_help_names_the_table_of_a_stream(command):
    _, out, _ = command("serve", "live", "--help")
    assert "[[stream]]" in out
