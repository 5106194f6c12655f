"""The option `--probe` of several commands."""

from typing import Annotated

import typer

from isocharge.simulate.sensor.probe import PROBE_HELP

ProbeOption = Annotated[str, typer.Option("--probe", metavar="SHAPE", help=PROBE_HELP)]
