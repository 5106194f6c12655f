"""Output of records as lines of JSON or CSV, to standard output or to a new file."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from isocharge.common.files import AtomicWriter, as_output_errors, new_file
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind, exit_with_error, is_file_with
from isocharge.serve.record.csv_rows import csv_header, csv_row
from isocharge.serve.record.record import PredictionRecord

LineFunction = Callable[[PredictionRecord], str]
"""Function that converts a record to a line of text without the line feed."""


class StandardOutput:
    """Output that writes one line to standard output for each record."""

    def __init__(self, write: Callable[[str], object], to_line: LineFunction, header: str | None = None) -> None:
        """Store the functions, and write the header to standard output if there is a header.

        Args:
            write: Function that writes a text to standard output.
            to_line: Function that converts a record to a line of text.
            header: First line of the output, without the line feed. None if there is no header.
        """
        self._write = write
        self._to_line = to_line
        if header is not None:
            write(header + "\n")

    def write(self, record: PredictionRecord) -> None:
        """Write the line of a record."""
        self._write(self._to_line(record) + "\n")

    def close(self) -> None:
        """Leave standard output open."""


class TextFile:
    """Output that writes one line to a new file for each record.

    If the records come from a sensor, the file has its final name from the beginning, and whole lines are appended to
    the file. In a replay, the file has a temporary name until the file is complete.
    """

    def __init__(self, path: Path, to_line: LineFunction, header: str | None = None, *, is_live: bool) -> None:
        """Create the file, and write the header if there is a header.

        Args:
            path: Path of the file, which must not exist yet.
            to_line: Function that converts a record to a line of text.
            header: First line of the output, without the line feed. None if there is no header.
            is_live: Whether the records come from a sensor.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        self._path = path
        self._to_line = to_line
        # In a replay, the file has a temporary name until it is complete. A live file has its final name at once. When
        # the stack is closed, it closes the file and, in a replay, gives the file its final name.
        self._stack = ExitStack()
        written_path = path if is_live else self._stack.enter_context(new_file(path))
        self._file = AtomicWriter(written_path)
        self._stack.callback(self._file.close)
        if header is not None:
            self._write_line(header)

    def write(self, record: PredictionRecord) -> None:
        """Write one line for a record.

        Raises:
            OutputError: If the disk is full.
        """
        self._write_line(self._to_line(record))

    def close(self) -> None:
        """Close the file. In a replay, also rename the file from its temporary name to its final name."""
        self._stack.close()

    def discard(self) -> None:
        """Close the file. In a replay, also remove the file."""
        exit_with_error(self._stack)  # in a replay, the stack contains `new_file`, which removes an incomplete file

    def _write_line(self, line: str) -> None:
        with as_output_errors(self._path):
            self._file.write(f"{line}\n".encode())


def _csv_line_function(context: OutputContext) -> LineFunction:
    return lambda record: csv_row(record, context.electrodes)


def _csv_header(context: OutputContext) -> str:
    return csv_header(context.electrodes, with_tracking=context.with_tracking, with_film=context.with_film)


class _NoOutput:
    """Output that ignores all records."""

    def write(self, record: PredictionRecord) -> None:
        pass

    def close(self) -> None:
        pass


# The functions below are the attribute `open` of an `OutputKind`. A parameter `_` is not needed by that kind.


def _open_stdout_json(_: str, context: OutputContext) -> Output:
    return StandardOutput(context.write_stdout, PredictionRecord.to_json)


def _open_stdout_csv(_: str, context: OutputContext) -> Output:
    return StandardOutput(context.write_stdout, _csv_line_function(context), _csv_header(context))


def _open_nothing(_: str, __: OutputContext) -> Output:
    return _NoOutput()


def _open_json_file(target: str, context: OutputContext) -> Output:
    return TextFile(Path(target), PredictionRecord.to_json, is_live=context.is_live)


def _open_csv_file(target: str, context: OutputContext) -> Output:
    return TextFile(Path(target), _csv_line_function(context), _csv_header(context), is_live=context.is_live)


STDOUT_JSON = OutputKind(form="json", accepts="json".__eq__, open=_open_stdout_json, is_standard_output=True)
STDOUT_CSV = OutputKind(form="csv", accepts="csv".__eq__, open=_open_stdout_csv, is_standard_output=True)
NO_OUTPUT = OutputKind(form="none", accepts="none".__eq__, open=_open_nothing, may_block=False, writes_nothing=True)
JSON_FILE = OutputKind(form="FILE.jsonl", accepts=is_file_with(".jsonl"), open=_open_json_file)
CSV_FILE = OutputKind(form="FILE.csv", accepts=is_file_with(".csv"), open=_open_csv_file)
