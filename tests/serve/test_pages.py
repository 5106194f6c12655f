"""What the pages of serve show is true: their examples run, the frame is a frame, tables are complete."""

import json
import re
import shutil
import socket
import subprocess
import tomllib
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from msgspec.structs import fields

from isocharge.common.errors import DeviceError
from isocharge.serve import Frame, Script, VirtualSensor, device_from_table, encode_frame, flags
from isocharge.serve.frames.text import TextParser
from isocharge.serve.live.device import STAGES
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.signal_chain.touch import TouchRule
from layout_encoder import encode_layout

SERVE = Path(__file__).parents[2] / "serve"
PAGES = {path.name: path.read_text("utf-8") for path in (SERVE / "README.md", *sorted((SERVE / "docs").glob("*.md")))}

SLOW = {"mcap.md", "recordings.md", "virtual_sensor.md", "live_page.md", "secure_service.md"}
"""Pages whose commands simulate a film or start several servers. The tutorial runs always, with another sensor."""


EXAMPLE_PAGES = ["serve/README.md", *(f"serve/docs/{name}" for name in PAGES if name != "README.md")]


def is_slow(example):
    return Path(example.page).name in SLOW and example.language == "sh"


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
def test_the_sketch_for_teensy_and_arduino_compiles_and_sends_lines_that_are_read(tmp_path):
    sketch = tmp_path / "frames.ino"
    sketch.write_text(re.search(r"```cpp\n(.*?)```", PAGES["boards.md"], re.DOTALL)[1])
    board = Path(__file__).parents[1] / "train/export_c/board"
    words = ["g++", "-Wall", "-DISOCHARGE_ELECTRODES=3", f'-DSKETCH="{sketch}"', "-I", board, board / "run_sketch.cpp"]
    subprocess.run([*words, "-o", tmp_path / "sketch"], check=True)
    pins = b"".join(b"%d 512 %d 498\n" % (5000 * k, 500 + k) for k in range(1, 21))
    sent = subprocess.run([tmp_path / "sketch"], input=pins, capture_output=True, check=True).stdout
    frames = TextParser().feed(b"\n" + sent)
    assert frames[-1].values == (512.0, 520.0, 498.0)


def test_frame_of_the_documentation_is_read():
    before, after = (
        bytes.fromhex(line) for line in re.search(r"```text\n(.*?)\n```", PAGES["frames.md"], re.DOTALL)[1].split("\n")
    )
    assert encode_frame(Frame(1, 5000, (850.0, 840.5, 846.25))) == after
    assert cobs.decode(after[:-1]) == before


def test_described_frames_of_the_documentation_are_read():
    table = tomllib.loads(re.search(r"```toml\n(.*?)```", PAGES["device_file.md"], re.DOTALL)[1])
    layout = device_from_table(table, "board.toml").frames
    parser = device_from_table(table, "board.toml").parser()
    frame = Frame(7, 5000, (1.0, 100.0, -200.0, 300.0), names=("status", "adc0", "adc1", "adc2"))
    assert parser.feed(encode_layout(layout, frame)) == [frame]


@pytest.fixture(scope="module")
def desks(tmp_path_factory):
    """An empty folder for each page, in which its examples run."""
    return {page: tmp_path_factory.mktemp("desk") for page in EXAMPLE_PAGES}


@pytest.fixture
def sensor(film, desks):
    """A sensor at rest for the tutorial, in place of that of `serve virtual`, which would solve a film."""
    link = desks["serve/docs/tutorial.md"] / "film"
    with VirtualSensor(film.charges, Script(np.zeros((1, 3)), 200.0), link=link):
        yield


@pytest.mark.usefixtures("sensor")
def test_examples_of_the_pages_run(page_example, desks, installed, start_http, run_example, run_commands):
    """In the order of the page, in the install that it names; Python prints what the comments say."""
    text = re.sub("isocharge serve virtual .* --rest 30 &", "sleep 60 &", page_example.text)
    text = text.replace("--seconds 10", "--seconds 1").replace("bench --seconds 2", "bench --seconds 0.2")
    folder, environment = desks[page_example.page], installed(*page_example.extras)
    if page_example.language == "python":
        if "127.0.0.1:8000" in text:
            text = text.replace("127.0.0.1:8000", start_http(Handler(ModelStore())).url.removeprefix("http://"))
        run_example(text, folder, environment)
        return
    if "curl" in text and shutil.which("curl") is None:
        pytest.skip("the example uses curl")
    check_commands(text, folder, run_commands(on_free_ports(text), folder, environment, timeout=120))


