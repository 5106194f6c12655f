"""Records as lines of text, JSON or CSV, on standard output or in a new file."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from isocharge.common.errors import OutputError
from isocharge.common.files import AtomicWriter, as_output_errors, new_file
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind
from isocharge.serve.record.csv_rows import csv_header, csv_row
from isocharge.serve.record.record import PredictionRecord

LineOf = Callable[[PredictionRecord], str]
"""Function that returns a record as a line, without the line feed."""


class StandardOutput:
    """Writes a line for each record to standard output."""

    def __init__(self, write: Callable[[str], object], line_of: LineOf, header: str | None = None) -> None:
        """Write the header, if there is one.

        Args:
            write: Function that writes a text to standard output.
            line_of: Function that returns a record as a line.
            header: First line.
        """
        self._write = write
        self._line_of = line_of
        if header is not None:
            write(header + "\n")

    def write(self, record: PredictionRecord) -> None:
        """Write the line of a record."""
        self._write(self._line_of(record) + "\n")

    def close(self) -> None:
        """Leave standard output open."""


class TextFile:
    """Writes a line for each record into a new file.

    If the records come from a sensor, the file is created under its final name, and whole lines are appended to it. In
    a replay, the file gets its name when it is complete.
    """

    def __init__(self, path: Path, line_of: LineOf, header: str | None = None, *, is_live: bool) -> None:
        """Create the file.

        Args:
            path: The file; it must not exist.
            line_of: Function that returns a record as a line.
            header: First line.
            is_live: Whether the records come from a sensor.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        self._path = path
        self._line_of = line_of
        self._stack = ExitStack()  # closes the file and, in a replay, then renames it
        draft = path if is_live else self._stack.enter_context(new_file(path))
        self._file = AtomicWriter(draft)
        self._stack.callback(self._file.close)
        if header is not None:
            self._write_line(header)

    def write(self, record: PredictionRecord) -> None:
        """Write one line for a record. Raise OutputError if the disk is full."""
        self._write_line(self._line_of(record))

    def close(self) -> None:
        """Close the file. In a replay, the file gets its name now."""
        self._stack.close()

    def discard(self) -> None:
        """Close the file. In a replay, the file is removed."""
        # The contexts are left with an error, so that they remove an incomplete file. They raise this error again.
        incomplete = OutputError(f"{self._path}: incomplete")
        try:
            self._stack.__exit__(OutputError, incomplete, None)
        except OutputError as error:
            if error is not incomplete:
                raise

    def _write_line(self, line: str) -> None:
        with as_output_errors(self._path):
            self._file.write(f"{line}\n".encode())


def _json_line(record: PredictionRecord) -> str:
    return record.to_json()


def _csv_line_of(context: OutputContext) -> LineOf:
    return lambda record: csv_row(record, context.electrodes)


def _csv_header(context: OutputContext) -> str:
    return csv_header(context.electrodes, with_tracking=context.with_tracking, with_film=context.with_film)


class _NoOutput:
    """Writes nothing."""

    def write(self, record: PredictionRecord) -> None:
        pass

    def close(self) -> None:
        pass


def _open_stdout_json(_: str, context: OutputContext) -> Output:
    return StandardOutput(context.write_stdout, _json_line)


def _open_stdout_csv(_: str, context: OutputContext) -> Output:
    return StandardOutput(context.write_stdout, _csv_line_of(context), _csv_header(context))


def _open_nothing(_: str, __: OutputContext) -> Output:
    return _NoOutput()


def _open_json_file(target: str, context: OutputContext) -> Output:
    return TextFile(Path(target), _json_line, is_live=context.is_live)


def _open_csv_file(target: str, context: OutputContext) -> Output:
    return TextFile(Path(target), _csv_line_of(context), _csv_header(context), is_live=context.is_live)


STDOUT_JSON = OutputKind(form="json", accepts="json".__eq__, open=_open_stdout_json, is_standard_output=True)
STDOUT_CSV = OutputKind(form="csv", accepts="csv".__eq__, open=_open_stdout_csv, is_standard_output=True)
NO_OUTPUT = OutputKind(form="none", accepts="none".__eq__, open=_open_nothing, may_block=False)
JSON_FILE = OutputKind(form="FILE.jsonl", accepts=lambda target: target.endswith(".jsonl"), open=_open_json_file)
CSV_FILE = OutputKind(form="FILE.csv", accepts=lambda target: target.endswith(".csv"), open=_open_csv_file)
