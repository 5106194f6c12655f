"""Every command line that a page shows is one that the option parser accepts."""

import re
import shlex

import pytest
import typer

from cli.test_help import COMMANDS
from isocharge.cli.main import app
from test_pages import PAGES

GROUPS = ("simulate", "train", "serve")
SHELL_BLOCK = re.compile(r"^```(?:sh|text|console)\n(.*?)^```", re.DOTALL | re.MULTILINE)
INLINE_CODE = re.compile(r"`(isocharge (?!COMMAND )[^`]+)`")
END_OF_COMMAND = {"|", "&", "&&", ";", ">", "2>", "||", "#"}


def shell_commands(text):
    """The `isocharge` commands of a shell text, as lists of words without `isocharge`."""
    for line in text.replace("\\\n", " ").splitlines():
        if not re.search(r"(?:^|[|&;] *)isocharge ", line):
            continue
        lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;<>()")
        lexer.whitespace_split = True
        words = []
        for word in [*lexer, ";"]:
            if word in END_OF_COMMAND:
                if words[:1] == ["isocharge"]:
                    yield words[1:]
                words = []
            else:
                words.append(word)


def documented_commands():
    for name, text in PAGES.items():
        for block in SHELL_BLOCK.finditer(text):
            for words in shell_commands(block[1]):
                yield pytest.param(words, True, id=f"{name}: {' '.join(words)}")
        for code in INLINE_CODE.finditer(text):
            for words in shell_commands(code[1].replace("\n", " ")):
                yield pytest.param(words, False, id=f"{name}: {' '.join(words)} (in a sentence)")


def parse(words):
    """Parse a command line without running the command.

    Returns:
        The values of the parameters by name; empty for a group or a program-wide option.
    """
    group = typer.main.get_command(app)
    context = typer.Context(group)
    if words[0].startswith("-"):
        assert any(words[0] in parameter.opts for parameter in group.get_params(context)), words[0]
        return {}
    _, command, rest = group.resolve_command(context, list(words))
    if words[0] in GROUPS:
        if not rest or rest == ["..."]:
            return {}
        _, command, rest = command.resolve_command(typer.Context(command), rest)
    return command.make_context(" ".join(words), rest).params


@pytest.mark.parametrize(("words", "is_complete"), [*documented_commands()])
def test_a_documented_command_line_parses(words, is_complete):
    try:
        parse(words)
    except Exception as error:
        is_fragment = type(error).__name__ == "MissingParameter" and not is_complete  # a sentence names a command alone
        if not is_fragment:
            raise


def test_the_reference_lists_every_command():
    reference = PAGES["REFERENCE.md"].partition("## Commands")[2]
    assert sorted(re.findall(r"^\| `isocharge (.+?)` \|", reference, re.MULTILINE)) == sorted(COMMANDS)
