"""The command `isocharge`: the composition root, the only part that sees all stages.

Each stage has its commands in a package here, one file a command; a command imports its stage when it runs, so that
help is instant. Data go to stdout, messages for people to stderr. Exit codes: 0 done, 1 failed, 2 wrong usage or input.
"""

import signal
import sys
from typing import Annotated

import typer

from isocharge.cli.demo.command import demo_command
from isocharge.cli.serve.app import serve_app
from isocharge.cli.shared.plain_numbers import plain_numbers
from isocharge.cli.shared.standard_streams import open_closed_streams
from isocharge.cli.shared.terminal import cautions_to_stderr, say
from isocharge.cli.simulate.app import simulate_app
from isocharge.cli.train.app import train_app
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.versions import package_version

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Find where a piezoelectric tactile film is touched, and how hard, from the charges of three to eight "
    "electrodes.",
)
app.command("demo")(demo_command)
app.add_typer(simulate_app, name="simulate")
app.add_typer(train_app, name="train")
app.add_typer(serve_app, name="serve")


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"isocharge {package_version()}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version, and exit.")
    ] = False,
) -> None:
    """What stands before a command."""


def main() -> None:
    """Run the command line; the one place that maps errors to exit codes. SIGTERM ends a command as Ctrl-C does."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    open_closed_streams()
    try:
        with cautions_to_stderr():
            plain_numbers(typer.main.get_command(app))()
    except (IsochargeError, OSError, MemoryError) as error:
        say(f"{type(error).__name__}: {error}")
        sys.exit(2 if isinstance(error, InputError) else 1)
