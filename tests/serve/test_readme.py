"""What serve/README.md shows is true: its examples run, its frame is a frame, its tables are complete."""

import json
import re
import shutil
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from isocharge.serve import Frame, TextParser, encode_frame, flags, load_device
from isocharge.serve.frames.cobs import cobs_decode
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler

SERVE = Path(__file__).parents[2] / "serve"
README = (SERVE / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_frame_example():
    before, after = (
        bytes.fromhex(line) for line in re.search(r"```text\n(.*?)\n```", README, re.DOTALL)[1].split("\n")
    )
    assert encode_frame(Frame(1, 5000, (850.0, 840.5, 846.25))) == after
    assert cobs_decode(after[:-1]) == before


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_example_runs(example, capsys, start_http):
    if "127.0.0.1:8000" in example:
        example = example.replace("127.0.0.1:8000", start_http(Handler(open_model_store())).url.removeprefix("http://"))
    exec(compile(example, "serve/README.md", "exec"), {})
    assert capsys.readouterr().out


@pytest.mark.skipif(shutil.which("curl") is None, reason="the example uses curl")
def test_http_example_runs(shell):
    (example,) = (block for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL) if "curl" in block)
    ports = {"8000": "", "8001": ""}
    with ExitStack() as stack:
        for port in ports:
            free = stack.enter_context(socket.socket())
            free.bind(("127.0.0.1", 0))
            ports[port] = str(free.getsockname()[1])
    for port, free in ports.items():
        example = example.replace(port, free)
    printed = shell(f"trap 'kill $!; wait' EXIT\n{example}", timeout=60)
    outputs = json.loads(printed[printed.index("{") :])["outputs"]
    assert outputs[0]["data"] == pytest.approx([3.0, -2.0, 1.0], abs=0.02)


def test_every_option_and_bound_is_the_command_s():
    """The table of bounds says what `--help` and the limits say."""
    text = subprocess.run(
        [sys.executable, "-m", "isocharge.cli", "serve", "http", "--help"], capture_output=True, text=True, check=True
    ).stdout
    section = README[README.index("## Over HTTP") : README.index("### How fast")]
    assert all(option in text for option in re.findall(r"`(--[a-z-]+)`", section))
    limits = ServerLimits()
    assert f"| {limits.batch} |" in section
    assert (limits.header_seconds, limits.body_seconds, limits.idle_seconds) == (10.0, 30.0, 75.0)
    assert (limits.body_bytes, limits.header_bytes, limits.connections) == (1 << 20, 16 << 10, 1024)


def test_every_flag_is_explained():
    words = {value for name, value in vars(flags).items() if name.isupper()}
    table = README[README.index("| flag |") : README.index("## Tare")]
    assert words <= set(re.findall(r"`(\w+)`", table))


def test_the_device_file_is_one(tmp_path):
    path = tmp_path / "device.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", README, re.DOTALL)[1])
    board = load_device(path)
    chain = board.chain(("A", "B", "C"))
    assert board.parser().layout.length == 18
    stages = (chain.gain_pC, chain.limit_pC, chain.hum, chain.tare, chain.leak, chain.touch)
    assert not any(stage is None for stage in stages)


@pytest.mark.parametrize("row", re.findall(r"^\| .*? \| `(.*)` \|$", README[README.index("## Text") :], re.MULTILINE))
def test_lines_of_text_are_read(row):
    line = row.encode() + b"\n"
    lines = line if ">" not in row else line + line.replace(b">A", b">B") + line.replace(b">A", b">C")
    (frame, *_) = TextParser().feed(b"\n" + lines * 3)
    assert frame.values[0] == 801.2
    assert len(frame.values) == 3


def test_recording_example_runs_line_by_line(tmp_path, shell):
    """The commands as they stand, with a sensor that stops by itself and the files in one folder."""
    (example,) = (block for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL) if "doctor" in block)
    lines = [line.split("  #")[0] for line in example.replace("/tmp/", f"{tmp_path}/").splitlines()]
    lines = [
        f"{line[:-1]} --seconds 30 > url &" if line.rstrip().endswith("&") else line for line in map(str.rstrip, lines)
    ]
    waiting = f"while [ ! -e {tmp_path}/film ]; do sleep 0.1; done"
    script = "\n".join([lines[0], lines[1], waiting, *lines[2:-1], f"{lines[-1]} > again.jsonl", "kill %1", "wait"])
    (tmp_path / "presses.csv").write_text("A,B,C\n850,840,846\n")
    printed = shell(script.replace("--seconds 10", "--seconds 2").replace("doctor", "doctor --seconds 1"), cwd=tmp_path)
    assert "binary frames of isocharge" in printed
    assert (tmp_path / "again.jsonl").read_text() == (tmp_path / "touch.jsonl").read_text()
    assert len((tmp_path / "touch.jsonl").read_text().splitlines()) > 300
