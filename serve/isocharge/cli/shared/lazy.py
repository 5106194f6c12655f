"""Groups of commands that import the module of a command only when the command is called.

The help of a group is therefore printed without importing the commands of the group.

The value of some options may be omitted, as in `--live` or `--live 8080`. Typer requires a value for every option that
is not a flag. Commands of the class `OptionalValueCommand` therefore insert the default value into the command line
before Typer parses the command line.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from isocharge.common.extras import require


class OptionalValue(NamedTuple):
    """Description of an option whose value may be omitted.

    Attributes:
        default: Value of the option if the command line contains the option without a value.
        is_value: Function that returns whether the next word of the command line is the value of the option. Other
            words are arguments of the command or other options.
    """

    default: str
    is_value: Callable[[str], bool]


def is_address(word: str) -> bool:
    """Return whether a word of the command line looks like PORT or HOST:PORT."""
    return word.isdecimal() or (":" in word and not word.startswith("-"))


DEFAULT_LIVE_ADDRESS = "127.0.0.1:8001"
"""Address of the live page if `--live` has no value."""

OPTIONAL_VALUES = {"--live": OptionalValue(DEFAULT_LIVE_ADDRESS, is_address)}
"""All options whose value may be omitted, by their names."""


def insert_omitted_values(words: Sequence[str]) -> list[str]:
    """Insert the default value after each option whose value is omitted.

    The value of an option is omitted if the next word of the command line is not suitable as its value. The function
    `is_value` of the option decides whether a word is suitable.

    Args:
        words: The command line. Words after `--` are arguments and remain as they are.

    Example:
        >>> insert_omitted_values(["--live", "--seconds", "5"])
        ['--live', '127.0.0.1:8001', '--seconds', '5']
    """
    completed_words: list[str] = []
    for index, word in enumerate(words):
        if word == "--":
            return [*completed_words, *words[index:]]
        completed_words.append(word)
        option = OPTIONAL_VALUES.get(word)
        if option is None:
            continue
        is_last = index + 1 == len(words)
        if is_last or not option.is_value(words[index + 1]):
            completed_words.append(option.default)
    return completed_words


class OptionalValueCommand(TyperCommand):
    """A command that accepts the options in `OPTIONAL_VALUES` without a value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert omitted values into the command line, and parse the completed command line."""
        return super().parse_args(ctx, insert_omitted_values(args))


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
    import_context = require(command.extra) if command.extra else nullcontext()
    with import_context:
        command_function = getattr(import_module(module_name), function_name)

    # Typer makes a command only from an app. An app with a single function becomes one command without subcommands.
    single_command_app = typer.Typer(add_completion=False, rich_markup_mode=None)
    single_command_app.command(cls=OptionalValueCommand)(command_function)
    typer_command = typer.main.get_command(single_command_app)
    typer_command.name = None  # the group that contains the command names it
    return typer_command  # type: ignore[return-value]
