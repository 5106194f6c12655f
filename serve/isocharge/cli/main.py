"""The command `isocharge`, which contains the commands of all stages.

Only this module imports the commands of all stages: simulate, train and serve. Each command has its own module, such as
`isocharge.cli.simulate.sweep`. Commands write data to standard output and messages to standard error. The exit code is
0 for success, 1 for a failure, and 2 for wrong usage or input.
"""

import signal
import sys
from typing import Annotated

import typer

from isocharge.cli.shared.lazy import lazy_group
from isocharge.cli.shared.terminal import open_closed_streams, say, show, warnings_to_stderr
from isocharge.common.errors import InputError, IsochargeError, package_version

app = lazy_group(
    "Compute the position and the force of a contact on a piezoelectric tactile film from the charges of three to "
    "eight electrodes.",
    {
        "demo.command:demo_command": (
            "Run all stages once: simulate a film, train a network, track a virtual sensor, draw a picture."
        ),
        "serve.verify:verify_command": "Check that a model folder is complete and unchanged.",
    },
)

app.add_typer(
    lazy_group(
        "Compute the charges of presses, and the accuracy with which charges determine a press.",
        {
            "simulate.point:point_command [simulate]": "Compute the charges and the deflection of one press.",
            "simulate.sweep:sweep_command [simulate]": (
                "Compute the charges of many presses and write them as a dataset for training."
            ),
            "simulate.identify:identify_command [simulate]": (
                "Compute error limits, folds and the working area of a sensor."
            ),
            "simulate.design:design_command [design]": (
                "Search for the electrode positions with the smallest position errors."
            ),
        },
    ),
    name="simulate",
)

app.add_typer(
    lazy_group(
        "Train models on simulated or measured charges; calibrate films; compare methods.",
        {
            "train.fit:fit_command [train]": "Train a network and write its model folder.",
            "train.press:press_command [train]": "Record presses at a port, and write them to a file.",
            "train.calibrate:calibrate_command [train]": "Fit a real film to some presses, and write its model folder.",
            "train.report:report_command [train]": "Compare methods: speed against error.",
            "train.export_c:export_c_command [train]": "Write a model as C source.",
        },
    ),
    name="train",
)

app.add_typer(
    lazy_group(
        "Estimate contacts from charges: from a file, from a sensor's port, over HTTP. Or play a virtual sensor.",
        {
            "serve.predict:predict_command": "Estimate the contacts of the charges in a file.",
            "serve.check:check_command": "Measure the errors of a model on measured presses.",
            "serve.stream:stream_command": "Follow a sensor live: a record for every frame of charges.",
            "serve.stream:replay_command": "Play a recording again, as it was or with other settings.",
            "serve.plot:plot_command [simulate]": "Draw a recording.",
            "serve.doctor:doctor_command": "Say what a port sends, and what is wrong with it.",
            "serve.http:http_command [http]": "Serve models over HTTP and gRPC.",
            "serve.virtual:virtual_command [simulate]": "Play a virtual sensor on a pseudo-terminal.",
            "serve.bench:bench_command": "Measure speed against error of a model on this machine.",
        },
    ),
    name="serve",
)


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
