"""The command `isocharge`: the composition root, the only part that sees all stages.

Each stage brings its commands, one module each, as `isocharge.cli.simulate.sweep`. Data go to stdout, messages for
people to stderr. Exit codes: 0 done, 1 failed, 2 wrong usage or input.
"""

import signal
import sys
from typing import Annotated

import typer

from isocharge.cli.serve.app import serve_app
from isocharge.cli.shared.lazy import LazyCommand, lazy_group
from isocharge.cli.shared.terminal import open_closed_streams, say, show, warnings_to_stderr
from isocharge.cli.simulate.app import simulate_app
from isocharge.cli.train.app import train_app
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.versions import package_version

app = lazy_group(
    "Find where a piezoelectric tactile film is touched, and how hard, from the charges of three to eight electrodes.",
    {
        "demo": LazyCommand(
            "isocharge.cli.demo.command:demo_command", "Simulate, train, follow a virtual sensor, draw: all once."
        )
    },
)
app.add_typer(simulate_app, name="simulate")
app.add_typer(train_app, name="train")
app.add_typer(serve_app, name="serve")


def _print_version(asked: bool) -> None:
    if asked:
        show(f"isocharge {package_version()}")
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
        with warnings_to_stderr():
            app()
    except (IsochargeError, OSError, MemoryError) as error:
        say(f"{type(error).__name__}: {error}")
        sys.exit(2 if isinstance(error, InputError) else 1)
