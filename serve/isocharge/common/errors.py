"""The exceptions of isocharge, printable text for their messages, and imports that give advice if they fail.

Each exception also inherits from the built-in exception with the most similar meaning. A message states what was
expected, what was given, where the error is, and what the user can do. `isocharge.cli.main` maps the exceptions to exit
codes, which are 2 for wrong input and 1 for all other errors. A server reports an error with its attribute `status`.

A message may quote text from boards, files, models and recordings, which may contain characters that a terminal
executes or hides. Examples are escape sequences that move the cursor or change the title of the window, marks that
reverse the direction of writing, and characters without width. `printable` replaces such characters by the escape
sequences that JSON uses, such as `\\u001b`. A text in JSON therefore remains valid JSON.

If a package is not installed, an import within `require` raises an error that states the command for installing the
missing extra. The names of `lazy_names` are imported only when a program uses them. A program that reads a dataset
therefore does not wait for the import of the solver, and a calibration does not wait for PyTorch. A program that
predicts contacts does not wait for the import of the servers and of the parsers of boards.
"""

import ast
import json
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any

INVISIBLE = re.compile("[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]")
"""Invisible characters that `str.isprintable` accepts.

These characters have the property Default_Ignorable_Code_Point (Unicode 15, DerivedCoreProperties.txt). They are
letters or marks, and `str.isprintable` accepts all letters and marks.
"""


def is_printable(text: str) -> bool:
    """Return whether all characters of a text are visible characters or blanks.

    The result is False if the text contains a character that a terminal would execute or hide.
    """
    return text.isprintable() and INVISIBLE.search(text) is None


def printable(text: str) -> str:
    """Escape all characters of a text that a terminal would execute or hide, including line feeds.

    Use this function for text that is inserted into a line, such as the name of a channel.

    Example:
        >>> print(printable("A\\x1b[2J\\u202e"))
        A\\u001b[2J\\u202e
    """
    if is_printable(text):
        return text
    return "".join(character if is_printable(character) else _escape(character) for character in text)


def printable_lines(text: str) -> str:
    """Escape all characters of a text that a terminal would execute or hide, but keep the line feeds."""
    return "\n".join(map(printable, text.split("\n")))


def _escape(character: str) -> str:
    """Return the escape sequence that JSON uses for a character.

    JSON escapes the code units of UTF-16. A character beyond U+FFFF has two code units, and therefore two sequences.
    """
    escaped = json.dumps(character)[1:-1]  # without the quotation marks
    return f"\\u{ord(character):04x}" if escaped == character else escaped  # JSON does not escape U+007F


MAX_VALUE_CHARACTERS = 200
"""Largest number of characters of a wrong value, or of a list of keys, in a message."""


def cut(text: str) -> str:
    """Shorten a text for an error message to `MAX_VALUE_CHARACTERS` characters, and make the text printable."""
    ending = "..." if len(text) > MAX_VALUE_CHARACTERS else ""
    return printable(text[:MAX_VALUE_CHARACTERS]) + ending


def shown(value: object) -> str:
    """Return the `repr` of a value, shortened to `MAX_VALUE_CHARACTERS` characters, for an error message."""
    try:
        return cut(repr(value))
    except (RecursionError, ValueError):  # the value is nested too deeply, or is an int with too many digits
        return f"a {type(value).__name__} that is too large to print"


class IsochargeError(Exception):
    """Base class of all exceptions that isocharge defines.

    Attributes:
        status: HTTP status with which a server reports the error.
    """

    status = 500

    def __str__(self) -> str:
        """Return the message in printable characters.

        A message may contain text from files and boards, and such text may contain characters that a terminal executes.
        """
        return printable_lines(super().__str__())


class InputError(IsochargeError, ValueError):
    """An input, such as an argument or a file, is not valid."""

    status = 400


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

    status = 404


class RequestError(InputError):
    """A request to a server is refused.

    Args:
        message: The reason.
        status: HTTP status of the response.
        *headers: Name and value of each further header of the response.
    """

    def __init__(self, message: str, status: int = 400, *headers: tuple[bytes, bytes]) -> None:
        """Create the error for a response with the given status and headers."""
        super().__init__(message)
        self.status = status
        self.headers = headers


class ListenError(IsochargeError, OSError):
    """The server cannot listen on the requested address."""


class OutputExists(IsochargeError, FileExistsError):
    """An output file or folder exists already. The existing file or folder is not overwritten."""


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


