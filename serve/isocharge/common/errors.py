"""The exceptions of isocharge. Each also inherits from the built-in exception that fits it.

A message states what was expected, what was given, where, and what to do. The command line maps the exceptions to exit
codes in `isocharge.cli.main` (2 for wrong input, 1 for everything else), the servers map them to HTTP and gRPC statuses
in `isocharge.serve.network.protocol.response`.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from isocharge.common.printable_text import printable, printable_lines

MAX_VALUE_CHARACTERS = 200
"""Largest number of characters of a wrong value, or of a list of keys, in a message."""


def cut(text: str) -> str:
    """Return a text for a message: printable, and cut after `MAX_VALUE_CHARACTERS` characters."""
    if len(text) <= MAX_VALUE_CHARACTERS:
        return printable(text)
    return printable(text[:MAX_VALUE_CHARACTERS]) + "..."


def shown(value: object) -> str:
    """Return the repr of a value for a message, cut after `MAX_VALUE_CHARACTERS` characters."""
    try:
        return cut(repr(value))
    except (RecursionError, ValueError):  # nested too deeply, or an int with more digits than Python prints
        return f"a {type(value).__name__} that is too large to print"


class IsochargeError(Exception):
    """Base class of all errors that isocharge raises on purpose."""

    def __str__(self) -> str:
        """Return the message in printable characters, because messages contain names from files and boards."""
        return printable_lines(super().__str__())


class InputError(IsochargeError, ValueError):
    """What the caller gave cannot be used as it is; nothing was computed."""


class SensorError(InputError):
    """A sensor description is wrong: unknown key, electrode off the film, impossible material."""


class SceneError(InputError):
    """A press cannot exist: probe off the film, negative force, unknown probe notation."""


class ConfigError(InputError):
    """A training configuration is wrong."""


class ChargeError(InputError):
    """Charges do not fit the model: wrong number, NaN, infinite."""


class PressError(InputError):
    """Measured presses cannot be used: wrong column, not a number, force that is not positive."""


class DeviceError(InputError):
    """The description of a device is wrong: unknown key, frame whose parts do not add up, unknown checksum."""


class RecordingError(InputError):
    """A file is no recording, or a damaged one."""


class DatasetError(InputError):
    """A folder is not a dataset, or a damaged one."""


class ModelError(InputError):
    """A model is missing, damaged, or of another format."""


class ModelNotFound(ModelError):
    """No model of that name and version is served."""


class RequestError(InputError):
    """A request to the server is not one that it understands."""


class UnknownPath(RequestError):
    """Nothing is served under this path."""


class WrongMethod(RequestError):
    """This path is asked for in another way; `allowed` says how."""

    def __init__(self, message: str, allowed: str) -> None:
        super().__init__(message)
        self.allowed = allowed


class TooLarge(RequestError):
    """A request is larger than the server's limits."""


class TooMany(RequestError):
    """More calls are open than the server's limits allow."""


class UnknownEncoding(RequestError):
    """A body is compressed in a way that the server does not read."""


class TokenError(IsochargeError, PermissionError):
    """A request does not carry the server's token."""


class OriginError(IsochargeError, PermissionError):
    """A request comes from a page of another site."""


class ListenError(IsochargeError, OSError):
    """The server cannot listen where it was asked to."""


class OutputExists(IsochargeError, FileExistsError):
    """The output is already there; nothing is overwritten unasked."""


class OutputError(IsochargeError, OSError):
    """The file system refuses an output; nothing is left of it."""


class SolveError(IsochargeError, ArithmeticError):
    """No equilibrium was found to the asked tolerance."""


class WorkersLost(IsochargeError, ConnectionError):
    """Processes or a cluster that did the work ended, do not answer, or run another isocharge."""


class TrainingError(IsochargeError, ArithmeticError):
    """Training produced no usable network."""


class PortError(IsochargeError, ConnectionError):
    """A port cannot be opened."""


class PortLost(PortError):
    """A port went away while it was read."""


class NoFramesError(PortError):
    """The bytes of a port contain no frames of a known format."""


class PressCheckError(IsochargeError, RuntimeError):
    """The presses of a check did not come, or do not tell the channels apart."""


class TareError(IsochargeError, RuntimeError):
    """The film was not left alone while it was tared."""


class MissingExtra(IsochargeError, ImportError):
    """A part of isocharge needs packages that are not installed; the message names the install command."""


@contextmanager
def error_prefix(where: str, kind: type[IsochargeError]) -> Iterator[None]:
    """Put `where` before the messages of the errors of a kind that the block raises."""
    try:
        yield
    except kind as error:
        raise kind(f"{where}{error}") from error
