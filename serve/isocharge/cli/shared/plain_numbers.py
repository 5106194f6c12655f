"""Numbers of options, written as in other programs and in the cells of a table: `1_0` is none."""

from collections.abc import Callable
from typing import Any

import typer


def plain_numbers(command: Any) -> Any:
    """A command of Typer, with its subcommands, that refuses numbers which only Python reads."""
    for parameter in command.params:
        parameter.process_value = _checked(parameter, parameter.process_value)
    for inner in getattr(command, "commands", {}).values():
        plain_numbers(inner)
    return command


def _checked(parameter: Any, process: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The function that turns an option's text into its value, with a look at the text where the value is a number."""

    def process_plain(context: Any, given: Any) -> Any:
        value = process(context, given)
        texts, values = (item if isinstance(item, list | tuple) else [item] for item in (given, value))
        for text, number in zip(texts, values, strict=False):  # a list that is refused elsewhere may be shorter
            if isinstance(number, int | float) and isinstance(text, str) and ("_" in text or not text.isascii()):
                raise typer.BadParameter(f"{text!r} is not a plain number.", ctx=context, param=parameter)
        return value

    return process_plain
