"""Recognition of files that are given as a port by mistake.

Examples are recordings, records, tables of presses, MCAP files and Parquet files. The parsers of text would misread the
numbers in such files as charges from a board.
"""

import codecs
import shlex

from isocharge.common.errors import InputError

HEAD_BYTES = 4096
"""Number of bytes at the start of a file from which the kind of the file is recognised."""

RECORDING_START = b'{"isocharge_recording"'
RECORD_KEYS = (b'"frame_id"', b'"charge_pC"', b'"tare_pC"')
MCAP_START = b"\x89MCAP"
PARQUET_START = b"PAR1"

PRESS_COLUMNS = {"x_mm", "y_mm", "force_N", "charge_pC.A", "flags"}
"""Columns that only tables of presses and records have."""


def refuse_foreign_file(name: str, head: bytes) -> None:
    """Raise an error if a file does not contain the bytes that a board sends.

    Args:
        name: Path of the file, or - for the standard input.
        head: First bytes of the file.

    Raises:
        InputError: If the file is of another kind. The message states the kind, and how to use such a file.
    """
    kind = foreign_kind(name, head)
    if kind:
        raise InputError(f"{name}: expected a port, or a file of bytes from a board, got {kind}")


def foreign_kind(name: str, head: bytes) -> str:
    """Return the kind of a file that does not come from a board, with advice; empty if it may come from a board.

    Args:
        name: Path of the file, or - for the standard input.
        head: First bytes of the file. They are compared with the beginnings of known kinds of files.
    """
    quoted_name = shlex.quote(name)  # for the commands in the advice
    text = head.removeprefix(codecs.BOM_UTF8).lstrip()
    first_line, _line_feed, _next_lines = text.partition(b"\n")
    if first_line.startswith(RECORDING_START):
        return f"a recording; play it with: isocharge serve replay {quoted_name}"
    if first_line.startswith(b"{") and all(key in first_line for key in RECORD_KEYS):
        return (
            "records of `serve stream`; records hold results; record the board with `isocharge serve stream MODEL "
            "--port PORT --record touch.rec` and play it with `isocharge serve replay touch.rec`"
        )
    if head.startswith(MCAP_START):
        return (
            "an MCAP file; MCAP files hold results, and isocharge only writes them; play the recording that was made "
            "beside it with `isocharge serve replay touch.rec`"
        )
    if head.startswith(PARQUET_START):
        return f"a Parquet file; compute its contacts with: isocharge serve predict MODEL {quoted_name}"
    columns = {column.strip(' "') for column in first_line.decode("utf-8", "replace").strip().split(",")}
    if columns & PRESS_COLUMNS:
        return (
            f"a table of presses; compute its contacts with: isocharge serve predict MODEL {quoted_name}; if a board "
            f"has sent these lines, use: isocharge serve stream MODEL --port - < {quoted_name}"
        )
    return ""
