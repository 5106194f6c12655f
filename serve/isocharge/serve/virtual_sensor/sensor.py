"""Virtual sensor, which sends the frames of a simulated board through a pseudo-terminal.

A forward map computes the touch charges of the whole script before the first frame is sent. The amplifier processes the
touch charges block by block in the order of time, because its output depends on earlier charges. Frames are written at
absolute times, so the frame rate does not drift. If the computer is too busy to write a frame in time, all later frames
are postponed, as if the board had paused. If the later frames were not postponed, the late frames would be sent in one
burst. A burst would overflow the buffer of the port and look like a higher frame rate.

The sensor never waits for a reader. A frame that does not fit into the buffer of the port is discarded and counted.
After a discarded frame, the reader receives frames with a gap in the frame numbers.
"""

import array
import contextlib
import fcntl
import itertools
import os
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.common.files import as_output_errors
from isocharge.serve.frames.formats import encode_frame
from isocharge.serve.frames.frame import SEQ_MODULUS, T_US_MODULUS, Frame
from isocharge.serve.virtual_sensor.script import Faults, Script, corrupt

PORT_BUFFER_BYTES = 3840
"""Largest number of bytes that wait for the reader.

The buffer of Linux has 4095 bytes. If the buffer were filled completely, a frame could be written incompletely.
"""


class PseudoPort:
    """An open pseudo-terminal in raw mode.

    Attributes:
        url: Path of the device that a reader opens.
    """

    def __init__(self) -> None:
        """Open a pseudo-terminal."""
        # The file descriptor of the reader's end also stays open here. If the descriptor were closed here, the
        # operating system would hang up the port when a reader closes it.
        self._writer, self._reader = os.openpty()
        tty.setraw(self._reader)  # in raw mode, the operating system passes all bytes on unchanged
        os.set_blocking(self._writer, False)  # a full buffer raises BlockingIOError instead of delaying the sensor
        self.url = os.ttyname(self._reader)

    def write_whole(self, data: bytes) -> bool:
        """Write data without waiting. If the buffer does not have enough room for all data, nothing is written.

        `_writer` and `_reader` are the two ends of the pseudo-terminal.

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
        return written_count == len(data)  # `PORT_BUFFER_BYTES` makes a partial write unlikely

    def discard_received(self) -> None:
        """Discard the bytes that the connected program has sent. A full buffer would block this program."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._writer, PORT_BUFFER_BYTES)

    def close(self) -> None:
        """Close the pseudo-terminal. For the reader, closing the port is the same as unplugging the cable."""
        os.close(self._writer)
        os.close(self._reader)


Charges = Callable[[Array], Array]
"""Forward map: function of contacts (x, y, F), shape (n, 3), mm and N. It returns charges, shape (n, n_electrode),
pC."""

Noise = Callable[[Array, np.random.Generator], Array]
"""Amplifier: function from charges and a random generator to measured charges, both of shape (n, electrodes), pC.

The function is called block by block in the order of time, so that the output may depend on earlier charges.
"""

Encode = Callable[[Frame], bytes]
"""Frame format: function from a frame to its bytes."""

MAX_LATENESS_S = 0.05
"""Largest delay of a frame that does not postpone the later frames, s.

After a larger delay, all later frames are postponed by the delay.
"""

BLOCK_S = 0.5
"""Length of the blocks that the amplifier processes, s."""

MAX_RANDOM_OFFSET_pC = 20.0
"""Largest absolute value of a random constant charge, pC."""


