"""Groups of commands whose modules are imported only when a command is called.

The help of a group therefore does not wait for the imports of its commands.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from isocharge.cli.shared.optional_values import OptionalValueCommand

Commands = Mapping[str, tuple[str, str]]
"""For each command its function, "package.module:function", and one sentence for the help of the group."""


def lazy_group(summary: str, commands: Commands) -> typer.Typer:
    """Return a group that imports a command when the command is called, completed or asked for its help."""

    class LazyGroup(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            for name, (_, sentence) in commands.items():
                self.add_command(TyperCommand(name, help=sentence, short_help=sentence))

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            name, command, remaining_args = super().resolve_command(ctx, args)
            if name is not None and name in commands:
                function_path, _ = commands[name]
                command = load_command(function_path)
            return name, command, remaining_args

    return typer.Typer(
        cls=LazyGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help=summary,
        short_help=summary,
    )


def load_command(function_path: str) -> TyperCommand:
    """Import a function, "package.module:function", and return the command that Typer makes of it."""
    module, _, function = function_path.partition(":")
    single_command_app = typer.Typer(add_completion=False, rich_markup_mode=None)
    single_command_app.command(cls=OptionalValueCommand)(getattr(import_module(module), function))
    command = typer.main.get_command(single_command_app)
    command.name = None
    return command  # type: ignore[return-value]
