"""Generate the page that lists all commands from the same declarations as the output of `--help`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from isocharge.cli.main import app

WIDTH = 88
"""Width of the help texts, characters."""

INTRODUCTION = """# Commands and options

This page contains the help of every command. It is generated from the declarations of the commands, so it agrees with
`isocharge COMMAND --help`. [REFERENCE.md](../REFERENCE.md#commands) names the page that explains each command.
"""


def write_page(path: Path) -> None:
    """Write the page with the help of all commands, unless the page already has this content.

    Args:
        path: Path of the page.
    """
    root = typer.main.get_command(app)
    sections = [INTRODUCTION]
    for words, command in _commands(root, ("isocharge",)):
        name = " ".join(words)
        context = typer.Context(command, info_name=name, terminal_width=WIDTH, max_content_width=WIDTH)
        sections.append(f"## {name}\n\n```text\n{command.get_help(context)}\n```\n")
    text = "\n".join(sections)
    # Sphinx does not read the page again if its file is not changed.
    if not path.exists() or path.read_text("utf-8") != text:
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, "utf-8")


def _commands(group: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield each command of a group and of its subgroups, together with the words that call this command.

    Args:
        group: A group of Typer commands, which has the methods of a click group.
        words: Words that call the group, such as ("isocharge", "serve").

    Yields:
        Words of a command, and the command.
    """
    for name in group.list_commands(None):  # the argument is a context, which these groups do not use
        # Commands are imported only when they are needed. `resolve_command` imports the command that the first argument
        # names, and also returns the arguments after this name.
        _name, command, _remaining_args = group.resolve_command(None, [name])
        is_group = hasattr(command, "list_commands")
        if is_group:
            yield from _commands(command, (*words, name))
        else:
            yield (*words, name), command
