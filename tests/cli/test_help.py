"""Help: each option has a description with its unit and its default, and each command accepts its example."""

import os
import re
import shlex
import subprocess
import sys

import pytest
import typer

from isocharge.cli.main import app
from processes import finished

ROOT = typer.main.get_command(app)


def commands(group=ROOT, path=()):
    """Return all commands by their words. They are imported in the same way as when they are called."""
    for name in group.list_commands(None):
        _, command, _ = group.resolve_command(None, [name])
        if hasattr(command, "list_commands"):
            yield from commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


COMMANDS = dict(commands())


@pytest.mark.parametrize("path", COMMANDS)
def test_the_help_begins_with_one_sentence_and_has_an_example_that_parses(path):
    """The files that the example names need not exist."""
    command, text = COMMANDS[path], COMMANDS[path].help
    purpose = text.split("\n\n")[0]
    assert purpose.endswith(".")
    assert len(purpose) < 200
    words = shlex.split(re.search(r"Example: isocharge (.*)", text)[1].partition(" > ")[0])
    assert " ".join(words[: len(path.split())]) == path
    context = command.make_context(path, words[len(path.split()) :])
    assert all(context.params[parameter.name] for parameter in command.params if parameter.required)


@pytest.mark.parametrize("path", COMMANDS)
def test_a_command_with_a_model_has_the_option_that_the_error_of_a_missing_model_advises(path):
    names = {name for parameter in COMMANDS[path].params for name in (parameter.name, *parameter.opts)}
    assert "model" not in names or "--models" in names


@pytest.mark.parametrize("words", [["--help"], ["serve", "--help"], ["train", "--help"], ["simulate", "--help"]])
def test_help_above_the_commands_imports_none(words):
    code = (
        "import sys; from isocharge.cli.main import main; sys.argv[1:] = sys.argv[1].split()\n"
        "try: main()\n"
        "finally: print(*[n for n in ('numpy', 'onnxruntime', 'torch', 'scipy', 'serial') if n in sys.modules])"
    )
    done = finished([sys.executable, "-c", code, " ".join(words)])
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "")


def test_the_help_takes_at_most_a_quarter_of_a_second():
    """Processor time of the fastest of three runs, because the machine may be busy."""
    times_s = []
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-m", "isocharge.cli", "--help"], stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        times_s.append(usage.ru_utime + usage.ru_stime)
    assert min(times_s) <= 0.25
