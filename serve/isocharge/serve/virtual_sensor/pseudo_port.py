"""A pseudo-terminal as a serial port: this process writes to one end, a reader opens the device path of the other."""

import array
import contextlib
import importlib
import os
from typing import Any

from isocharge.common.errors import PortError

PORT_BUFFER = 3840
"""Largest number of bytes that wait for the reader. Linux holds 4095: beyond, a write could be cut within a frame."""


class PseudoPort:
    """An open pseudo-terminal in raw mode; `url` is the device path. Close it to make the port vanish."""

    def __init__(self) -> None:
        """Open one.

        Raises:
            PortError: If the system has none: Windows.
        """
        tty, self._fcntl, self._termios = posix_modules()
        # The reader's end stays open here, so the port does not hang up when a reader closes it.
        self._writer, self._reader = os.openpty()
        tty.setraw(self._reader)
        os.set_blocking(self._writer, False)
        self.url = os.ttyname(self._reader)

    def write_whole(self, data: bytes) -> bool:
        """Write all of `data`, or nothing if the reader is too far behind, without waiting; whether it was written."""
        waiting = array.array("i", [0])
        self._fcntl.ioctl(self._reader, self._termios.FIONREAD, waiting)
        if waiting[0] + len(data) > PORT_BUFFER:
            return False
        with contextlib.suppress(BlockingIOError):
            return os.write(self._writer, data) == len(data)
        return False

    def close(self) -> None:
        """Make the port vanish, as when a cable is pulled."""
        os.close(self._writer)
        os.close(self._reader)


def posix_modules() -> tuple[Any, Any, Any]:
    """The modules `tty`, `fcntl` and `termios`, which handle pseudo-terminals.

    Raises:
        PortError: If this system has no pseudo-terminals.
    """
    try:
        tty, fcntl, termios = map(importlib.import_module, ("tty", "fcntl", "termios"))
    except ImportError as error:
        raise PortError(
            f"a virtual sensor needs a pseudo-terminal, and this system has none ({error}); run it on Linux or macOS, "
            "or on Windows in WSL"
        ) from error
    return tty, fcntl, termios
