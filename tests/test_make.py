"""The Makefile: all tests run once, and what runs before a commit is what `make test` runs."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def commands():
    """What `make test` would run."""
    if shutil.which("make") is None:
        pytest.skip("there is no make")
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    done = subprocess.run(
        ["make", "--dry-run", "test"], cwd=ROOT, env=alone, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def test_hooks_before_a_commit_are_commands_of_make_test(commands):
    text = (ROOT / ".pre-commit-config.yaml").read_text("utf-8")
    entries = re.findall(r"entry: (.+)", text)
    assert len(entries) == 3
    assert set(entries) <= set(commands)


def test_both_parts_of_make_test_are_all_tests(commands):
    """What the first part leaves out is what the second runs, and every part of it exists."""
    first, second = (line for line in commands if " -m pytest " in line)
    left_out = set(re.findall(r"--ignore=(\S+)", first))
    assert left_out == set(re.findall(r"tests/\S+", second))
    assert all((ROOT / name).exists() for name in left_out)


def test_tests_with_ports_and_clocks_run_one_at_a_time(commands):
    (second,) = (line for line in commands if " -m pytest tests/" in line and " -n " not in line)
    for name in ("serve/live", "serve/port", "serve/virtual_sensor", "serve/test_end_to_end.py", "test_live.py"):
        assert f" tests/{name} " in f"{second} "
