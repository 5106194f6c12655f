"""The exceptions of isocharge. Each class also inherits from the built-in exception with the most similar meaning.

A message states what was expected, what was given, where, and what to do. `isocharge.cli.main` maps the exceptions to
exit codes: 2 for wrong input, and 1 for everything else. `isocharge.serve.network.protocol.response` maps the
exceptions to HTTP and gRPC statuses.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from isocharge.common.printable_text import printable, printable_lines

MAX_VALUE_CHARACTERS = 200
"""Largest number of characters of a wrong value, or of a list of keys, in a message."""


def cut(text: str) -> str:
    """Cut a text after `MAX_VALUE_CHARACTERS` characters, and make it printable, for an error message."""
    if len(text) <= MAX_VALUE_CHARACTERS:
        return printable(text)
    return printable(text[:MAX_VALUE_CHARACTERS]) + "..."


def shown(value: object) -> str:
    """Return the repr of a value for an error message, cut after `MAX_VALUE_CHARACTERS` characters."""
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
    """An input, such as an argument or a file, is not valid. Nothing was computed."""


class SensorError(InputError):
    """A sensor description is wrong: an unknown key, an electrode outside the film, or an impossible material."""


class SceneError(InputError):
    """A press is impossible: a probe outside the film, a negative force, or an unknown notation of the probe."""


class ConfigError(InputError):
    """A training configuration is wrong."""


class ChargeError(InputError):
    """Charges cannot be used with the model: a wrong number of charges, NaN, or an infinite charge."""


class PressError(InputError):
    """Measured presses cannot be used: a wrong column, a value that is no number, or a force that is not positive."""


class DeviceError(InputError):
    """A device description is wrong: an unknown key, an unknown checksum, or fields that do not fill the frame."""


class RecordingError(InputError):
    """A file is not a recording, or is damaged."""


class DatasetError(InputError):
    """A folder is not a dataset, or is damaged."""


class ModelError(InputError):
    """A model is missing, damaged, or of another format."""


class ModelNotFound(ModelError):
    """The server has no model with this name and version."""


class RequestError(InputError):
    """A request to the server is not valid."""


class UnknownPath(RequestError):
    """The server has no resource with this path."""


class WrongMethod(RequestError):
    """The method of a request is not allowed for its path.

    Attributes:
        allowed: Names of the allowed methods, for the header `Allow`.
    """

    def __init__(self, message: str, allowed: str) -> None:
        super().__init__(message)
        self.allowed = allowed


class TooLarge(RequestError):
    """A request is larger than the limits of the server."""


class TooMany(RequestError):
    """More calls are open than the limits of the server allow."""


class UnknownEncoding(RequestError):
    """The body of a request has a compression that the server does not support."""


class TokenError(IsochargeError, PermissionError):
    """A request does not contain the token of the server."""


class OriginError(IsochargeError, PermissionError):
    """A request was sent by a page of another site."""


class ListenError(IsochargeError, OSError):
    """The server cannot listen on the requested address."""


class OutputExists(IsochargeError, FileExistsError):
    """The output exists already and is not overwritten."""


class OutputError(IsochargeError, OSError):
    """An output cannot be written. No part of it remains."""


class SolveError(IsochargeError, ArithmeticError):
    """The solver found no equilibrium within the requested tolerance."""


class WorkersLost(IsochargeError, ConnectionError):
    """Worker processes or a cluster have ended, do not respond, or run another version of isocharge."""


class TrainingError(IsochargeError, ArithmeticError):
    """Training produced no usable network."""


class PortError(IsochargeError, ConnectionError):
    """A port cannot be opened."""


class PortLost(PortError):
    """A port was disconnected while frames were read from it."""


class NoFramesError(PortError):
    """The bytes of a port contain no frames of a known format."""


class PressCheckError(IsochargeError, RuntimeError):
    """The presses that a check expects were not made, or they do not distinguish the channels."""


class TareError(IsochargeError, RuntimeError):
    """The film was touched while its tare was measured."""


class MissingExtra(IsochargeError, ImportError):
    """A part of isocharge needs packages that are not installed; the message names the install command."""


@contextmanager
def error_prefix(where: str, kind: type[IsochargeError]) -> Iterator[None]:
    """Prefix the message of each error of class `kind` that the block raises with the text `where`."""
    try:
        yield
    except kind as error:
        raise kind(f"{where}{error}") from error
