"""Interface of all outputs of records, and the outputs that write lines of JSON or CSV.

Every output implements the interface `Output`. An `OutputKind` declares which targets belong to a kind of output. The
class `WriterQueue` keeps a slow output from delaying a live stream. `FileOutput` is the base class of outputs that
write files.

Other packages can add kinds of outputs. A package that adds a kind must declare an entry point in the group
"isocharge.outputs". The entry point must refer to an `OutputKind`.

Example of such an entry point in pyproject.toml:

    [project.entry-points."isocharge.outputs"]
    sqlite = "my_package:SQLITE"
"""

import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Generic, NamedTuple, Protocol, TypeVar

from isocharge.common.files import AtomicWriter, new_file
from isocharge.serve.record.formats import csv_header, csv_row
from isocharge.serve.record.record import PredictionRecord


class Output(Protocol):
    """A destination of prediction records.

    An output may also have a method `discard()`. If the records are incomplete because of an error, or because a replay
    was stopped, `discard` is called instead of `close`. The method `discard` can, for example, remove a file that
    contains only some of the records.
    """

    def write(self, record: PredictionRecord, /) -> None:
        """Write a record. The method must not change the record, because the other outputs receive the same record.

        If this method raises an exception in a live stream, the output receives no more records, and the stream
        continues without this output.
        """

    def close(self) -> None:
        """Write all records that are still in memory, and close the files and sockets of the output.

        The command waits until this method returns.
        """


class OutputContext(NamedTuple):
    """Properties of a stream of records, which are passed to the outputs.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        sections: Sections of the device file whose stages process contacts. These stages may add fields to the records.
        is_live: True if the records come from a sensor, which does not wait for the outputs. False if they come from a
            recording.
        write_stdout: Function that writes a text to standard output.
    """

    electrodes: tuple[str, ...]
    sections: tuple[str, ...] = ()
    is_live: bool = False
    write_stdout: Callable[[str], object] = sys.stdout.write


class OutputKind(NamedTuple):
    """A kind of output, such as CSV files. The form of a target decides which kind of output is used.

    Attributes:
        form: Form of the targets, for help and messages, such as `FILE.csv`.
        accepts: Function that returns whether the text of a target has this form.
        open: Function that opens the output with the given target. The function raises an `IsochargeError` or an
            `OSError` if the output cannot be opened.
        is_standard_output: Whether the output writes to standard output. Only one output of a command may write to
            standard output. The stream ends when standard output is closed.
        plugin: Name of the output in messages. The name is set when the entry point of another package is loaded.
    """

    form: str
    accepts: Callable[[str], bool]
    open: Callable[[str, OutputContext], Output]
    is_standard_output: bool = False
    plugin: str = "output of isocharge"


T = TypeVar("T")

MAX_WAITING_ITEMS = 10_000
"""Largest number of items that wait in a `WriterQueue`. Records of ten seconds at 1 kHz occupy about 10 MB."""

CLOSE_TIMEOUT_s = 1.0
"""Longest time that `WriterQueue.close` waits for the consumer to take the next item, s."""


class WriterQueue(Generic[T]):
    """Queue of limited length with a thread that writes the items of the queue.

    The producer never waits for a slow consumer. The thread writes the oldest item first. If the consumer is so slow
    that more than `MAX_WAITING_ITEMS` items are waiting, the oldest items are dropped and counted. A slow consumer
    therefore receives the newest items.

    Attributes:
        lost: Number of items that were dropped without being written, or that could not be written.
        error: Exception with which `write` has ended the thread. None if there is no exception, or if `put` has already
            raised the exception.
    """

    def __init__(self, write: Callable[[T], object]) -> None:
        """Start the thread.

        Args:
            write: Function that the thread calls with each item. If the function returns False, the item counts as
                lost.
        """
        self.lost = 0
        self._write = write
        self._items: SimpleQueue[T | None] = SimpleQueue()  # None ends the thread
        self._written_count = 0  # calls of `write` that have returned
        self._is_abandoned = False  # whether the thread must write no further item
        self.error: Exception | None = None  # exception of `write`, which has ended the thread
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)  # a write may hang forever
        self._thread.start()

    @property
    def is_stuck(self) -> bool:
        """Whether the thread of a closed queue is still waiting for the consumer to accept an item."""
        return self._thread.is_alive()

    def put(self, item: T) -> None:
        """Append an item to the queue. If the queue is full, the oldest item is dropped.

        Args:
            item: The item.

        Raises:
            Exception: If `write` has raised an exception in the thread, the same exception.
        """
        error = self.error
        if error is not None:
            self.error = None  # the error is reported only once
            raise error
        if self._items.qsize() >= MAX_WAITING_ITEMS:
            with suppress(Empty):  # raised if the thread has taken all items in the meantime
                self._items.get_nowait()
                self.lost += 1
        self._items.put(item)

    def close(self) -> None:
        """Write the waiting items as long as the consumer accepts items, and close the queue.

        If the consumer accepts no item within `CLOSE_TIMEOUT_s`, the waiting items are dropped and counted as lost.
        """
        self._items.put(None)

        # Wait as long as the thread completes at least one item within each timeout.
        earlier_count = -1  # differs from every number of written items
        while self._thread.is_alive() and self._written_count != earlier_count:
            earlier_count = self._written_count
            self._thread.join(CLOSE_TIMEOUT_s)

        # The thread has ended, or the consumer accepts no item. End the thread, and count the lost items. If the thread
        # has ended at the final None, the queue is empty, and no item is lost. Otherwise, the queue contains the
        # waiting items and the None. One more item is lost, which the thread has taken from the queue but not written.
        # The length of the queue is the right number, because the None counts for this item.
        self._is_abandoned = True
        self._thread.join(CLOSE_TIMEOUT_s)
        self.lost += self._items.qsize()

    def _run(self) -> None:
        """Write items until the queue is closed and empty, or until `write` raises an exception."""
        try:
            for item in iter(self._items.get, None):  # ends at the None that `close` appends
                if self._is_abandoned:
                    return
                if self._write(item) is False:  # `write` reports that it could not write the item
                    self.lost += 1
                self._written_count += 1  # also for such an item, because the consumer still accepts items
        except Exception as error:  # `put` raises it again in the thread of the caller
            self.error = error


