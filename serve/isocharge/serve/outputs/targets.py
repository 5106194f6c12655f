"""Available kinds of outputs, and the class that writes records to all outputs of a command."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Self

from isocharge.common.errors import InputError, plugin_errors, shown
from isocharge.common.files import as_output_errors
from isocharge.serve.outputs.output import (
    CSV_FILE,
    JSON_FILE,
    STDOUT_CSV,
    STDOUT_JSON,
    FileOutput,
    Output,
    OutputContext,
    OutputKind,
    WriterQueue,
    is_file_with,
)
from isocharge.serve.outputs.udp import UDP
from isocharge.serve.record.record import PredictionRecord

ROS2_SUFFIX = ".ros2.mcap"
"""End of the name of an MCAP file whose records are ROS 2 messages instead of JSON with a schema."""


def _open_mcap(target: str, context: OutputContext) -> Output:
    """Create the MCAP file at the path `target`. The end of the path decides whether records are ROS 2 messages."""
    from isocharge.serve.outputs.mcap_file import McapFile  # needs the extra `record`

    is_ros2 = target.endswith(ROS2_SUFFIX)
    return McapFile(Path(target), context.electrodes, is_ros2=is_ros2, is_live=context.is_live)


OUTPUT_KINDS: tuple[OutputKind, ...] = (
    STDOUT_JSON,
    STDOUT_CSV,
    JSON_FILE,
    CSV_FILE,
    OutputKind(form=f"FILE{ROS2_SUFFIX}", accepts=is_file_with(ROS2_SUFFIX), open=_open_mcap),
    OutputKind(form="FILE.mcap", accepts=is_file_with(".mcap"), open=_open_mcap),
    UDP,
)
"""Kinds of outputs of this package. If several kinds accept a target, the first of these kinds is used."""

NO_OUTPUT = "none"
"""Target that receives no records."""

ENTRY_POINTS = "isocharge.outputs"
"""Group of the entry points through which other packages add kinds of outputs."""

log = logging.getLogger(__name__)


def target_forms() -> str:
    """Return the forms of all targets that this package accepts, as one text, separated by commas."""
    return ", ".join([*(kind.form for kind in OUTPUT_KINDS), NO_OUTPUT])


def output_kind(target: str) -> OutputKind:
    """Return the kind of output that accepts a target.

    The built-in kinds are tried before the kinds that other installed packages add through entry points.

    Args:
        target: Target of an output, such as `json` or `touch.csv`.

    Raises:
        InputError: If no kind accepts the target.
        PluginError: If an entry point cannot be imported, or does not refer to an `OutputKind`.
    """
    for kind in OUTPUT_KINDS:
        if kind.accepts(target):
            return kind

    # No built-in kind accepts the target. Try the kinds of other packages, and collect their forms for the message.
    forms = [target_forms()]
    for entry_point in entry_points(group=ENTRY_POINTS):
        plugin = f"output {entry_point.value}"
        with plugin_errors(target, plugin):
            added_kind: OutputKind = entry_point.load()
            if added_kind.accepts(target):
                return added_kind._replace(plugin=plugin)
            forms.append(str(added_kind.form))
    raise InputError(f"output {shown(target)}: expected one of the forms {', '.join(forms)}")


class Outputs:
    """Context manager that opens and closes all outputs of a command.

    Attributes:
        not_written: For each target that did not receive all records, the number of missing records, or None if an
            error ended the output.
    """

    def __init__(self, targets: Sequence[str], context: OutputContext) -> None:
        """Determine the kind of output for each target, without opening the outputs.

        Args:
            targets: Targets of the outputs, such as `json` or `touch.csv`. A target that occurs twice gets only one
                output.
            context: Properties of the stream, which are passed to each output.

        Raises:
            InputError: If no kind of output accepts a target, or two targets write to standard output.
        """
        kinds = {target: output_kind(target) for target in targets if target != NO_OUTPUT}
        stdout_targets = [target for target, kind in kinds.items() if kind.is_standard_output]
        if len(stdout_targets) > 1:
            raise InputError(
                f"outputs {shown(stdout_targets)}: expected at most one on standard output; remove one of them"
            )
        # Standard output is written last: if the program that reads it has ended, the write raises an error, but all
        # other outputs have received the record before.
        self._kinds = dict(sorted(kinds.items(), key=lambda item: item[1].is_standard_output))
        self._context = context
        self._writers: dict[str, Callable[[PredictionRecord], object]] = {}
        self._stack = ExitStack()  # closes or discards all outputs, the latest first
        self._discards_all = False  # whether the outputs are discarded instead of closed, because records are missing
        self.not_written: dict[str, int | None] = {}  # number of missing records by target; None if it is unknown

    @contextmanager
    def _named_errors(self, target: str) -> Iterator[None]:
        """Convert errors of an output to errors that state the cause, the target, and what the user can do."""
        with plugin_errors(target, self._kinds[target].plugin), as_output_errors(target):
            yield

    def __enter__(self) -> Self:
        """Open the outputs.

        Raises:
            IsochargeError, BrokenPipeError: If an output cannot be opened. The outputs that were opened before are
                discarded.
        """
        for target, kind in self._kinds.items():
            try:
                with self._named_errors(target):
                    output = kind.open(target, self._context)
                    write = output.write
            except BaseException:
                self._discards_all = True
                self._stack.close()
                raise
            # A live stream must not wait for a slow consumer, so its records are written by another thread, which takes
            # them from a queue. A replay writes them directly, and has no queue.
            queue = WriterQueue(write) if self._context.is_live else None
            self._writers[target] = write if queue is None else queue.put
            self._stack.callback(self._close_or_discard, target, output, queue)
        return self

    def __exit__(self, error: type[BaseException] | None, *_: Any) -> None:
        """Close the outputs.

        If an exception has ended a replay, the outputs are discarded instead of closed, and their incomplete files are
        removed.
        """
        self._discards_all = error is not None and not self._context.is_live
        self.close()

    @property
    def has_incomplete_file(self) -> bool:
        """Whether at least one output other than standard output lacks records.

        The value is valid only after the outputs were closed.
        """
        return any(not self._kinds[target].is_standard_output for target in self.not_written)

    def write(self, record: PredictionRecord) -> None:
        """Write a record to every output.

        Raises:
            Exception: In a replay, the error of any output. In a live stream, only an error of standard output.
        """
        for target, write in list(self._writers.items()):
            try:
                write(record)
            except Exception as error:
                self._handle_error(target, error)

    def _handle_error(self, target: str, error: Exception) -> None:
        """Raise the error of an output, or log the error and write no further records to the output.

        In a replay, every error is raised. In a live stream, only an error of standard output is raised, and the stream
        continues without any other output that has failed. Only the first error of an output is written to the log. The
        output is removed from `_writers`, and the number of its missing records is unknown.

        Raises:
            Exception: The error, with its cause and the target.
        """
        try:
            # Raise the error again, so that `_named_errors` adds the target to its message. The calls of an output are
            # not made in this context, because they would take longer.
            with self._named_errors(target):
                raise error
        except Exception as named_error:
            if not self._context.is_live or self._kinds[target].is_standard_output:
                raise
            # Remove the writer. If it was removed before, this is not the first error of the output.
            if self._writers.pop(target, None) is not None:
                log.error("%s: stopped (%s); the records after that are missing", target, named_error)
        self.not_written[target] = None  # the number is unknown

    def close(self) -> None:
        """Close all open outputs, and store in `not_written` how many records each output has not received.

        Raises:
            BaseException: An error that occurred, or Ctrl-C. All other outputs are closed before the exception is
                raised.
        """
        self._stack.close()

    def _close_or_discard(self, target: str, output: Output, queue: WriterQueue[PredictionRecord] | None) -> None:
        """Close an output if it contains all records, and otherwise discard it.

        An output is incomplete in three cases: a replay was stopped, another output could not be opened, or this output
        has failed. In the first two cases, all outputs are discarded (`_discards_all`). An error that occurs meanwhile
        is only written to the log, because the error that has ended the command is more important.

        The number of records that the output has not received is stored in `not_written`, or None if the number is
        unknown.

        Args:
            target: Target of the output, which messages use as its name.
            output: The output, which is open.
            queue: Queue of the thread that writes the records of a live stream; None in a replay.

        Raises:
            Exception: The error of the output, if the output cannot be closed.
        """
        try:
            if queue is not None:
                queue.close()  # writes the waiting records
                if queue.error is not None:  # the error of a write that has ended the thread
                    self._handle_error(target, queue.error)  # logs the error, or raises it for standard output
                if queue.lost > 0:
                    self.not_written.setdefault(target, queue.lost)  # keeps None, which `_handle_error` has set
                if queue.is_stuck:  # the thread is still in `write` of the output, which therefore cannot be closed
                    return
            with self._named_errors(target):
                # `_handle_error` removes the writer of an output that fails.
                if self._discards_all or target not in self._writers:
                    self._discard(output)
                else:
                    output.close()
        except KeyboardInterrupt:  # the output may be incomplete; a replay then removes the file
            self.not_written[target] = None
            raise
        except Exception as error:  # of the output, or raised by `_handle_error` above and now raised once more
            if self._discards_all:
                log.error("%s", error)
            else:
                self._handle_error(target, error)
        if self._discards_all:
            self.not_written[target] = None  # replaces a number of lost records, because more records are missing

    def _discard(self, output: Output) -> None:
        """Discard an output, or close an output that has no method `discard`. Remove a file without records."""
        discard_or_close = getattr(output, "discard", output.close)
        discard_or_close()
        if self._discards_all and self._context.is_live and isinstance(output, FileOutput):
            output.path.unlink()  # another output could not be opened, so the file has no records
