"""Groups of commands that are imported when they are called, so that help above them costs nothing."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

Commands = Mapping[str, tuple[str, str]]
"""Name of a command to the place of its function, "package.module:function", and one sentence for the help above it."""


def lazy_group(summary: str, commands: Commands) -> typer.Typer:
    """A group whose commands are imported one by one, each when it is called, completed or asked for its help."""

    class LazyGroup(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            for name, (_, sentence) in commands.items():
                self.add_command(TyperCommand(name, help=sentence, short_help=sentence))

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            name, command, rest = super().resolve_command(ctx, args)
            return name, load_command(commands[str(name)][0]) if name in commands else command, rest

    return typer.Typer(
        cls=LazyGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help=summary,
        short_help=summary,
    )


def load_command(place: str) -> TyperCommand:
    """The command of a function, "package.module:function"."""
    module, _, function = place.partition(":")
    one = typer.Typer(add_completion=False, rich_markup_mode=None)
    one.command()(getattr(import_module(module), function))
    command = typer.main.get_command(one)
    command.name = None
    return command  # type: ignore[return-value]
