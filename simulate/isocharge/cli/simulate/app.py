"""`isocharge simulate ...`: its commands, one file each."""

import typer

from isocharge.cli.simulate.contours import contours_command
from isocharge.cli.simulate.curves import curves_command
from isocharge.cli.simulate.deflection import deflection_command
from isocharge.cli.simulate.design import design_command
from isocharge.cli.simulate.identify import identify_command
from isocharge.cli.simulate.paper import paper_command
from isocharge.cli.simulate.point import point_command
from isocharge.cli.simulate.sweep import sweep_command

simulate_app = typer.Typer(
    no_args_is_help=True, help="Compute the charges of presses, and what charges determine about a press."
)
simulate_app.command("point")(point_command)
simulate_app.command("sweep")(sweep_command)
simulate_app.command("curves")(curves_command)
simulate_app.command("contours")(contours_command)
simulate_app.command("deflection")(deflection_command)
simulate_app.command("identify")(identify_command)
simulate_app.command("design")(design_command)
simulate_app.command("paper")(paper_command)
