"""Command `isocharge demo`: run the complete demo, show a virtual sensor on the live page, or write the playground."""

from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.live_page import LiveOption, TokenOption
from isocharge.cli.shared.terminal import say
from isocharge.common.errors import InputError, require
from isocharge.common.files import new_file


def demo_command(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder to make for the results. (default: demo-output)",
        ),
    ] = None,
    live: LiveOption = None,
    token: TokenOption = None,
    playground: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.html",
            help="Only write the playground: a page on which a simulated film is pressed with the mouse. The file must "
            "not exist yet. (default: no file)",
        ),
    ] = None,
) -> None:
    """Show what isocharge does: simulate a film, train a model, follow a virtual sensor live, and draw the results.

    Takes less than a minute. Writes the dataset, the model and one page of pictures (mm, N, pC) into a new folder. With
    --live, the command only follows a virtual sensor with the released model, on a page for browsers. No model is then
    trained, and no file is written. With --playground, the command only writes one HTML file, which needs no server and
    no other file.

    Example: isocharge demo -o first-light
    """
    # At most one of the three options may be given, so at least two are None.
    if [output, live, playground].count(None) < 2:
        raise InputError("expected only one of --output, --live and --playground, got several")
    if playground is not None:
        from isocharge.serve.viewer.playground_page import playground_html  # imported late, because the import is slow

        with new_file(playground) as draft:
            draft.parent.mkdir(parents=True, exist_ok=True)
            draft.write_bytes(playground_html().encode())
        say(f"wrote {playground}; open it in a browser")
        return

    # The modules of both demos are imported late, because they need extras that may not be installed.
    if live is None:
        with require("train"):
            from isocharge.cli.demo.full_demo import run_demo
        run_demo(output or Path("demo-output"))
        return
    with require("simulate", "http"):
        from isocharge.cli.demo.live_film import show_live_film

        show_live_film(live, token)
