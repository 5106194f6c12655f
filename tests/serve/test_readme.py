"""What serve/README.md shows is true: its examples run, its frame is a frame, its tables are complete."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from isocharge.serve import Frame, encode_frame, flags
from isocharge.serve.cobs import cobs_decode
from isocharge.serve.limits import Limits
from isocharge.serve.shelf import open_shelf
from isocharge.serve.v2 import Handler

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
        example = example.replace("127.0.0.1:8000", start_http(Handler(open_shelf())).url.removeprefix("http://"))
    exec(compile(example, "serve/README.md", "exec"), {})
    assert capsys.readouterr().out


@pytest.mark.skipif(shutil.which("curl") is None, reason="the example uses curl")
def test_http_example_runs():
    (example,) = (block for block in re.findall(r"```sh\n(.*?)```", README, re.DOTALL) if "curl" in block)
    ports = {"8000": "", "8001": ""}
    with ExitStack() as stack:
        for port in ports:
            free = stack.enter_context(socket.socket())
            free.bind(("127.0.0.1", 0))
            ports[port] = str(free.getsockname()[1])
    for port, free in ports.items():
        example = example.replace(port, free)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    words = ["bash", "-ec", f"trap 'kill $!; wait' EXIT\n{example}"]
    run = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60, check=True)
    outputs = json.loads(run.stdout[run.stdout.index("{") :])["outputs"]
    assert outputs[0]["data"] == pytest.approx([3.0, -2.0, 1.0], abs=0.02)


def test_every_option_and_bound_is_the_command_s():
    """The table of bounds says what `--help` and the limits say."""
    text = subprocess.run(
        [sys.executable, "-m", "isocharge.cli", "serve", "http", "--help"], capture_output=True, text=True, check=True
    ).stdout
    section = README[README.index("## Over HTTP") : README.index("### How fast")]
    assert all(option in text for option in re.findall(r"`(--[a-z-]+)`", section))
    limits = Limits()
    assert f"| {limits.batch} |" in section
    assert (limits.header_seconds, limits.body_seconds, limits.idle_seconds) == (10.0, 30.0, 75.0)
    assert (limits.body_bytes, limits.header_bytes, limits.connections) == (1 << 20, 16 << 10, 1024)


def test_every_module_is_listed():
    modules = {path.name for path in (SERVE / "isocharge/serve").glob("*.py")} - {"__init__.py", "arrays.py"}
    assert modules == {name for name in re.findall(r"`(\w+\.py)`", README) if name != "__init__.py"}


def test_every_flag_is_explained():
    words = {value for name, value in vars(flags).items() if name.isupper()}
    table = README[README.index("| flag |") : README.index("## Tare")]
    assert words <= set(re.findall(r"`(\w+)`", table))