def check_commands(example, folder, printed):
    """What the commands of some examples must have printed."""
    if "client.py" in example:
        assert printed.endswith("['stress']\n")
    elif "/infer" in example:
        outputs = json.loads(printed[printed.index("{") :])["outputs"]
        assert outputs[0]["data"] == pytest.approx([3.0, -2.0, 1.0], abs=0.02)
    if "/session.json | head" in example:
        assert '"model":"three-25um-biaxial/1"' in printed
    if "serve check" in example:
        assert f"```text\n{printed}```" in PAGES["measured_presses.md"]
    if "doctor" in example:
        assert "binary frames of isocharge" in printed
        assert (folder / "again.jsonl").read_text() == (folder / "touch.jsonl").read_text()
        # A busy computer begins to read late, so that only a part of the 400 frames of two seconds is required.
        assert len((folder / "touch.jsonl").read_text().splitlines()) > 100


def on_free_ports(example):
    """The example with ports that nobody uses, on this machine only."""
    with ExitStack() as stack:
        for port in ("8000", "8001", "8002", "8443", "8444"):
            free = stack.enter_context(socket.socket())
            free.bind(("127.0.0.1", 0))
            example = example.replace(port, str(free.getsockname()[1]))
    return example.replace("0.0.0.0", "127.0.0.1")


def test_every_flag_is_explained():
    """Each flag has one row with its meaning and its remedy."""
    words = {value for name, value in vars(flags).items() if name.isupper() and isinstance(value, str)}
    assert words == set(flags.MEANINGS)
    rows = re.findall(r"^\| `(\w+)` \| (.+) \| (.+) \|$", PAGES["flags.md"], re.MULTILINE)
    assert sorted(flag for flag, _, _ in rows) == sorted(words)
    assert all(meaning.endswith((".", ")")) and remedy.endswith(".") for _, meaning, remedy in rows)


REQUIRED = {
    "saturation": {"limit_pC": 1500.0},
    "leak": {"tau_s": 10.0},
    "frames": {"format": "described", "sync": "55", "length": 2, "fields": [{"name": "A", "type": "u8"}]},
}


def known_keys(table):
    """The keys that the reader of a device file knows beside an unknown one, in its own words."""
    with pytest.raises(DeviceError, match="unknown key") as refused:
        device_from_table(table, "device.toml")
    return set(str(refused.value).partition("known are ")[2].split(", "))


def documented(begin, end):
    """The keys in the first cells of the tables between two texts of the page."""
    section = PAGES["device_file.md"].partition("## Every key")[2].partition(begin)[2].partition(end)[0]
    cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return {key for cell in cells for key in re.findall(r"`([\w.]+)`", cell)}


def test_every_key_of_the_device_file_is_explained_and_exists():
    """Both ways, by what the reader itself says that it knows."""
    described = REQUIRED["frames"]
    common = {"format", "request", "request_Hz"}
    assert documented("`[frames]`:", "More keys of described") == known_keys({"frames": {"zz": 1}})
    assert (
        documented("More keys of described", "The keys of a field")
        == known_keys({"frames": described | {"zz": 1}}) - common
    )
    field = described["fields"][0] | {"zz": 1}
    assert documented("The keys of a field", "`[channels]`") == known_keys({"frames": described | {"fields": [field]}})
    assert documented("`[gain]`", "The stages") == known_keys({"gain": {"zz": 1}})
    stages = known_keys({"zz": {}}) - {"name", "front_end", "frames", "channels", "gain"}
    keys = {f"{stage}.{key}" for stage in stages for key in known_keys({stage: {"zz": 1}}) - {"on"}}
    assert documented("The stages", "\n#") == keys


def test_every_default_of_a_stage_is_the_rule_s():
    """Numbers in the tables are those of the code."""
    rules = {stage.section: stage.rule_class for stage in STAGES}
    section = PAGES["device_file.md"].partition("The stages.")[2].partition("\n#")[0]
    assert section.count("| `") > 15
    for line in section.splitlines():
        if not line.startswith("| `"):
            continue
        keys, values = re.findall(r"`([\w.]+)`", line.split("|")[1]), line.split("|")[2].replace("`", "").split(",")
        for key, value in zip(keys, values, strict=True):
            stage, name = key.split(".")
            if value.strip() != "required":
                default = {item.name: item.default for item in fields(rules[stage])}[name]
                if stage == "touch":
                    default = getattr(TouchRule().resolved(has_currents=False), name)
                words = "true" if default is True else "alike" if default is None else f"{default:g}"
                assert value.strip() == words, key


@pytest.mark.parametrize("row", re.findall(r"^\| .*? \| `(.*)` \|$", PAGES["frames.md"], re.MULTILINE))
def test_lines_of_text_are_read(row):
    line = row.encode() + b"\n"
    lines = line if ">" not in row else line + line.replace(b">A", b">B") + line.replace(b">A", b">C")
    (frame, *_) = TextParser().feed(b"\n" + lines * 12)
    assert frame.values[0] == (801.0 if "0x" in row else 801.2)
    assert len(frame.values) == 3
