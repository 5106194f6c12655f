"""Groups of commands that import the module of a command only when the command is called.

The help of a group is therefore printed without importing the commands of the group.

The value of the option `--live` may be omitted, as in `--live` or `--live 8080`. Typer requires a value for every
option that is not a flag. A group therefore inserts the default value into the command line before Typer parses the
command line.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from isocharge.common.errors import require

DEFAULT_LIVE_ADDRESS = "127.0.0.1:8001"
"""Address of the live page if `--live` has no value."""


def insert_live_address(words: Sequence[str]) -> list[str]:
    """Insert the default address after each option `--live` whose value is omitted.

    The next word of the command line is the value if it looks like PORT or HOST:PORT.

    Args:
        words: The command line. Words after `--` are arguments and remain as they are.

    Example:
        >>> insert_live_address(["--live", "--seconds", "5"])
        ['--live', '127.0.0.1:8001', '--seconds', '5']
    """
    completed_words: list[str] = []
    for word, next_word in pairwise([*words, ""]):
        completed_words.append(word)
        is_option = word == "--live" and "--" not in completed_words
        is_address = next_word.isdecimal() or (":" in next_word and not next_word.startswith("-"))
        if is_option and not is_address:
            completed_words.append(DEFAULT_LIVE_ADDRESS)
    return completed_words


class LazyCommand(NamedTuple):
    """Description of a command whose function is imported when the command is called.

    Attributes:
        function_path: Module and name of the function, "package.module:function".
        summary: One sentence for the help of the group.
        extra: Extra of pyproject.toml that the command always needs; None if the base install is enough.
    """

    function_path: str
    summary: str
    extra: str | None = None


def lazy_group(summary: str, commands: Mapping[str, LazyCommand]) -> typer.Typer:
    """Return a group of commands that are imported only when they are needed.

    A command is imported when the user calls it, completes its options, or requests its help. The help of the group
    needs only the summaries of the commands.

    Args:
        summary: Summary of the group.
        commands: The commands by name.
    """

    # Typer creates the object of the group itself and accepts only a class. The class is therefore defined here, where
    # its methods can use `commands`.
    class LazyGroup(TyperGroup):
        """A group that stores only the names and the summaries of its commands."""

        def __init__(self, **settings: Any) -> None:
            """Add a placeholder for each command, which has the summary of the command as its help."""
            super().__init__(**settings)
            for name, command in commands.items():
                placeholder = TyperCommand(name, help=command.summary, short_help=command.summary)
                self.add_command(placeholder)

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Import the command that the arguments name. Return this command instead of its placeholder."""
            name, command, remaining_args = super().resolve_command(ctx, args)
            if name is not None and name in commands:
                command = load_command(commands[name])
                remaining_args = insert_live_address(remaining_args)
            return name, command, remaining_args

    return typer.Typer(
        cls=LazyGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help=summary,
        short_help=summary,
    )


def load_command(command: LazyCommand) -> TyperCommand:
    """Import the function of a command, and return the Typer command for this function.

    Raises:
        MissingExtra: If the extra of the command is not installed.
    """
    module_name, _colon, function_name = command.function_path.partition(":")
    # A missing package of the extra raises MissingExtra, whose message names the install command.
    extras = [command.extra] if command.extra else []
    with require(*extras):
        command_function = getattr(import_module(module_name), function_name)

    # Typer makes a command only from an app. An app with a single function becomes one command without subcommands.
    single_command_app = typer.Typer(add_completion=False, rich_markup_mode=None)
    single_command_app.command()(command_function)
    typer_command = typer.main.get_command(single_command_app)
    typer_command.name = None  # the group that contains the command names it
    return typer_command  # type: ignore[return-value]
