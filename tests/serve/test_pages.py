"""What the pages of serve show is true: their examples run, the frame is a frame, tables are complete."""

import json
import re
import shutil
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from isocharge.serve import Frame, encode_frame
from isocharge.serve.frames.stuffing import cobs_decode
from isocharge.serve.frames.text import TextParser
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler

SERVE = Path(__file__).parents[2] / "serve"
PAGES = {path.name: path.read_text("utf-8") for path in (SERVE / "README.md", *sorted((SERVE / "docs").glob("*.md")))}

SLOW = {"mcap.md", "recordings.md", "virtual_sensor.md", "live_page.md"}
"""Pages whose commands simulate a film each time; those of the README, which do the same, run always."""


EXAMPLE_PAGES = ["serve/README.md", *(f"serve/docs/{name}" for name in PAGES if name != "README.md")]


def is_slow(example):
    return Path(example.page).name in SLOW and example.language == "sh"


def test_frame_example():
    before, after = (
        bytes.fromhex(line) for line in re.search(r"```text\n(.*?)\n```", PAGES["frames.md"], re.DOTALL)[1].split("\n")
    )
    assert encode_frame(Frame(1, 5000, (850.0, 840.5, 846.25))) == after
    assert cobs_decode(after[:-1]) == before


@pytest.fixture(scope="module")
def desks(tmp_path_factory):
    """A folder for each page, with the presses that its reader has already."""
    folders = {page: tmp_path_factory.mktemp("desk") for page in EXAMPLE_PAGES}
    (folders["serve/README.md"] / "presses.csv").write_text("A,B,C\n850,840,846\n")
    return folders


def test_an_example_does_what_it_says(page_example, desks, installed, start_http, run_example, run_commands):
    """In the order of the page, in the install that it names; Python prints what the comments say."""
    text, folder, environment = page_example.text, desks[page_example.page], installed(*page_example.extras)
    if page_example.language == "python":
        if "127.0.0.1:8000" in text:
            text = text.replace("127.0.0.1:8000", start_http(Handler(open_model_store())).url.removeprefix("http://"))
        run_example(text, folder, environment)
        return
    if "curl" in text and shutil.which("curl") is None:
        pytest.skip("the example uses curl")
    check_commands(text, folder, run_commands(on_free_ports(text), folder, environment, timeout=120))


def check_commands(example, folder, printed):
    """What the commands of some examples must have printed."""
    if "/infer" in example:
        outputs = json.loads(printed[printed.index("{") :])["outputs"]
        assert outputs[0]["data"] == pytest.approx([3.0, -2.0, 1.0], abs=0.02)
    if "serve check" in example:
        assert f"```text\n{printed}```" in PAGES["measured_presses.md"]
    if "doctor" in example:
        assert "binary frames of isocharge" in printed
        assert (folder / "again.jsonl").read_text() == (folder / "touch.jsonl").read_text()
        assert len((folder / "touch.jsonl").read_text().splitlines()) > 300


def on_free_ports(example):
    """The example with ports that nobody uses."""
    with ExitStack() as stack:
        for port in ("8000", "8001"):
            free = stack.enter_context(socket.socket())
            free.bind(("127.0.0.1", 0))
            example = example.replace(port, str(free.getsockname()[1]))
    return example


@pytest.mark.parametrize("row", re.findall(r"^\| .*? \| `(.*)` \|$", PAGES["frames.md"], re.MULTILINE))
def test_lines_of_text_are_read(row):
    line = row.encode() + b"\n"
    lines = line if ">" not in row else line + line.replace(b">A", b">B") + line.replace(b">A", b">C")
    (frame, *_) = TextParser().feed(b"\n" + lines * 3)
    assert frame.values[0] == 801.2
    assert len(frame.values) == 3