class FileOutput:
    """Base class of outputs that write to a new file.

    If the records come from a sensor, the file has its final name from the beginning. In a replay, the file has a
    temporary name until it is complete.

    Attributes:
        path: Path of the file.
    """

    def __init__(self, path: Path, *, is_live: bool) -> None:
        """Create the file.

        Args:
            path: Path of the file, which must not exist yet.
            is_live: Whether the records come from a sensor.

        Raises:
            OutputExists: If the file exists already.
            OSError: If the file cannot be created.
        """
        self.path = path
        # When the stack is closed, it closes the file and, in a replay, gives the file its final name.
        self._stack = ExitStack()
        # A file with records of a sensor has its final name at once. It is kept even if it remains incomplete.
        written_path = path if is_live else self._stack.enter_context(new_file(path))
        self._file = AtomicWriter(written_path)
        self._stack.callback(self._file.close)

    def close(self) -> None:
        """Close the file. In a replay, also rename the file from its temporary name to its final name."""
        self._stack.close()

    def discard(self) -> None:
        """Close the file. In a replay, also remove the file, because it is incomplete."""
        self._stack.__exit__(EOFError, EOFError(), None)  # `new_file` removes the file after an error


def is_file_with(suffix: str) -> Callable[[str], bool]:
    """Return a function that checks whether a target is the path of a file whose name ends with `suffix`.

    A target with a scheme, such as `mqtt://host/touch.csv`, is not a file.
    """
    return lambda target: target.endswith(suffix) and "://" not in target


class JsonLines:
    """Output that writes each record as a line of JSON, for example to standard output."""

    def __init__(self, write_text: Callable[[str], object], _: OutputContext) -> None:
        """Store the function that writes a text."""
        self._write_text = write_text

    def write(self, record: PredictionRecord) -> None:
        """Write the line of a record."""
        self._write_text(record.to_json() + "\n")

    def close(self) -> None:
        """Leave standard output open."""


class CsvLines(JsonLines):
    """Output that writes each record as a line of CSV with the columns that the stream needs."""

    def __init__(self, write_text: Callable[[str], object], context: OutputContext) -> None:
        """Write the header."""
        super().__init__(write_text, context)
        self._electrodes = context.electrodes
        write_text(csv_header(context.electrodes, context.sections) + "\n")

    def write(self, record: PredictionRecord) -> None:
        """Write the line of a record."""
        self._write_text(csv_row(record, self._electrodes) + "\n")


class TextFile(FileOutput):
    """Output that writes one line to a new file for each record.

    Attributes:
        write: Function that writes the line of a record. It raises an `OSError` if the disk is full.
    """

    def __init__(self, path: Path, lines: type[JsonLines], context: OutputContext) -> None:
        """Create the file, and write the header if there is a header.

        Args:
            path: Path of the file, which must not exist yet.
            lines: Class of the output, for the form of the lines.
            context: Properties of the stream.

        Raises:
            OutputExists: If the file exists already.
            OSError: If the file cannot be created.
        """
        super().__init__(path, is_live=context.is_live)
        self.write = lines(lambda text: self._file.write(text.encode()), context).write


def _text_kinds(name: str, suffix: str, lines: type[JsonLines]) -> tuple[OutputKind, OutputKind]:
    """Return two kinds of outputs, which write lines to standard output and to a file.

    Args:
        name: Target of standard output.
        suffix: End of the names of files.
        lines: Class of the output.
    """
    standard_output = OutputKind(
        form=name,
        accepts=name.__eq__,
        open=lambda _, context: lines(context.write_stdout, context),
        is_standard_output=True,
    )
    file = OutputKind(
        form=f"FILE{suffix}",
        accepts=is_file_with(suffix),
        open=lambda target, context: TextFile(Path(target), lines, context),
    )
    return standard_output, file


STDOUT_JSON, JSON_FILE = _text_kinds("json", ".jsonl", JsonLines)
STDOUT_CSV, CSV_FILE = _text_kinds("csv", ".csv", CsvLines)
