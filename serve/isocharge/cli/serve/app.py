"""`isocharge serve ...`: its commands, one file each."""

import typer

from isocharge.cli.serve.bench import bench_command
from isocharge.cli.serve.check import check_command
from isocharge.cli.serve.doctor import doctor_command
from isocharge.cli.serve.http import http_command
from isocharge.cli.serve.live import live_command
from isocharge.cli.serve.plot import plot_command
from isocharge.cli.serve.predict import predict_command
from isocharge.cli.serve.replay import replay_command
from isocharge.cli.serve.stream import stream_command
from isocharge.cli.serve.virtual import virtual_command

serve_app = typer.Typer(
    no_args_is_help=True,
    help="Estimate contacts from charges: from a file, from a sensor's port, over HTTP. Or play a virtual sensor.",
)
serve_app.command("predict")(predict_command)
serve_app.command("check")(check_command)
serve_app.command("stream")(stream_command)
serve_app.command("live")(live_command)
serve_app.command("replay")(replay_command)
serve_app.command("plot")(plot_command)
serve_app.command("doctor")(doctor_command)
serve_app.command("virtual")(virtual_command)
serve_app.command("http")(http_command)
serve_app.command("bench")(bench_command)
