"""What every command line has: a version, and completion by the shell."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import isocharge.simulate
import isocharge.train

ROOT = Path(__file__).parents[2]
ISOCHARGE = Path(sys.executable).parent / "isocharge"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]


def run(*words, **variables):
    environment = os.environ | variables
    return subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60, check=True).stdout


def test_version(command):
    assert command("--version") == (0, f"isocharge {VERSION}\n", "")


def test_the_module_is_the_command():
    assert run(sys.executable, "-m", "isocharge.cli", "--version") == run(ISOCHARGE, "--version")


def test_the_version_costs_nothing_until_it_is_asked_for():
    code = (
        "import sys, isocharge.serve as s; loaded = 'importlib.metadata' in sys.modules\n"
        "print(s.__version__, loaded, hasattr(s, 'nothing'))"
    )
    assert run(sys.executable, "-c", code).split() == [VERSION, "False", "False"]
    assert isocharge.simulate.__version__ == isocharge.train.__version__ == VERSION


@pytest.mark.parametrize(
    ("typed", "proposed"),
    [
        ("isocharge s", {"simulate", "serve"}),
        ("isocharge serve pr", {"predict"}),
        ("isocharge serve stream --po", {"--port", "--policy"}),
        ("isocharge serve stream --policy l", {"latest"}),
    ],
)
def test_the_shell_completes_what_is_typed(typed, proposed):
    words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1), "_ISOCHARGE_COMPLETE": "complete_bash"}
    assert set(run(ISOCHARGE, **words).split()) == proposed
