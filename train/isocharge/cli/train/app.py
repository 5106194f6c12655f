"""`isocharge train ...`: its commands, one file each."""

import typer

from isocharge.cli.train.calibrate import calibrate_command
from isocharge.cli.train.distil import distil_command
from isocharge.cli.train.export_c import export_c_command
from isocharge.cli.train.fit import fit_command
from isocharge.cli.train.report import report_command

train_app = typer.Typer(no_args_is_help=True, help="Train models on simulated charges; compare methods.")
train_app.command("fit")(fit_command)
train_app.command("report")(report_command)
train_app.command("distil")(distil_command)
train_app.command("calibrate")(calibrate_command)
train_app.command("export-c")(export_c_command)
