"""`serve stream --live` and `serve replay --live` as a person starts them, followed by the stock client."""

import asyncio
import json
import os
import re
import signal
import struct
import urllib.request
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader
from websockets.asyncio.client import connect

from boards import taps
from isocharge.cli.shared import live_page as live_page_module
from isocharge.serve import Frame, TouchStream, encode_frame
from isocharge.serve.viewer.messages import CONTACT_BIT, HEADER, SampleFormat

FORM = SampleFormat(("A", "B", "C"))


@pytest.fixture
def start(models, start_command):
    """Start a command with a page: the process, and the page's address."""

    def start(*words):
        process = start_command("serve", *words, "--models", models, "--live", "127.0.0.1:0")
        while line := process.stderr.readline():
            if match := re.search(r"page: (http\S+?);?\s", line):
                return process, match[1]
        raise AssertionError(process.communicate())

    return start


async def _follow(url, until, ask):
    rows, state = np.zeros(0, FORM.dtype), {}
    async with connect(url.replace("http", "ws", 1) + "/live") as client, asyncio.timeout(60):
        for request in ask:
            await client.send(json.dumps(request))
        while not until(rows, state):
            data = await client.recv()
            if isinstance(data, str):
                state |= json.loads(data).get("state", {})
            else:
                rows = np.concatenate([rows, np.frombuffer(data, FORM.dtype, offset=HEADER.size)])
                await client.send(struct.pack("<I", HEADER.unpack_from(data)[3]))
    return rows, state


def follow(url, until, *ask):
    """Ask, and take samples (and the last state) until there are enough."""
    return asyncio.run(_follow(url, until, ask))


def touched(rows, _):
    return ((rows["flags"] & CONTACT_BIT) != 0).sum() > 10


def test_live_page_shows_a_press_and_the_stream_continues_without_the_page(board, start):
    process, url = start("stream", "linear", "--port", board.url, "--output", "none")
    rows, state = follow(url, lambda rows, state: touched(rows, state) and state.get("rate_Hz"))
    contacts = rows[(rows["flags"] & CONTACT_BIT) != 0]
    assert [np.median(contacts[name]) for name in ("x_mm", "force_N")] == pytest.approx([3.0, 1.0], abs=0.01)
    assert state["counters"]["lost"] == 0
    assert 1000.0 < state["rate_Hz"] < 3000.0 or os.getloadavg()[0] > 2.0
    assert json.load(urllib.request.urlopen(url + "/session.json"))["film"]["model"] == "linear/1"
    (page,) = (
        each.split()[0]
        for each in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if "resource_tracker" not in Path(f"/proc/{each}/cmdline").read_text()
    )
    os.kill(int(page), signal.SIGKILL)
    while "goes on without it" not in (line := process.stderr.readline()):
        assert line
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (0, False)


def test_displayed_frame_rate_is_that_of_the_board_in_a_fast_replay(predictor, record, monkeypatch, capsys):
    """Unknown until time has passed between two frames."""
    monkeypatch.setattr(live_page_module, "STATE_INTERVAL_S", -1.0)
    states = []
    link = SimpleNamespace(send_sample=id, send_message=lambda **state: states.append(state), is_open=True, dropped=0)
    feed = live_page_module.PageFeed(link, TouchStream(predictor))
    for k in (0, 0, *range(2, 51)):
        feed.write(record(timestamp=1e9 + 0.005 * k))
    assert [state["rate_Hz"] for state in states[:2]] == [None, None]
    monkeypatch.setattr(live_page_module, "STATE_INTERVAL_S", 60.0)
    feed.write(record())
    assert (len(states), states[-1]["rate_Hz"]) == (51, pytest.approx(200.0, rel=1e-3))
    assert capsys.readouterr().err == ""  # the page is there


def test_replay_page_seeks_and_plays_at_another_speed(film, models, start, command, tmp_path):
    """Ctrl-C is the only end of such a replay: its MCAP file is whole before."""
    path, mcap = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    rows = [encode_frame(Frame(k, 5000 * k, tuple(row))) for k, row in enumerate(islice(taps(film), 600))]
    (tmp_path / "frames").write_bytes(b"".join(rows))
    command("serve", "stream", "linear", "--models", models, "--port", tmp_path / "frames", "--record", path)
    process, url = start("replay", path, "--output", "none", "--output", mcap)

    def played(rows, state):
        return rows["records"].sum() >= 600 and state.get("samples") == 600 and state.get("is_complete")

    rows, state = follow(url, played, {"do": "speed", "value": 24})
    assert rows["records"].sum() == 600
    assert max(state["overview"]) == pytest.approx(1.0, abs=0.05)
    follow(url, lambda rows, _: rows["records"].sum() > 480, {"do": "pause"}, {"do": "seek", "value": 2.5})
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    with mcap.open("rb") as file:
        assert 600 in make_reader(file).get_summary().statistics.channel_message_counts.values()


def test_page_behind_a_proxy_has_the_host_name_of_allow_host(board, start):
    """The proxy keeps the name in Host, or replaces it by the address of the page."""
    _, url = start("stream", "linear", "--port", board.url, "--output", "none", "--allow-host", "proxy.example")
    for host in ("proxy.example", url.removeprefix("http://")):
        request = urllib.request.Request(
            url + "/session.json", headers={"Host": host, "Origin": "http://proxy.example"}
        )
        assert urllib.request.urlopen(request, timeout=20).status == 200


def test_allow_host_of_the_page_expects_a_host_name(refused, models):
    words = ("--port", "x", "--models", models, "--live", "0", "--allow-host", "http://proxy.example")
    refused("serve", "stream", "linear", *words, message="--allow-host: expected a host name without scheme")


@pytest.mark.parametrize(
    ("live", "message"),
    [
        ("[::]:0", "--token"),  # others are let in on purpose only
        (":8001", "expected PORT or HOST:PORT"),
        ("127.0.0.1:x", "expected PORT or HOST:PORT"),
        ("127.0.0.1:65536", "expected PORT or HOST:PORT"),
        ("65536", "expected PORT or HOST:PORT"),
        ("1" * 5000, "expected PORT or HOST:PORT"),
    ],
)
def test_wrong_addresses_of_the_live_page_are_refused(models, refused, live, message):
    refused("serve", "stream", "linear", "--models", models, "--port", "x", "--live", live, message=message)