class VirtualSensor:
    """Context manager that plays a script repeatedly while the context is active.

    Readers may open and close the port at any time. Entering the context resets the counters.

    Attributes:
        script: The presses that are played.
        port_path: Path of the pseudo-terminal.
        sent: Number of frames that were written.
        withheld: Number of frames that were discarded because they did not fit into the buffer of the port.
        lost: Number of frames that were not sent because of a fault.
        corrupted: Number of frames that were damaged by a fault.
        paused_s: Time by which frames were postponed because the computer was busy, s.

    Example:
        >>> with VirtualSensor(charges, wander(seed=1)) as sensor:  # doctest: +SKIP
        ...     with Port(sensor.url) as port:
        ...         records = stream(port, predictor)
    """

    def __init__(
        self,
        charges: Charges,
        script: Script,
        *,
        noise: Noise = lambda charge_pC, _rng: charge_pC,
        offset_pC: Sequence[float] | None = None,
        seed: int = 0,
        encode: Encode = encode_frame,
        faults: Faults | None = None,
        link: Path | None = None,
    ) -> None:
        """Prepare the simulated board, and compute the touch charges of its script.

        Args:
            charges: Forward map, a function from contacts to charges. It is called once, for the frames in which
                something touches the film.
            script: The presses.
            noise: Amplifier, a function from charges and a random generator to measured charges. By default, the
                measured charges are the charges of the film.
            offset_pC: Charge of each electrode that is added to every frame, pC. A reader measures the added charges as
                its tare. By default, the added charges are drawn at random.
            seed: Seed of noise, offset and faults.
            encode: Frame format, a function from a frame to its bytes.
            faults: Faults between the sensor and the reader; none by default.
            link: Path of a symbolic link to the port. The link exists while the context is active.

        Raises:
            SceneError: If the forward map returns charges of another shape, or charges that are not finite.
            ValueError: If there are more or fewer offsets than electrodes.
        """
        self._rng = np.random.default_rng(seed)
        self.script = script
        self._amplify = noise
        self._encode = encode
        self._faults = faults or Faults()
        self._link = link
        self._noiseless_pC = _noiseless_charges(charges, script)  # touch charges of the script, shape (n, electrodes)
        n_electrode = self._noiseless_pC.shape[1]
        random_pC = self._rng.uniform(-MAX_RANDOM_OFFSET_pC, MAX_RANDOM_OFFSET_pC, n_electrode)
        self._offset_pC = random_pC if offset_pC is None else np.reshape(offset_pC, n_electrode)

        self._reset_counters()
        self._port_stack = contextlib.ExitStack()  # stops the writer and closes the port, if the context is active
        self.port_path = ""

    def _reset_counters(self) -> None:
        """Set the counters of frames, and the time by which frames were postponed, to zero."""
        self.sent = 0
        self.withheld = 0  # did not fit into the buffer of the port
        self.lost = 0  # not sent because of a fault
        self.corrupted = 0  # damaged by a fault
        self.paused_s = 0.0

    @property
    def url(self) -> str:
        """Path of the port for the reader, while the context is active."""
        return str(self._link or self.port_path)

    def frames(self) -> Iterator[bytes]:
        """Compute the frames of the script, and yield the bytes of each frame without waiting until the frame is due.

        The bytes are empty if the frame is lost because of a fault.

        The charges are computed in blocks of frames, because the amplifier (`_amplify`) adds noise and processes the
        charges in the order of time. The script is repeated without end.
        """
        block_size = max(1, round(BLOCK_S * self.script.rate_Hz))
        for first_frame in itertools.count(step=block_size):
            rows = range(first_frame, first_frame + block_size)
            # After its last row, the script begins again.
            noiseless_pC = self._noiseless_pC.take(rows, axis=0, mode="wrap")
            block_pC = self._amplify(noiseless_pC, self._rng) + self._offset_pC  # shape (block_size, electrodes)
            for frame_number, charge_pC in zip(rows, block_pC.tolist(), strict=True):
                yield self._frame_bytes(frame_number, tuple(charge_pC))

    def _frame_bytes(self, frame_number: int, charge_pC: tuple[float, ...]) -> bytes:
        """Encode a frame, and apply the faults of the transmission to its bytes. Count damaged frames.

        Args:
            frame_number: Number of the frame since the start of the sensor.
            charge_pC: Charge of each electrode, pC.

        Returns:
            The bytes that the sensor sends; empty if the frame is lost because of a fault.
        """
        # Draw a random number only if frames are to be lost at random. An additional number would change the noise of
        # all later frames, which only the seed is meant to determine.
        lose_share = self._faults.lose_share
        if lose_share > 0.0 and self._rng.random() < lose_share:
            return b""
        t_us = round(1e6 * frame_number / self.script.rate_Hz) % T_US_MODULUS
        data = self._encode(Frame(frame_number % SEQ_MODULUS, t_us, charge_pC))
        if not self._faults.corrupt_share:  # 0: no bytes are damaged, and no random numbers are drawn
            return data
        damaged_data = corrupt(data, self._faults.corrupt_share, self._rng)
        if damaged_data != data:
            self.corrupted += 1
        return damaged_data

    def __enter__(self) -> Self:
        """Reset the counters, open the port, and start the thread that writes the frames.

        Raises:
            OutputError: If the link cannot be created.
        """
        self._reset_counters()
        stop = threading.Event()
        with contextlib.ExitStack() as stack:  # closes the port if the link cannot be created
            port = stack.enter_context(contextlib.closing(PseudoPort()))
            if self._link:
                with as_output_errors(self._link):
                    self._link.symlink_to(port.url)
                stack.callback(self._link.unlink, missing_ok=True)
            writer = threading.Thread(target=self._play, args=(port, stop), name="virtual sensor", daemon=True)
            writer.start()
            stack.callback(writer.join)
            stack.callback(stop.set)  # called before `writer.join`, because an exit stack calls the last callback first
            self._port_stack = stack.pop_all()  # so that the port remains open after this block, until `__exit__`
        self.port_path = port.url
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread that writes the frames, and close the port."""
        self._port_stack.close()

    def _play(self, port: PseudoPort, stop: threading.Event) -> None:
        """Write each frame to the port when it is due, until the event `stop` is set.

        A frame that is late by more than `MAX_LATENESS_S` postpones all later frames.
        """
        start_s = time.perf_counter()
        for frame_number, data in enumerate(self.frames()):
            due_s = start_s + self.paused_s + frame_number / self.script.rate_Hz
            if stop.wait(max(0.0, due_s - time.perf_counter())):
                return
            lateness_s = time.perf_counter() - due_s
            if lateness_s > MAX_LATENESS_S:
                self.paused_s += lateness_s

            port.discard_received()
            if not data:  # a fault has removed the frame
                self.lost += 1
            elif port.write_whole(data):
                self.sent += 1
            else:  # the frame does not fit into the buffer of the port
                self.withheld += 1


def _noiseless_charges(forward: Charges, script: Script) -> Array:
    """Compute the touch charges of all frames of a script, without noise.

    Args:
        forward: Forward map: function from contacts (x, y, force), shape (k, 3), to charges, shape (k, electrodes), pC.
            It is called for the k frames in which something touches the film.
        script: Contacts of n frames.

    Returns:
        Charges, shape (n, electrodes), pC; zero in frames in which nothing touches the film.

    Raises:
        SceneError: If the forward map returns charges of another shape, or charges that are not finite.
    """
    is_touch = script.touching
    touch_count = is_touch.sum()
    touch_pC = forward(script.contact[is_touch])
    if touch_pC.ndim != 2 or len(touch_pC) != touch_count or not np.isfinite(touch_pC).all():
        raise SceneError(
            f"forward map: expected finite charges of shape ({touch_count}, electrodes), got shape {touch_pC.shape} "
            f"with {np.count_nonzero(~np.isfinite(touch_pC))} not finite"
        )
    charge_pC = np.zeros((len(script.contact), touch_pC.shape[1]))
    charge_pC[is_touch] = touch_pC
    return charge_pC