class PluginError(IsochargeError, RuntimeError):
    """An output or a source, for example from another package, cannot be used or has failed."""


class MissingExtra(IsochargeError, ImportError):
    """A part of isocharge needs packages that are not installed.

    The message contains the command that installs the packages.
    """


@contextmanager
def error_context(error_class: type[IsochargeError], before: str = "", after: str = "") -> Iterator[None]:
    """Add a text before or after the message of each error that the `with` block raises.

    Args:
        error_class: Class of the errors whose messages are changed. All other exceptions are not changed.
        before: Text before the message, for example the name of a file and a colon.
        after: Text after the message, for example a semicolon and what the user can do.

    Raises:
        error_class: If the block raises an error of this class. The new error has the longer message.
    """
    try:
        yield
    except error_class as error:
        raise error_class(f"{before}{error}{after}") from error


@contextmanager
def plugin_errors(target: str, plugin: str) -> Iterator[None]:
    """Convert the errors of an output or of a source to errors that name its target and its entry point.

    Args:
        target: What the user has given, such as the URL of a port.
        plugin: Kind, module and attribute of the entry point, such as "output my_package:SQLITE".

    Raises:
        PluginError: If the block raises an exception or ends the program. Errors of isocharge and a broken pipe, which
            ends a stream, are not changed.
    """
    try:
        yield
    except (IsochargeError, BrokenPipeError):
        raise
    except (Exception, SystemExit) as error:
        raise PluginError(
            f"{target}: the {plugin} failed ({type(error).__name__}: {error}); correct or uninstall its package, or do "
            "without it"
        ) from error


@contextmanager
def require(*extras: str) -> Iterator[None]:
    """If an import in the `with` block fails, raise an error with the command that installs the extras.

    Args:
        extras: Names of the extras in pyproject.toml, which are groups of optional packages. If no extras are given,
            the errors of the block are not changed.

    Raises:
        MissingExtra: If an import in the block fails because a package other than isocharge is not installed. If an
            import fails for any other reason, its error is not changed.

    Example:
        >>> with require("simulate"):
        ...     from isocharge.simulate import load_sensor
    """
    try:
        yield
    except (ModuleNotFoundError, MissingExtra) as error:  # another `require` inside the block may raise MissingExtra
        package, _, _ = (error.name or "").partition(".")  # for example "google" for the module "google.protobuf"
        if not extras or package in ("", "isocharge"):
            raise
        raise MissingExtra(
            f"this needs the package {package!r}, which is not installed; pip install 'isocharge[{','.join(extras)}]'",
            name=package,
        ) from error


@cache
def package_version() -> str:
    """Return the version of isocharge from the metadata of the installed package.

    The result is stored after the first call, because a busy server may have no file descriptor left for reading the
    metadata again.
    """
    from importlib.metadata import version  # imported late, because the import is slow

    return version("isocharge")


def lazy_names(package: str, *extras: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return the attributes `__getattr__`, `__dir__` and `__all__` of a package whose public names are imported late.

    A public name is imported when it is used for the first time, because Python calls `__getattr__` for each attribute
    that the package does not contain yet. The package states its public names and their modules once, as imports that
    only type checkers execute. This function finds these imports in the source of the package. A repeated name after
    `as` states that the name is public:

        if TYPE_CHECKING:
            from isocharge.simulate.solver.press import press as press
        else:
            __getattr__, __dir__, __all__ = lazy_names(__name__, "simulate")

    Args:
        package: Name of the package.
        *extras: Extras of pyproject.toml that the package needs.

    Returns:
        Function that imports a public name, function that returns a new list of the public names, and the public names.
    """
    source = pkgutil.get_data(package, "__init__.py") or b""
    imports = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)]
    # Only a public name has an `asname`, which is the name after `as`.
    module_by_name = {alias.name: node.module or "" for node in imports for alias in node.names if alias.asname}
    public_names = sorted(module_by_name)

    def import_public_name(name: str) -> Any:
        """Import a public name, and store it in the package. Python then does not call this function for it again.

        The enclosing function `lazy_names` provides the name `package` of the package, the `extras` that the package
        needs, and the module of each public name (`module_by_name`).

        Raises:
            AttributeError: If the name is not public.
            MissingExtra: If a package of the extra is not installed.
        """
        if name == "__version__":
            return package_version()
        if name not in module_by_name:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with require(*extras):
            value = getattr(import_module(module_by_name[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    # The second function becomes `__dir__`, so that tab completion suggests only the public names.
    return import_public_name, public_names.copy, public_names
