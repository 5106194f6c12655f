"""Where bytes come from: a port, a file, or stdin."""

import contextlib
import os
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from isocharge.common.errors import InputError
from isocharge.serve.port.request import Request
from isocharge.serve.port.serial_port import Chunk, Port

STDIN = "-"
"""Name of the standard input."""

CHUNK_BYTES = 4096
"""Largest chunk from a file, bytes."""

Chunks = contextlib.AbstractContextManager["Port | FileSource"]


class FileSource:
    """Chunks of a file, a pipe or stdin, up to its end; they wait until somebody reads them."""

    outages = 0
    is_live = False

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def __iter__(self) -> Iterator[Chunk]:
        """Chunks until the file ends."""
        while data := os.read(self._descriptor, CHUNK_BYTES):
            yield Chunk(data, time.time(), time.perf_counter_ns())


def open_source(
    url: str,
    *,
    baud: int = 115200,
    silence_s: float = 5.0,
    reconnect: bool = False,
    request: Request | None = None,
) -> Chunks:
    """The source of chunks behind a name, as a context manager.

    Args:
        url: A device path or URL, the path of a file or named pipe, or - for stdin.
        baud, silence_s, reconnect, request: As `Port` takes them; ignored for files.

    Raises:
        InputError: If the file cannot be read.
    """
    if url == STDIN:
        return contextlib.nullcontext(FileSource(sys.stdin.fileno()))
    if "://" not in url and _is_file(Path(url)):
        return _file(Path(url))
    return Port(url, baud=baud, silence_s=silence_s, reconnect=reconnect, request=request)


def _is_file(path: Path) -> bool:
    with contextlib.suppress(OSError):
        mode = path.stat().st_mode
        return stat.S_ISREG(mode) or stat.S_ISFIFO(mode)
    return False


@contextlib.contextmanager
def _file(path: Path) -> Iterator[FileSource]:
    try:
        file = path.open("rb", buffering=0)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a file of frames") from error
    with file:
        yield FileSource(file.fileno())
