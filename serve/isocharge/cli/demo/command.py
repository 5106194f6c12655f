"""`isocharge demo`: simulate, train, serve and draw the results once; or show a virtual sensor on the live page."""

from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.live_page import LiveOption, page_address
from isocharge.cli.shared.options import ConfigOption
from isocharge.common.extras import require
from isocharge.serve.virtual_sensor.sensor import posix_modules


def demo_command(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder to make for the results. (default: demo-output; demo-output-2, ... if it exists)",
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds",
            min=3.0,
            max=1e6,
            help="Duration of the live part, s. (default: 20; with --live until Ctrl-C)",
        ),
    ] = None,
    config: ConfigOption = None,
    live: LiveOption = None,
) -> None:
    """Show what isocharge does: simulate a film, train a model, follow a virtual sensor live, and draw the results.

    Takes about two minutes. Writes dataset, model and one page of pictures (mm, N, pC) into a new folder. --live only
    follows a virtual sensor on a page for browsers, with the released model; it trains and writes nothing.

    Example: isocharge demo -o first-light
    """
    posix_modules()  # raises an error before anything is computed if there are no pseudo-terminals
    if live is None:
        with require("train"):
            from isocharge.cli.demo.full_demo import run_demo
        run_demo(output, seconds, config)
        return
    address = page_address(live, None)
    with require("simulate", "http"):
        from isocharge.cli.demo.live_film import show_live_film

        show_live_film(address, seconds)
