"""Protection of a stream from the errors of outputs that other packages add.

An error of such an output is reported with the name of its target. The output receives its own copy of each record, so
that it cannot change the records of other outputs. If its method `close` does not return, the command ends without it.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from msgspec import structs

from isocharge.common.errors import InputError, IsochargeError, OutputError, shown
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind, discard
from isocharge.serve.record.record import PredictionRecord

CLOSE_TIMEOUT_s = 10.0
"""Longest time for which a command waits for the method `close` of an added output, s."""


def protected_kind(kind: OutputKind, name: str) -> OutputKind:
    """Return a kind of output whose functions and outputs raise only errors that state their cause.

    Args:
        kind: Kind of output that another package adds.
        name: Name of the package's entry point, for messages.
    """

    def accepts(target: str) -> bool:
        """Return whether the kind accepts a target.

        Raises:
            InputError: If the function of the package raises an exception.
        """
        try:
            return kind.accepts(target)
        except Exception as error:
            raise InputError(
                f"output {name}: cannot tell whether it accepts {shown(target)} ({_describe(error)}); correct or "
                "remove the package that adds it"
            ) from error

    def open_output(target: str, context: OutputContext) -> Output:
        """Open the output with the given target.

        Raises:
            IsochargeError, OSError: If the output cannot be opened.
        """
        with _as_output_error(target):
            return AddedOutput(kind.open(target, context), target)

    return replace(kind, accepts=accepts, open=open_output)


class AddedOutput:
    """Output of another package, whose errors state the target of the output."""

    def __init__(self, output: Output, target: str) -> None:
        """Store the open output of the package, and its target for messages."""
        self._output = output
        self._target = target

    def write(self, record: PredictionRecord) -> None:
        """Write a copy of a record.

        Raises:
            IsochargeError, OSError: If the output of the package raises an exception.
        """
        with _as_output_error(self._target):
            self._output.write(_copy(record))

    def close(self) -> None:
        """Close the output.

        Raises:
            IsochargeError, OSError: If the output of the package raises an exception, or does not return in time.
        """
        self._end(self._output.close)

    def discard(self) -> None:
        """Discard the output, because it has not received all records.

        Raises:
            IsochargeError, OSError: If the output of the package raises an exception, or does not return in time.
        """
        self._end(lambda: discard(self._output))

    def _end(self, close: Callable[[], object]) -> None:
        """Call a function that ends the output, and wait at most `CLOSE_TIMEOUT_s`."""
        errors: list[Exception] = []

        def close_and_store_error() -> None:
            try:
                close()
            except Exception as error:
                errors.append(error)

        thread = threading.Thread(target=close_and_store_error, name="close", daemon=True)
        thread.start()
        thread.join(CLOSE_TIMEOUT_s)
        if thread.is_alive():
            raise OutputError(
                f"{self._target}: the output did not close within {CLOSE_TIMEOUT_s:g} s and may be incomplete"
            )
        with _as_output_error(self._target):
            for error in errors:
                raise error


def _copy(record: PredictionRecord) -> PredictionRecord:
    """Return a copy of a record that shares no dictionary with the record. All other values cannot be changed."""
    values = structs.asdict(record)
    charges = {name: dict(value) for name, value in values.items() if isinstance(value, dict)}
    return structs.replace(record, **charges)


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


@contextmanager
def _as_output_error(target: str) -> Iterator[None]:
    """Context manager that converts an unexpected exception to an `OutputError` that states the target."""
    try:
        yield
    except (IsochargeError, OSError):  # the message of such an error states the reason
        raise
    except Exception as error:
        raise OutputError(f"{target}: the output failed ({_describe(error)})") from error
