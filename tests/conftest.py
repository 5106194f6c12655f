"""What tests of several stages share."""

import io
import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from isocharge.cli import main


@pytest.fixture
def command(monkeypatch, capsys):
    """Run `isocharge ...` in this process: (exit code, stdout, stderr)."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["isocharge", *map(str, words)])
        with pytest.raises(SystemExit) as done:
            main()
        out, err = capsys.readouterr()
        return int(done.value.code or 0), out, err

    return run


@pytest.fixture
def start_command():
    """Start `isocharge ...` in a process of its own, which ends with the test."""
    started = []

    def start(*words):
        process = subprocess.Popen(
            [sys.executable, "-m", "isocharge.cli", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def shell():
    """Run lines of a README in bash, this environment's `isocharge` first on the path: what they print."""

    def run(script, cwd=None, timeout=280):
        environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        words = ["bash", "-ec", script]
        done = subprocess.run(
            words, cwd=cwd, env=environment, capture_output=True, text=True, timeout=timeout, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture
def run_example():
    """Run a Python example of a page: each print prints what the comment on its line says, to the letter."""

    def run(example, page):
        with redirect_stdout(io.StringIO()) as printed:
            exec(compile(example, page, "exec"), {"__name__": "example"})
        prints = [line for line in example.splitlines() if line.lstrip().startswith("print(")]
        expected = [line.rpartition(")  # ")[2] for line in prints]
        assert expected
        assert printed.getvalue().splitlines() == expected

    return run


@pytest.fixture
def run_commands(shell):
    """Run a shell example of a page in a folder; what it starts in the background ends with it, outputs are there."""

    def run(example, folder, timeout=280):
        printed = shell(f"trap 'kill $(jobs -p) || true; wait' EXIT\n{example}", cwd=folder, timeout=timeout)
        for output in re.findall(r" (?:-o|--record|>) ([\w./-]+)", example):
            assert (folder / output).exists(), output
        return printed

    return run
