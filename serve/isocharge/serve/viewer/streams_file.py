"""The file that names several streams for one page, TOML.

    [[stream]]
    name = "left finger"          # optional; else the model's
    model = "three-25um-biaxial"
    port = "/dev/ttyACM0"
    device = "left.toml"          # optional; description of the board
    baud = 115200                 # optional
    record = "left.rec"           # optional; a recording of everything

Paths are relative to the folder of the file.
"""

from dataclasses import dataclass
from pathlib import Path

from isocharge.common.errors import ConfigError
from isocharge.common.tables import Table, read_toml
from isocharge.serve.prediction.record import NAME, is_name

MOST_STREAMS = 8
"""Streams on one page: each has a process of its own."""

KEYS = ("name", "model", "port", "device", "baud", "record")


@dataclass(frozen=True)
class StreamSettings:
    """One stream of the page.

    Attributes:
        name: For people.
        model: Name or path.
        port: As `serve stream` takes it.
        device: Device file; None for any board.
        baud: Bits per second.
        record: Recording to write; None for none.
    """

    name: str
    model: str
    port: str
    device: Path | None = None
    baud: int = 115200
    record: Path | None = None


def read_streams(path: Path) -> tuple[StreamSettings, ...]:
    """Read the file.

    Raises:
        ConfigError: If it cannot be read, or says something else.
    """
    table = Table(read_toml(path, "streams", ConfigError), str(path), ConfigError).only("stream")
    streams = tuple(_stream(stream.only(*KEYS), path.parent) for stream in table.tables("stream"))
    if not 1 <= len(streams) <= MOST_STREAMS:
        raise ConfigError(f"{path}: expected 1 to {MOST_STREAMS} tables [[stream]], got {len(streams)}")
    for key in ("name", "port", "record"):
        values = [getattr(stream, key) for stream in streams if getattr(stream, key) is not None]
        if len(set(values)) < len(values):
            raise ConfigError(f"{path}: {key}: expected another one for each stream, got {values}")
    return streams


def _stream(table: Table, folder: Path) -> StreamSettings:
    model = table.text("model")
    name = table.text("name", default=Path(model).name)
    if not is_name(name):
        table.refuse("name", NAME)
    device, record = table.text("device", default="", or_empty=True), table.text("record", default="", or_empty=True)
    return StreamSettings(
        name,
        str(folder / model) if "/" in model else model,
        _port(table.text("port"), folder),
        folder / device if device else None,
        table.whole("baud", default=115200, least=1),
        folder / record if record else None,
    )


def _port(port: str, folder: Path) -> str:
    """A port, a path from the folder of the file."""
    return port if "://" in port else str(folder / port)
