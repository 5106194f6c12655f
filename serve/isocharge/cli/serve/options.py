"""Options of several serving commands."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

ModelsOption = Annotated[
    Path | None,
    typer.Option(
        "--models",
        metavar="DIR",
        help="Folder in which a model's name is looked up before the usual places. (default: none)",
    ),
]

WaitOption = Annotated[
    float, typer.Option("--wait", min=0.0, max=3600.0, help="Time to wait until the port exists, s.")
]


class Output(StrEnum):
    """Format of the records on stdout."""

    json = "json"
    csv = "csv"
    none = "none"


class PolicyName(StrEnum):
    """Frames that get a record."""

    every = "every"
    latest = "latest"


OutputOption = Annotated[
    Output, typer.Option("--output", help="Records on stdout: a line of JSON each, CSV with a header, or none.")
]

UdpOption = Annotated[
    str | None,
    typer.Option(
        "--udp",
        metavar="HOST:PORT",
        help="Also send each record as JSON in a UDP packet, as to PlotJuggler. (default: no)",
    ),
]

McapOption = Annotated[
    Path | None,
    typer.Option(
        "--mcap",
        metavar="FILE",
        help="Also write the records into a new MCAP file, with wrench and pose as ROS 2 messages. (default: no)",
    ),
]


class McapRecords(StrEnum):
    """How an MCAP file holds the records themselves."""

    json = "json"
    ros2 = "ros2"


McapRecordsOption = Annotated[
    McapRecords,
    typer.Option(
        "--mcap-records",
        help="Records in the MCAP file: JSON with its schema, as Foxglove, Lichtblick and PlotJuggler read it; or the "
        "same text in ROS 2 messages, for `ros2 bag` and rosbags, which refuse a file with anything else.",
    ),
]


def awaited(port: str, wait: float) -> str:
    """The port, as soon as there is something under its path, or when the time, s, is over."""
    end = time.monotonic() + wait
    while "://" not in port and port != "-" and not Path(port).exists() and time.monotonic() < end:
        time.sleep(0.05)
    return port
