"""The registered kinds of outputs, and the outputs of a command."""

from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Self

from isocharge.common.errors import InputError, IsochargeError, OutputError, shown
from isocharge.serve.outputs.mcap_output import MCAP_FILE, ROS2_MCAP_FILE
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind, discard
from isocharge.serve.outputs.queued_output import QueuedOutput
from isocharge.serve.outputs.text_outputs import CSV_FILE, JSON_FILE, NO_OUTPUT, STDOUT_CSV, STDOUT_JSON
from isocharge.serve.outputs.udp_output import UDP
from isocharge.serve.record.record import PredictionRecord

OUTPUT_KINDS: tuple[OutputKind, ...] = (
    STDOUT_JSON,
    STDOUT_CSV,
    NO_OUTPUT,
    JSON_FILE,
    CSV_FILE,
    ROS2_MCAP_FILE,
    MCAP_FILE,
    UDP,
)
"""The kinds of outputs of this package. The first kind that accepts a target opens it."""

ENTRY_POINTS = "isocharge.outputs"
"""Group of the entry points through which other packages add kinds of outputs."""


def target_forms() -> str:
    """Return the forms of the targets of this package, separated by commas, for help and messages."""
    return ", ".join(kind.form for kind in OUTPUT_KINDS)


def kind_of(target: str) -> OutputKind:
    """Return the kind of output for a target.

    The built-in kinds are tried first, and then the kinds that installed packages add by entry points.

    Args:
        target: Target of an output, such as `json` or `touch.csv`.

    Raises:
        InputError: If no kind accepts the target, or a package that adds a kind cannot be loaded.
    """
    for kind in OUTPUT_KINDS:
        if kind.accepts(target):
            return kind

    added_forms = []  # for the error message
    for entry_point in entry_points(group=ENTRY_POINTS):
        added_kind = _load_kind(entry_point)
        if added_kind.accepts(target):
            return added_kind
        added_forms.append(added_kind.form)

    forms = ", ".join([target_forms(), *added_forms])
    raise InputError(f"output {shown(target)}: expected one of the forms {forms}")


def _load_kind(entry_point: EntryPoint) -> OutputKind:
    """Return the kind of output that a package adds.

    Args:
        entry_point: Entry point of the package, which refers to an OutputKind.

    Raises:
        InputError: If the package cannot be loaded, or its entry point is not an OutputKind.
    """
    try:
        kind = entry_point.load()
    except Exception as error:
        raise InputError(
            f"output {entry_point.name} ({entry_point.value}): cannot be loaded ({type(error).__name__}: {error}); "
            "reinstall or remove the package that adds it"
        ) from error
    if not isinstance(kind, OutputKind):
        raise InputError(
            f"output {entry_point.name} ({entry_point.value}): expected an OutputKind, got {shown(kind)}; correct the "
            "package that adds it"
        )
    return kind


def _failure(target: str, error: Exception) -> OutputError:
    """Return the error that the user sees after an unexpected exception, for example in another package."""
    return OutputError(f"{target}: the output failed ({type(error).__name__}: {error})")


class Outputs:
    """The outputs of a command; a context manager that closes them.

    Attributes:
        not_written: For each target that did not receive all records, the number of missing records, or None if an
            error ended the output.
    """

    def __init__(self, targets: Sequence[str], context: OutputContext) -> None:
        """Find the kind of each target without opening it.

        Args:
            targets: Targets, such as `json` or `touch.csv`.
            context: Description of the stream.

        Raises:
            InputError: If a target has none of the forms, two targets are equal, or two targets write to standard
                output.
        """
        kinds = {target: kind_of(target) for target in targets}
        standard_targets = [target for target in targets if kinds[target].is_standard_output]
        other_targets = [target for target in targets if not kinds[target].is_standard_output]
        if len(standard_targets) > 1:
            raise InputError(
                f"outputs {shown(standard_targets)}: expected at most one on standard output; remove one of them"
            )
        if len(set(targets)) < len(targets):
            raise InputError(f"outputs {shown(list(targets))}: expected targets that differ; remove one of them")
        # Standard output is written last. If its reader has closed it, the other outputs have received the record.
        self._kinds = {target: kinds[target] for target in other_targets + standard_targets}
        self._context = context
        self._outputs: dict[str, Output] = {}
        self.not_written: dict[str, int | None] = {}

    def __enter__(self) -> Self:
        """Open the outputs.

        Raises:
            IsochargeError: If an output cannot be opened. The outputs that were opened before are discarded.
        """
        for target, kind in self._kinds.items():
            try:
                output = kind.open(target, self._context)
            except (IsochargeError, OSError, KeyboardInterrupt):
                self._discard()
                raise
            except Exception as error:  # an unexpected error, for example of another package
                self._discard()
                raise _failure(target, error) from error
            # A live stream must not wait for a slow consumer, so its records are written by another thread.
            if self._context.is_live and kind.may_block:
                output = self._queued(output, target, kind)
            self._outputs[target] = output
        return self

    def _queued(self, output: Output, target: str, kind: OutputKind) -> QueuedOutput:
        """Return an output that writes to another output in a thread.

        Args:
            output: The other output.
            target: Its target, for messages.
            kind: Its kind. Only standard output can report that its reader is slow, and ends the stream on an error.
        """
        if kind.is_standard_output:
            return QueuedOutput(output, target, is_ready=self._context.stdout_is_ready, ends_stream=True)
        return QueuedOutput(output, target)

    def __exit__(self, error: type[BaseException] | None, *_: Any) -> None:
        """Close the outputs. If a replay was stopped, its files are removed."""
        if error is not None and not self._context.is_live:
            self._discard()
        else:
            self.close()

    @property
    def has_incomplete_file(self) -> bool:
        """Whether an output other than standard output lacks records. The outputs must be closed before."""
        return any(not kind_of(target).is_standard_output for target in self.not_written)

    def write(self, record: PredictionRecord) -> None:
        """Write a record to every output.

        Raises:
            Exception: In a replay, the error of any output. In a live stream, only an error of standard output.
        """
        for target, output in self._outputs.items():
            try:
                output.write(record)
            except (IsochargeError, OSError):  # its message already states the reason
                raise
            except Exception as error:  # an unexpected error, for example of another package
                raise _failure(target, error) from error

    def close(self) -> None:
        """Close all open outputs, and store in `not_written` how many records each of them lacks.

        Raises:
            OSError, IsochargeError: The first error of an output. The other outputs are closed as well.
        """
        errors: list[BaseException] = []
        for target, output in self._remove_all():
            try:
                output.close()
            except (OSError, IsochargeError) as error:
                errors.append(error)
            # Only a queue can lose records without raising an error.
            if isinstance(output, QueuedOutput) and output.has_failed:
                self.not_written[target] = None  # the number is unknown, because the output has stopped
            elif isinstance(output, QueuedOutput) and output.lost:
                self.not_written[target] = output.lost
        if errors:
            raise errors[0]

    def _discard(self) -> None:
        """Discard all open outputs, because their records are incomplete."""
        for target, output in self._remove_all():
            discard(output)
            self.not_written[target] = None

    def _remove_all(self) -> Iterator[tuple[str, Output]]:
        """Remove the open outputs one by one, and yield each of them with its target."""
        while self._outputs:
            yield self._outputs.popitem()
