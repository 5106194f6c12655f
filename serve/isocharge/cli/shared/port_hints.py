"""Hints for a port whose bytes contain no frames of a known format."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from isocharge.common.errors import NoFramesError
from isocharge.serve.port.file_source import STDIN


@contextmanager
def no_frames_advice_added(port: str, device: Path | None) -> Iterator[None]:
    """Context manager that adds advice to the error message if the bytes of a port contain no frames.

    Args:
        port: Value of `--port`.
        device: Value of `--device`; None if the option is not given.

    Raises:
        NoFramesError: If the block raises this error. The advice is added to its message.
    """
    try:
        yield
    except NoFramesError as error:
        raise NoFramesError(f"{error}; {no_frames_hint(port, device)}") from error


def no_frames_hint(port: str, device: Path | None) -> str:
    """Return advice for a port whose bytes contain no frames of a known format.

    Args:
        port: Value of `--port`.
        device: Value of `--device`; None if the option is not given.
    """
    if port == STDIN or Path(port).is_file():  # the command `isocharge serve doctor` below can only listen on a port
        return "describe the board in a device file (--device)"
    wrong_device = f"{device} may describe another board; " if device is not None else ""
    command = f"isocharge serve doctor --port {shlex.quote(port)} --write board.toml"
    return f"{wrong_device}to find out what the board sends: {command}"
