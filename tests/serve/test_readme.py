"""What serve/README.md shows is true: its examples run, its frame is a frame, its tables are complete."""

import re
from pathlib import Path

import pytest

from isocharge.serve import Frame, encode_frame, flags
from isocharge.serve.cobs import cobs_decode

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
def test_example_runs(example, capsys):
    exec(compile(example, "serve/README.md", "exec"), {})
    assert capsys.readouterr().out


def test_every_module_is_listed():
    modules = {path.name for path in (SERVE / "isocharge/serve").glob("*.py")} - {"__init__.py", "arrays.py"}
    assert modules == {name for name in re.findall(r"`(\w+\.py)`", README) if name != "__init__.py"}


def test_every_flag_is_explained():
    words = {value for name, value in vars(flags).items() if name.isupper()}
    table = README[README.index("| flag |") : README.index("## Tare")]
    assert words <= set(re.findall(r"`(\w+)`", table))
