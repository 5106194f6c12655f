"""The command `isocharge`, which contains the commands of all stages.

Only this module imports the commands of all stages: simulate, train and serve. Each command has its own module, such as
`isocharge.cli.simulate.sweep`. Commands write data to standard output and messages to standard error. The exit code is
0 for success, 1 for a failure, and 2 for wrong usage or input.
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
from isocharge.common.extras import package_version

app = lazy_group(
    "Compute the position and the force of a contact on a piezoelectric tactile film from the charges of three to "
    "eight electrodes.",
    {
        "demo": LazyCommand(
            "isocharge.cli.demo.command:demo_command",
            "Run all stages once: simulate a film, train a network, track a virtual sensor, draw a picture.",
        ),
        "verify": LazyCommand(
            "isocharge.cli.serve.verify:verify_command", "Check that a model folder is complete and unchanged."
        ),
    },
)
app.add_typer(simulate_app, name="simulate")
app.add_typer(train_app, name="train")
app.add_typer(serve_app, name="serve")


def _print_version(is_requested: bool) -> None:
    """If the option `--version` was given, print the version and end the command."""
    if is_requested:
        show(f"isocharge {package_version()}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Accept the options that are given before the name of a command."""


def main() -> None:
    """Run the command that the command line names, and end the process with the exit code of the command.

    Each error is printed on stderr and converted to an exit code. SIGTERM ends a command in the same way as Ctrl-C.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # this handler raises KeyboardInterrupt
    open_closed_streams()
    try:
        with warnings_to_stderr():
            app()
    except (IsochargeError, OSError, MemoryError) as error:
        say(f"{type(error).__name__}: {error}")
        sys.exit(2 if isinstance(error, InputError) else 1)
