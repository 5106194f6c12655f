"""What tests of several stages share."""

import sys

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
