"""Options of `isocharge` itself: its version, and completion by the shell."""

import os
import sys
import tomllib
from pathlib import Path

import pytest

from isocharge import serve, simulate, train
from processes import finished

ROOT = Path(__file__).parents[2]
ISOCHARGE = Path(sys.executable).parent / "isocharge"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]


def test_version(command):
    assert command("--version") == (0, f"isocharge {VERSION}\n", "")
    assert serve.__version__ == simulate.__version__ == train.__version__ == VERSION


@pytest.mark.parametrize(
    ("typed", "proposed"),
    [
        ("isocharge s", {"simulate", "serve"}),
        ("isocharge serve pr", {"predict"}),
        ("isocharge serve stream --po", {"--port"}),
    ],
)
def test_the_shell_completes_what_is_typed(typed, proposed):
    words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1), "_ISOCHARGE_COMPLETE": "complete_bash"}
    done = finished([ISOCHARGE], env=os.environ | words, timeout=60)
    assert set(done.stdout.split()) == proposed
