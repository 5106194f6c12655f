"""`serve stream --live` and `serve replay --live` as a person starts them."""

import signal
import time
from itertools import islice

import numpy as np
import pytest
from mcap.reader import make_reader

from boards import encoded_frames, taps


def follow(client, until):
    """Read samples and the state until there are enough. Return the samples by column."""
    columns = client.session()["columns"]
    rows, state, answer = [], {}, {"first": None}
    end_s = time.monotonic() + 60.0
    while True:
        answer = client.ask("read", first=answer["first"])
        state |= answer.get("state", {})
        rows += answer["samples"]
        samples = dict(zip(columns, np.array(rows, float).reshape(-1, len(columns)).T, strict=True))
        if until(samples, state):
            return samples, state
        assert time.monotonic() < end_s
        time.sleep(0.02)


def touched(samples, _):
    return samples["contact"].sum() > 10


def test_live_page_with_allow_host_shows_a_press_and_carries_out_requests(board, start_live, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = ("--output", "none", "--allow-host", "proxy.example")
    process, client = start_live("stream", "linear", "--port", board.url, *options)
    samples, _ = follow(client, lambda samples, state: touched(samples, state) and state.get("rate_Hz"))
    is_contact = samples["contact"] == 1.0
    assert [np.median(samples[name][is_contact]) for name in ("x_mm", "force_N")] == pytest.approx([3.0, 1.0], abs=0.01)
    for host in ("proxy.example", client.url.removeprefix("http://")):  # a proxy keeps or replaces the name in Host
        assert client.send("GET", "/session.json", Host=host, Origin="http://proxy.example")[0] == 200

    client.ask("record", on=True)
    client.ask("record", on=False)
    client.ask("record", on=True)  # within the same second
    follow(client, lambda _, state: str(state.get("recording", "")).endswith(".rec"))
    # A second browser cannot end the recording of the first by beginning one.
    assert client.send("POST", "/request", {"do": "record", "on": True})[0] == 400
    client.ask("marker", text="here")
    follow(client, lambda _, state: state.get("markers"))
    client.ask("record", on=False)
    follow(client, lambda _, state: state.get("recording") is None)
    _, path = sorted(tmp_path.glob("linear-1-*.rec"))
    follow(client, lambda *_: '"here"' in path.read_text())  # the stream carries requests out at its next chunk
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (0, False)


def test_replay_page_shows_the_whole_recording(film, models, start_live, command, tmp_path):
    """Ctrl-C is the only end of such a replay: its MCAP file is whole before."""
    path, mcap = tmp_path / "touch.rec", tmp_path / "touch.mcap"
    (tmp_path / "frames").write_bytes(b"".join(encoded_frames(islice(taps(film), 600))))
    command("serve", "stream", "linear", "--models", models, "--port", tmp_path / "frames", "--record", path)
    process, client = start_live("replay", path, "--output", "none", "--output", mcap)

    samples, state = follow(client, lambda _, state: state.get("is_complete") and state.get("samples") == 600)
    assert state["counters"]["frames"] == 600  # also if the recording is read faster than counters are shown
    assert samples["records"].sum() == 600
    assert max(state["overview"]) == pytest.approx(1.0, abs=0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    with mcap.open("rb") as file:
        assert 600 in make_reader(file).get_summary().statistics.channel_message_counts.values()


@pytest.mark.parametrize(
    ("live", "message"),
    [
        ("[::]:0", "--token"),  # others are let in on purpose only
        ("127.0.0.1:x", "expected PORT or HOST:PORT"),
        ("127.0.0.1:65536", "expected PORT or HOST:PORT"),
        ("1" * 5000, "expected PORT or HOST:PORT"),
    ],
)
def test_wrong_addresses_of_the_live_page_are_refused(models, refused, live, message):
    refused("serve", "stream", "linear", "--models", models, "--port", "x", "--live", live, message=message)
