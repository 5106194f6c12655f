"""Chunks of bytes, and files, pipes and the standard input as sources of chunks.

A user may give a file as a port by mistake, for example a recording, records, a table of presses or an MCAP file. The
parsers of text would misread the numbers in such files as charges from a board, so these files are refused.
"""

import codecs
import os
import re
import shlex
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NamedTuple

from msgspec import Meta

from isocharge.common.errors import InputError

STDIN = "-"
"""Name of the standard input."""

HEAD_BYTES = 4096
"""Number of bytes at the start of a file from which the kind of the file is recognised."""

RECORDING_START = b'{"isocharge_recording"'
RECORD_KEYS = (b"frame_id", b"charge_pC", b"tare_pC")  # in JSON, and in the header of a CSV
MCAP_START = b"\x89MCAP"

PRESS_COLUMNS = {"x_mm", "y_mm", "force_N", "flags"}
"""Columns that occur only in tables of presses."""

Moment = Annotated[float, Meta(ge=-1e11, le=1e11, description="a time before the year 5138, unix seconds")]


class Chunk(NamedTuple):
    """Bytes that arrived together, with the time of arrival.

    Attributes:
        data: The bytes, at least one byte, and at most as many as fit into a line of a recording.
        timestamp: Host time of arrival, unix seconds.
        clock_ns: Value of `time.perf_counter_ns` at arrival, from which latencies and the times between chunks are
            computed.
        outage_s: Length of the outage that ended with these bytes, s; 0 if there was no outage.
    """

    data: Annotated[bytes, Meta(max_length=700_000)]
    timestamp: Moment
    clock_ns: Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
    outage_s: Annotated[float, Meta(ge=0.0)] = 0.0


def check_bytes(name: str, head: bytes) -> None:
    """Raise an error if a file does not contain the bytes that a board sends.

    Args:
        name: Path of the file, or - for the standard input.
        head: First bytes of the file.

    Raises:
        InputError: If the file is of another kind. The message states the kind, and how to use such a file.
    """
    kind_and_advice = foreign_kind(name, head)
    if head.startswith(RECORDING_START):
        kind_and_advice = f"got a recording; play it with: isocharge serve replay {shlex.quote(name)}"
    if kind_and_advice:
        raise InputError(f"{name}: expected a port, or a file of bytes from a board, {kind_and_advice}")


def foreign_kind(name: str, head: bytes) -> str:
    """Return the kind of a file that is not from a board, with advice; empty for recordings and bytes of a board.

    The text is the end of an error message that states what was expected, as in "got an MCAP file; ...".

    Lines of text with the column names of a table of presses are only accepted from the standard input.

    Args:
        name: Path of the file, or - for the standard input.
        head: First bytes of the file. They are compared with the beginnings of known kinds of files.
    """
    quoted_name = shlex.quote(name)  # for the commands in the advice
    first_line = head.removeprefix(codecs.BOM_UTF8).lstrip().partition(b"\n")[0]
    if all(key in first_line for key in RECORD_KEYS):
        return (
            "got records of `serve stream`; records hold results; record the board with `isocharge serve stream MODEL "
            "--port PORT --record touch.rec` and play it with `isocharge serve replay touch.rec`"
        )
    if head.startswith(MCAP_START):
        return (
            "got an MCAP file; MCAP files hold results, and isocharge only writes them; play the recording that was "
            "made beside it with `isocharge serve replay touch.rec`"
        )
    columns = {column.strip(' "') for column in re.split("[,;|\t]", first_line.decode("utf-8", "replace").strip())}
    if not columns.isdisjoint(PRESS_COLUMNS) and name != STDIN:
        return (
            f"got a table of presses; compute its contacts with: isocharge serve predict MODEL {quoted_name}; if a "
            f"board has sent these lines, use: isocharge serve stream MODEL --port - < {quoted_name}"
        )
    return ""


class FileSource:
    """Iterator over the chunks of a file, a pipe or the standard input, up to its end.

    Args:
        descriptor: File descriptor that is open for reading.
        name: Path of the file, or - for the standard input.

    Attributes:
        is_live: Always False, because no bytes are lost if the program reads them later.
        is_on_disk: Whether the bytes come from a file on a disk, which does not state when they arrived.
    """

    is_live = False

    def __init__(self, descriptor: int, name: str) -> None:
        """Store the file descriptor and the name, and check the first bytes of a file on a disk.

        The first bytes of a pipe cannot be read twice, so they are checked only when the first chunk is read.

        Raises:
            InputError: If the file on the disk does not come from a board.
        """
        self._descriptor = descriptor
        self._name = name
        self.is_on_disk = stat.S_ISREG(os.fstat(descriptor).st_mode)
        if self.is_on_disk:
            check_bytes(name, os.pread(descriptor, HEAD_BYTES, 0))

    def __iter__(self) -> Iterator[Chunk]:
        """Yield chunks of at most `HEAD_BYTES` until the file ends.

        All chunks of a file on a disk have the same arrival time, at which reading began. The arrival time of a chunk
        of a pipe is the time at which the chunk was read.

        Raises:
            InputError: If the file is a recording, a table or another file that does not come from a board.
        """
        start_s = time.time()
        data = os.read(self._descriptor, HEAD_BYTES)  # empty at the end of the file
        check_bytes(self._name, data)
        while data:
            arrival_s = start_s if self.is_on_disk else time.time()
            yield Chunk(data, arrival_s, time.perf_counter_ns())  # the last time is monotonic
            data = os.read(self._descriptor, HEAD_BYTES)


@contextmanager
def open_file(path: Path) -> Iterator[FileSource]:
    """Open a file or a named pipe as a source of chunks for the `with` block.

    Args:
        path: Path of the file or the pipe.

    Yields:
        The source.

    Raises:
        OSError: If the file cannot be read.
        InputError: If the file does not come from a board.
    """
    with path.open("rb", buffering=0) as file:
        yield FileSource(file.fileno(), str(path))
