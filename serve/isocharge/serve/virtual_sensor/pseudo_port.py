"""A pseudo-terminal that plays a serial port: one end for whoever writes here, a device path for whoever reads."""

import array
import contextlib
import fcntl
import os
import termios
import tty

PORT_BUFFER = 3840
"""Bytes that may wait for the reader. Linux holds 4095; beyond, a write could be cut in the middle of a frame."""


class PseudoPort:
    """An open pseudo-terminal in raw mode; `url` is the device path. Close it to make the port vanish."""

    def __init__(self) -> None:
        # Our own hold on the reader's end lets readers come and go without the port hanging up.
        self._writer, self._reader = os.openpty()
        tty.setraw(self._reader)
        os.set_blocking(self._writer, False)
        self.url = os.ttyname(self._reader)

    def write_whole(self, data: bytes) -> bool:
        """Write all of `data` or, where the reader is too far behind, nothing; never wait."""
        if self._waiting() + len(data) > PORT_BUFFER:
            return False
        with contextlib.suppress(BlockingIOError):
            return os.write(self._writer, data) == len(data)
        return False

    def _waiting(self) -> int:
        """Bytes that the reader has not taken yet."""
        count = array.array("i", [0])
        fcntl.ioctl(self._reader, termios.FIONREAD, count)
        return count[0]

    def close(self) -> None:
        """Make the port vanish, as when a cable is pulled."""
        os.close(self._writer)
        os.close(self._reader)
