"""The exceptions of isocharge.

Each class also inherits from the built-in exception with the most similar meaning. A message states what was expected,
what was given, where the error is, and what the user can do. `isocharge.cli.main` maps the exceptions to exit codes,
which are 2 for wrong input and 1 for all other errors. `isocharge.serve.network.protocol.response` maps the exceptions
to HTTP and gRPC statuses.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from isocharge.common.printable_text import printable, printable_lines

MAX_VALUE_CHARACTERS = 200
"""Largest number of characters of a wrong value, or of a list of keys, in a message."""


def cut(text: str) -> str:
    """Shorten a text for an error message to `MAX_VALUE_CHARACTERS` characters, and make the text printable."""
    if len(text) <= MAX_VALUE_CHARACTERS:
        return printable(text)
    return printable(text[:MAX_VALUE_CHARACTERS]) + "..."


def shown(value: object) -> str:
    """Return the `repr` of a value, shortened to `MAX_VALUE_CHARACTERS` characters, for an error message."""
    try:
        return cut(repr(value))
    except (RecursionError, ValueError):  # the value is nested too deeply, or is an int with too many digits
        return f"a {type(value).__name__} that is too large to print"


class IsochargeError(Exception):
    """Base class of all exceptions that isocharge defines."""

    def __str__(self) -> str:
        """Return the message in printable characters.

        A message may contain text from files and boards, and such text may contain characters that a terminal executes.
        """
        return printable_lines(super().__str__())


class InputError(IsochargeError, ValueError):
    """An input, such as an argument or a file, is not valid."""


class SensorError(InputError):
    """A sensor description is wrong, for example because an electrode lies outside the film."""


class SceneError(InputError):
    """A press cannot be simulated, for example because the probe lies outside the film or the force is negative."""


class ConfigError(InputError):
    """A training configuration is wrong."""


class ChargeError(InputError):
    """Charges cannot be used with a model, for example because a charge is missing or is not finite."""


class PressError(InputError):
    """Measured presses cannot be used, for example because a column is missing or a force is not positive."""


class DeviceError(InputError):
    """A device description is wrong, for example because it contains an unknown key or an unknown checksum."""


class RecordingError(InputError):
    """A file is not a recording, or the recording is damaged."""


class DatasetError(InputError):
    """A folder is not a dataset, or the dataset is damaged."""


class ModelError(InputError):
    """A model is missing, is damaged, or has an unsupported format."""


class ModelNotFound(ModelError):
    """The server has no model with the requested name and version."""


class RequestError(InputError):
    """A request to the server is not valid."""


class UnknownPath(RequestError):
    """The server has no resource at the path of a request."""


class WrongMethod(RequestError):
    """The HTTP method of a request is not allowed for the path of the request.

    Attributes:
        allowed: Names of the allowed methods, for the header `Allow`.
    """

    def __init__(self, message: str, allowed: str) -> None:
        super().__init__(message)
        self.allowed = allowed


class TooLarge(RequestError):
    """A request is larger than the server allows."""


class TooMany(RequestError):
    """More calls are open than the server allows."""


class UnknownEncoding(RequestError):
    """The body of a request is compressed by a method that the server does not support."""


class TokenError(IsochargeError, PermissionError):
    """A request does not contain the token of the server."""


class OriginError(IsochargeError, PermissionError):
    """A request was sent by a web page of another site."""


class ListenError(IsochargeError, OSError):
    """The server cannot listen on the requested address."""


class OutputExists(IsochargeError, FileExistsError):
    """An output file or folder exists already. It is not overwritten."""


class OutputError(IsochargeError, OSError):
    """An output file or folder cannot be written."""


class SolveError(IsochargeError, ArithmeticError):
    """The solver found no equilibrium within the requested tolerance."""


class WorkersLost(IsochargeError, ConnectionError):
    """Worker processes have ended, do not respond, or run another version of isocharge."""


class TrainingError(IsochargeError, ArithmeticError):
    """Training produced no usable network."""


class PortError(IsochargeError, ConnectionError):
    """A port cannot be opened."""


class PortLost(PortError):
    """A port was disconnected while frames were read from it."""


class NoFramesError(PortError):
    """The bytes from a port contain no frames of a known format."""


class PressCheckError(IsochargeError, RuntimeError):
    """The presses that a check needs were not made, or do not distinguish the channels."""


class TareError(IsochargeError, RuntimeError):
    """The film was touched while its tare was measured."""


class MissingExtra(IsochargeError, ImportError):
    """A part of isocharge needs packages that are not installed.

    The message contains the command that installs the packages.
    """


@contextmanager
def error_prefix(where: str, error_class: type[IsochargeError]) -> Iterator[None]:
    """Add a text in front of the message of each error that the `with` block raises.

    Args:
        where: Text that is added, for example the name of a file and a colon.
        error_class: Class of the errors whose messages are changed. All other exceptions are not changed.

    Raises:
        error_class: If the block raises an error of this class. The new error has the longer message.
    """
    try:
        yield
    except error_class as error:
        raise error_class(f"{where}{error}") from error
