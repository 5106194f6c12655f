"""Output of records to an MCAP file, which Foxglove, PlotJuggler and ROS 2 can read."""

from contextlib import ExitStack
from pathlib import Path

from isocharge.common.files import as_output_errors, new_file
from isocharge.serve.export.record_messages import RecordEncoding
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind, exit_with_error, is_file_with
from isocharge.serve.record.record import PredictionRecord

SUFFIX = ".mcap"
ROS2_SUFFIX = ".ros2.mcap"
"""End of the name of a file whose records are ROS 2 messages instead of JSON with a schema."""


class McapOutput:
    """Output that writes records to a new MCAP file.

    If the records come from a sensor, the file has its final name from the beginning. In a replay, the file has a
    temporary name until the file is complete.
    """

    def __init__(self, path: Path, electrodes: tuple[str, ...], encoding: RecordEncoding, *, is_live: bool) -> None:
        """Create the file.

        Args:
            path: Path of the file, which must not exist yet.
            electrodes: Names of the electrodes, in the order of the charges.
            encoding: Whether the records are written as JSON or as ROS 2 messages.
            is_live: Whether the records come from a sensor.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
            MissingExtra: If the extra `record` is not installed.
        """
        from isocharge.serve.export.mcap_file import McapFile  # needs the extra `record`

        self._path = path
        # In a replay, the file has a temporary name until it is complete. A live file has its final name at once. When
        # the stack is closed, it closes the file and, in a replay, gives the file its final name.
        self._stack = ExitStack()
        written_path = path if is_live else self._stack.enter_context(new_file(path))
        self._file = self._stack.enter_context(McapFile(written_path, electrodes, encoding))

    def write(self, record: PredictionRecord) -> None:
        """Write a record.

        Raises:
            InputError: If the time of the record cannot be expressed as a time stamp of ROS 2.
            OutputError: If the disk is full.
        """
        with as_output_errors(self._path):
            self._file.write(record)

    def close(self) -> None:
        """Write the index of the messages, and close the file.

        In a replay, this method also renames the file from its temporary name to its final name.
        """
        with as_output_errors(self._path):
            self._stack.close()

    def discard(self) -> None:
        """Close the file without writing the index. In a replay, also remove the file."""
        self._file.is_abandoned = True
        exit_with_error(self._stack)  # in a replay, the stack contains `new_file`, which removes an incomplete file


def _open_mcap(target: str, context: OutputContext) -> Output:
    return McapOutput(Path(target), context.electrodes, RecordEncoding.json, is_live=context.is_live)


def _open_ros2_mcap(target: str, context: OutputContext) -> Output:
    return McapOutput(Path(target), context.electrodes, RecordEncoding.ros2, is_live=context.is_live)


ROS2_MCAP_FILE = OutputKind(form=f"FILE{ROS2_SUFFIX}", accepts=is_file_with(ROS2_SUFFIX), open=_open_ros2_mcap)
MCAP_FILE = OutputKind(form=f"FILE{SUFFIX}", accepts=is_file_with(SUFFIX), open=_open_mcap)
