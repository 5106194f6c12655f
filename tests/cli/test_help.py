"""Help: each option says what it is and its default; each example is one that the command accepts."""

import re
import shlex

import pytest
import typer

from isocharge.cli import app

ROOT = typer.main.get_command(app)


def commands(group=ROOT, path=()):
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


COMMANDS = dict(commands())

PARAMETERS = [(path, parameter) for path, command in COMMANDS.items() for parameter in command.params]


@pytest.mark.parametrize(("path", "parameter"), PARAMETERS, ids=lambda value: getattr(value, "name", value))
def test_a_parameter_says_what_it_is_and_its_default(path, parameter):  # noqa: ARG001
    text = parameter.help
    assert re.match(r"[A-Z'].*(\.|\))$", text, re.DOTALL), text
    hidden = parameter.default is None or parameter.default is False
    if hidden and not parameter.required and not parameter.secondary_opts:
        assert "(default: " in text
    elif not parameter.required:
        assert "(default: " not in text  # typer shows it


UNITS = {"mm": "mm", "X,Y": "mm", "_Hz": "Hz", "_pC": "pC", "_s": "s", "_K": "K", "force": "N", "seconds": "s"}
"""End of a parameter's name or metavar to the unit that its help must give."""


@pytest.mark.parametrize(("path", "parameter"), PARAMETERS, ids=lambda value: getattr(value, "name", value))
def test_a_quantity_has_its_unit(path, parameter):  # noqa: ARG001
    for end, unit in UNITS.items():
        if str(parameter.name).endswith(end) or str(parameter.metavar or "").lower().endswith(end.lower()):
            assert re.search(rf"\b{unit}\b", parameter.help), parameter.help


@pytest.mark.parametrize("path", COMMANDS)
def test_the_example_is_accepted(path):
    """Its options parse; what it names need not exist."""
    command, example = COMMANDS[path], re.search(r"Example: isocharge (.*)", COMMANDS[path].help)[1]
    words = shlex.split(example.partition(" > ")[0])
    assert " ".join(words[: len(path.split())]) == path
    context = command.make_context(path, words[len(path.split()) :])
    assert all(context.params[parameter.name] for parameter in command.params if parameter.required)


@pytest.mark.parametrize("path", COMMANDS)
def test_a_command_s_purpose_is_one_sentence(path):
    purpose = COMMANDS[path].help.split("\n\n")[0]
    assert purpose.endswith(".")
    assert len(purpose) < 200
