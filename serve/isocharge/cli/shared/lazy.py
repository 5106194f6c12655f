"""Groups of commands that import the module of a command only when the command is called.

The help of a group is therefore printed without importing the commands of the group.
"""

from collections.abc import Mapping
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from isocharge.common.errors import require


def lazy_group(summary: str, summaries: Mapping[str, str]) -> typer.Typer:
    """Return a group of commands that are imported only when they are needed.

    A command is imported when the user calls it, completes its options, or requests its help. The help of the group
    needs only the summaries of the commands.

    Args:
        summary: Summary of the group.
        summaries: One sentence for each command. Each key names the function of a command in the notation of entry
            points, such as "train.export_c:export_c_command [train]" for a module in the folder `cli`. The name of the
            function determines the name of the command, here `export-c`. The command always needs the extra of
            pyproject.toml in square brackets, here `train`.
    """
    # Entry points by the names of the commands. For example, the command `export-c` has the entry point
    # "train.export_c:export_c_command [train]": the text between ":" and "_command" becomes the name.
    entry_points = {
        entry_point.partition(":")[2].partition("_command")[0].replace("_", "-"): entry_point
        for entry_point in summaries
    }

    # Typer creates the object of the group itself and accepts only a class. The class is therefore defined here, where
    # its methods can use `entry_points`.
    class LazyGroup(TyperGroup):
        """A group that stores only the names and the summaries of its commands."""

        def __init__(self, **settings: Any) -> None:
            """Add a placeholder for each command. The help of the placeholder is the summary of the command."""
            super().__init__(**settings)
            for name, entry_point in entry_points.items():
                self.add_command(TyperCommand(name, help=summaries[entry_point], short_help=summaries[entry_point]))

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            """Import the command that the arguments name. Return this command instead of its placeholder."""
            name, command, remaining_args = super().resolve_command(ctx, args)
            if name in entry_points:
                command = load_command(entry_points[name])
            return name, command, remaining_args

    return typer.Typer(
        cls=LazyGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help=summary,
        short_help=summary,
    )


def load_command(path: str) -> TyperCommand:
    """Import the function of a command, and return the Typer command for this function.

    Args:
        path: Module in the folder `cli`, function and extra of the command, in the notation of entry points. An example
            is "train.export_c:export_c_command [train]".

    Raises:
        MissingExtra: If the extra of the command is not installed.
    """
    from importlib.metadata import EntryPoint  # imported late, because the import is slow

    entry_point = EntryPoint(name="", value=f"isocharge.cli.{path}", group="")
    # A missing package of the extra raises MissingExtra, whose message names the install command.
    with require(*entry_point.extras):
        command_function = entry_point.load()

    # Typer makes a command only from an app. An app with a single function becomes one command without subcommands.
    single_command_app = typer.Typer(add_completion=False, rich_markup_mode=None)
    single_command_app.command()(command_function)
    typer_command = typer.main.get_command(single_command_app)
    typer_command.name = None  # the group that contains the command names it
    return typer_command  # type: ignore[return-value]
