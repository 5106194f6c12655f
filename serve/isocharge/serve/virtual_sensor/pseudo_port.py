"""Pseudo-terminal through which the virtual sensor sends its frames."""

import array
import contextlib
import fcntl
import os
import termios
import tty

PORT_BUFFER_BYTES = 3840
"""Largest number of bytes that wait for the reader.

The buffer of Linux has 4095 bytes. If it were filled completely, a frame could be written incompletely.
"""


class PseudoPort:
    """An open pseudo-terminal in raw mode.

    Attributes:
        url: Path of the device for the reader.
    """

    def __init__(self) -> None:
        """Open a pseudo-terminal."""
        # The file descriptor of the reader's end also stays open here. Otherwise the operating system would hang up the
        # port when a reader closes it.
        self._writer, self._reader = os.openpty()
        tty.setraw(self._reader)  # in raw mode, the operating system passes all bytes on unchanged
        os.set_blocking(self._writer, False)  # a full buffer raises BlockingIOError instead of delaying the sensor
        self.url = os.ttyname(self._reader)

    def write_whole(self, data: bytes) -> bool:
        """Write data without waiting. If the buffer does not have enough room for all data, nothing is written.

        Args:
            data: The bytes of one frame.

        Returns:
            Whether all data were written.
        """
        # The operating system writes the number of bytes that the reader has not read yet into this array of one
        # integer.
        unread_count = array.array("i", [0])
        fcntl.ioctl(self._reader, termios.FIONREAD, unread_count)
        if unread_count[0] + len(data) > PORT_BUFFER_BYTES:
            return False
        try:
            written_count = os.write(self._writer, data)
        except BlockingIOError:  # the buffer is full
            return False
        return written_count == len(data)

    def discard_received(self) -> None:
        """Discard the bytes that the reader has sent. A full buffer would block a reader that sends bytes."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._writer, PORT_BUFFER_BYTES)

    def close(self) -> None:
        """Close the pseudo-terminal. For the reader, closing the port is the same as unplugging the cable."""
        os.close(self._writer)
        os.close(self._reader)
