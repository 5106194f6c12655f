"""The interface of an output, and the description of a kind of output.

Another package adds a kind of output through an entry point of the group "isocharge.outputs", which refers to an
`OutputKind`.

Example of such an entry point in pyproject.toml:

    [project.entry-points."isocharge.outputs"]
    sqlite = "my_package:SQLITE"
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from isocharge.serve.record.record import PredictionRecord


class Output(Protocol):
    """A destination of prediction records.

    An output may have a method `discard()`. This method is called instead of `close` if the records are incomplete
    because of an error, or because a replay was stopped. An output can then remove a file that contains only a part of
    the records.
    """

    def write(self, record: PredictionRecord, /) -> None:
        """Write a record. After an exception, the output receives no more records, but the stream continues."""

    def close(self) -> None:
        """Write all records that are still in memory, and release files and sockets."""


def discard(output: Output) -> None:
    """Close an output whose records are incomplete."""
    getattr(output, "discard", output.close)()


@dataclass(frozen=True, kw_only=True)
class OutputContext:
    """Properties of the stream that an output may need.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        with_tracking: Whether contacts are tracked, so that the records have the fields of a `Tracking`.
        with_film: Whether the film is followed, so that the records have the field `film`.
        is_live: Whether the records come from a sensor, which does not wait, or from a recording.
        write_stdout: Function that writes a text to standard output.
        stdout_is_ready: Function that waits a short time and returns whether standard output would accept a line.
    """

    electrodes: tuple[str, ...]
    with_tracking: bool = False
    with_film: bool = False
    is_live: bool = False
    write_stdout: Callable[[str], object] = sys.stdout.write
    stdout_is_ready: Callable[[], bool] = lambda: True


@dataclass(frozen=True, kw_only=True)
class OutputKind:
    """A kind of output, which is chosen by the form of its target.

    Attributes:
        form: Form of the targets, for help and messages, such as `FILE.csv`.
        accepts: Function that returns whether a target has this form.
        open: Function that opens a target. It raises an `IsochargeError` if this is impossible.
        may_block: Whether `write` may wait. In a live stream, such an output has its own thread and queue.
        is_standard_output: Whether the output writes to standard output. At most one target may do that, and the stream
            ends when standard output is closed.
    """

    form: str
    accepts: Callable[[str], bool]
    open: Callable[[str, OutputContext], Output]
    may_block: bool = True
    is_standard_output: bool = False
