"""Command-line options whose value may be omitted, as in `--live` or `--live 8080`.

Typer requires a value for every option that is not a flag. Commands of the class `OptionalValueCommand` therefore
insert the default value into the command line before Typer parses the command line.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from typer.core import TyperCommand


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
