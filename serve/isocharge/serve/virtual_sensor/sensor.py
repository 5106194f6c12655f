"""Virtual sensor, which is a pseudo-terminal that sends the frames of a board. The charges come from any forward map.

The touch charges of the whole script are computed before the first frame is sent. The amplifier, whose output depends
on earlier charges, processes the charges block by block. Frames are written at absolute times, so the frame rate does
not drift. If the computer is too busy to write a frame in time, all later frames are postponed, as if the board had
paused. Otherwise the delayed frames would be sent in one burst, which overflows the buffer of the port and looks like a
higher frame rate.

The sensor never waits for a reader. A frame that does not fit into the buffer of the port is discarded and counted, and
the reader receives a gap in the frame numbers.
"""

import array
import contextlib
import importlib
import itertools
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, PortError, SceneError
from isocharge.serve.frames.binary import encode_frame
from isocharge.serve.frames.frame import SEQ_MODULUS, T_US_MODULUS, Frame
from isocharge.serve.virtual_sensor.script import Faults, Script, corrupt

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
        """Open a pseudo-terminal.

        Raises:
            PortError: If the operating system has no pseudo-terminals. Windows has none.
        """
        tty, self._fcntl, self._termios = posix_modules()
        # The reader's end also stays open here, so that the port is not hung up when a reader closes it.
        self._writer, self._reader = os.openpty()
        tty.setraw(self._reader)
        os.set_blocking(self._writer, False)
        self.url = os.ttyname(self._reader)

    def write_whole(self, data: bytes) -> bool:
        """Write data without waiting. If the buffer has not enough room for all data, nothing is written.

        Returns:
            Whether the data were written.
        """
        waiting_bytes = array.array("i", [0])
        self._fcntl.ioctl(self._reader, self._termios.FIONREAD, waiting_bytes)
        if waiting_bytes[0] + len(data) > PORT_BUFFER_BYTES:
            return False
        with contextlib.suppress(BlockingIOError):
            return os.write(self._writer, data) == len(data)
        return False

    def received(self) -> bytes:
        """Return the bytes that the reader has sent since the last call, without waiting."""
        with contextlib.suppress(BlockingIOError):
            return os.read(self._writer, PORT_BUFFER_BYTES)
        return b""

    def close(self) -> None:
        """Close the pseudo-terminal. For the reader, closing the port has the same effect as unplugging the cable."""
        os.close(self._writer)
        os.close(self._reader)


def posix_modules() -> tuple[Any, Any, Any]:
    """Import the modules `tty`, `fcntl` and `termios`, which handle pseudo-terminals.

    Raises:
        PortError: If the operating system has no pseudo-terminals.
    """
    try:
        tty, fcntl, termios = map(importlib.import_module, ("tty", "fcntl", "termios"))
    except ImportError as error:
        raise PortError(
            f"a virtual sensor needs a pseudo-terminal, and this system has none ({error}); run it on Linux or macOS, "
            "or on Windows in WSL"
        ) from error
    return tty, fcntl, termios


Charges = Callable[[Array], Array]
"""Forward map: function of contacts (x, y, F), shape (n, 3), mm and N. It returns charges, shape (n, n_electrode),
pC."""

Noise = Callable[..., Array]
"""Amplifier: function from charges and a random generator to measured charges, both of shape (n, electrodes), pC.

If the touch charges depend on the temperature of the film, the third argument is their change per kelvin, shape
(n, electrodes), pC/K.

The function is called block by block in the order of time, so that the output may depend on earlier charges.
"""

Encode = Callable[[Frame], bytes]
"""Frame format: function from a frame to its bytes."""

MAX_LATENESS_S = 0.05
"""Largest delay of a frame after which the next frames are sent at their times nevertheless, s.

After a larger delay, all later frames are postponed by this delay.
"""

BLOCK_S = 0.5
"""Length of the blocks that the amplifier processes, s."""

MAX_RANDOM_OFFSET_pC = 20.0
"""Largest absolute value of a random constant charge, pC."""


class Truth(NamedTuple):
    """The true press in one frame.

    Attributes:
        x_mm: Position, mm; NaN if nothing touches.
        y_mm: Position, mm; NaN if nothing touches.
        force_N: Force, N; 0 if nothing touches.
        charge_pC: Touch charges without noise and offset, shape (electrodes,), pC.
        sent_s: Time at which the frame was written, on the clock `time.perf_counter`, s.
    """

    x_mm: float
    y_mm: float
    force_N: float
    charge_pC: Array
    sent_s: float


class VirtualSensor:
    """Context manager that plays a script repeatedly while the context is active.

    Readers may open and close the port at any time. Entering the context resets the counters.

    Attributes:
        port_path: Path of the pseudo-terminal that was opened first.
        withheld: Number of frames that were discarded because they did not fit into the buffer of the port, or were not
            requested.
        lost: Number of frames that were not sent because of a fault.
        corrupted: Number of frames that were damaged by a fault.
        unplugged: Number of outages of the port that have ended.
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
        noise: Noise | None = None,
        offset_pC: Sequence[float] | None = None,
        seed: int = 0,
        encode: Encode = encode_frame,
        seq_modulus: int = SEQ_MODULUS,
        t_us_modulus: int = T_US_MODULUS,
        request: bytes | None = None,
        echo: bool = False,
        faults: Faults | None = None,
        link: Path | None = None,
    ) -> None:
        """Compute the charges of the script.

        Args:
            charges: Forward map. It is called once, for the frames in which something touches.
            script: The presses.
            noise: Amplifier; None for charges without noise.
            offset_pC: Constant charge on each electrode, pC, which the reader subtracts as its tare. By default the
                charges are drawn at random.
            seed: Seed of noise, offset and faults.
            encode: Frame format.
            seq_modulus: Value at which the frame counter wraps to 0.
            t_us_modulus: Time at which the clock of the sensor wraps to 0, us.
            request: Bytes that the reader sends for each frame. The frame that is due next after a request is sent, and
                only such frames are numbered. None for a sensor that sends all frames.
            echo: Whether the request is returned before the frame, as on a line with two wires.
            faults: Faults between the sensor and the reader; none by default.
            link: Path of a symbolic link to the port, which exists while the context is active. If the faults contain
                outages, a temporary link is created by default, because the port has another name after an outage.

        Raises:
            SceneError: If the forward map returns charges of another shape, or charges that are not finite.
        """
        self._rng = np.random.default_rng(seed)
        self._script = script
        self._noise = noise
        self._encode = encode
        self._seq_modulus = seq_modulus
        self._t_us_modulus = t_us_modulus
        self._request = request
        self._echo = echo
        self._unanswered = b""  # bytes from the reader that may contain the beginning of a request
        self._answer_count = 0
        self._faults = faults or Faults()
        self._link = link
        # Touch charges of the script, and their changes per kelvin of the film, each of shape (n, electrodes).
        self._clean_pC = _clean_charges(charges, script)
        self._clean_pC_per_K: Array | None = None
        # The script that follows the present one, with its charges and their changes per kelvin.
        self._next_script: tuple[Script, Array, Array | None] | None = None
        n_electrode = self._clean_pC.shape[1]
        random_pC = self._rng.uniform(-MAX_RANDOM_OFFSET_pC, MAX_RANDOM_OFFSET_pC, n_electrode)
        self._offset_pC = random_pC if offset_pC is None else np.asarray(offset_pC)

        self.withheld = 0
        self.lost = 0
        self.corrupted = 0
        self.unplugged = 0
        self.paused_s = 0.0
        self._frame_count = 0
        self._script_start = 0  # number of the frame with which the script began
        self._sent_s = np.full(SEQ_MODULUS, np.nan)  # time at which the latest frame with each counter was sent
        self._stop = threading.Event()
        self._writer: threading.Thread | None = None
        self._port: PseudoPort | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.port_path = ""

    @property
    def url(self) -> str:
        """Path of the port for the reader.

        Raises:
            PortError: If the context is not active.
        """
        if self._writer is None:
            raise PortError("the virtual sensor does not play; use `with VirtualSensor(...) as sensor`")
        return str(self._link or self.port_path)

    @property
    def sent(self) -> int:
        """Number of frames that were written."""
        return self._frame_count - self.withheld - self.lost

    def use(self, charges: Charges, script: Script, charges_per_K: Charges | None = None) -> None:
        """Continue with another script of the same frame rate, from its start. The amplifier keeps its state.

        The change takes effect within `BLOCK_S`.

        Args:
            charges: Forward map.
            script: The presses.
            charges_per_K: Function from contacts to the change of the touch charges per kelvin of the film, pC/K; None
                if the temperature does not change the touch charges.

        Raises:
            SceneError: If the forward map returns charges of another shape, or charges that are not finite.
        """
        clean_pC_per_K = None if charges_per_K is None else _clean_charges(charges_per_K, script)
        self._next_script = (script, _clean_charges(charges, script), clean_pC_per_K)

    def frames(self) -> Iterator[bytes]:
        """Yield the bytes of each frame without waiting for its time.

        The bytes are empty if the frame is lost by a fault.

        The frames are computed in blocks. A new script takes effect at the beginning of a block, and the last script is
        repeated without end.
        """
        self.lost = 0
        self.corrupted = 0
        self._script_start = 0
        block_size = max(1, round(BLOCK_S * self._script.rate_Hz))
        for first_number in itertools.count(step=block_size):
            if self._next_script is not None:
                self._script, self._clean_pC, self._clean_pC_per_K = self._next_script
                self._next_script = None
                self._script_start = first_number
            first_row = first_number - self._script_start
            rows = range(first_row, first_row + block_size)
            clean_pC = self._clean_pC.take(rows, axis=0, mode="wrap")  # begins again after the last row
            measured_pC = self._measured(clean_pC, rows)
            sent_pC = measured_pC + self._offset_pC
            for number, charge_pC in enumerate(sent_pC.tolist(), first_number):
                yield self._frame(number, tuple(charge_pC))

    def _measured(self, clean_pC: Array, rows: range) -> Array:
        """Return the measured charges of a block of frames, shape (n, electrodes), pC.

        Args:
            clean_pC: Touch charges of the block, shape (n, electrodes), pC.
            rows: Rows of the script, which is repeated without end.
        """
        if self._noise is None:
            return clean_pC
        if self._clean_pC_per_K is None:
            return self._noise(clean_pC, self._rng)
        return self._noise(clean_pC, self._rng, self._clean_pC_per_K.take(rows, axis=0, mode="wrap"))

    def _frame(self, number: int, charge_pC: tuple[float, ...]) -> bytes:
        """Return the bytes of a frame after the faults; empty if a fault loses the frame.

        Args:
            number: Number of the frame since the start.
            charge_pC: Charges, pC.
        """
        faults = self._faults
        is_silent = faults.is_silent(self._script_time_s(number))
        # No random number is drawn if no frames are lost, so that the noise of the seed stays the same.
        if is_silent or (faults.lose_share and self._rng.random() < faults.lose_share):
            self.lost += 1
            return b""
        device_us_per_s = 1e6 + faults.clock_ppm  # an error of 1 ppm is 1 us in a second
        t_us = round(number / self._script.rate_Hz * device_us_per_s) % self._t_us_modulus
        seq = number if self._request is None else self._answer_count
        data = self._encode(Frame(seq % self._seq_modulus, t_us, charge_pC))
        if not faults.corrupt_share:
            return data
        damaged = corrupt(data, faults.corrupt_share, self._rng)
        if damaged != data:
            self.corrupted += 1
        return damaged

    def _script_time_s(self, number: int) -> float:
        """Return the time of a frame since the start of the script, s."""
        return (number - self._script_start) / self._script.rate_Hz

    def truth(self, seq: int) -> Truth:
        """Return the true press in the latest frame with a frame counter.

        Args:
            seq: Number of the frame since the start, modulo `SEQ_MODULUS`.

        Raises:
            SceneError: If no frame with this counter has been played.
        """
        latest_number = self._frame_count - 1
        frames_since = (latest_number - seq) % SEQ_MODULUS
        number = latest_number - frames_since
        if number < 0 or not 0 <= seq < SEQ_MODULUS:
            raise SceneError(f"no frame {seq} was played; expected 0 to {min(latest_number, SEQ_MODULUS - 1)}")
        script = self._script
        row = (number - self._script_start) % len(script)
        return Truth(
            x_mm=float(script.x_mm[row]),
            y_mm=float(script.y_mm[row]),
            force_N=float(script.force_N[row]),
            charge_pC=self._clean_pC[row],
            sent_s=float(self._sent_s[seq]),
        )

    def __enter__(self) -> Self:
        """Open the port and start to play.

        Raises:
            InputError: If the link cannot be created.
        """
        self._frame_count = 0
        self.withheld = 0
        self.unplugged = 0
        self.paused_s = 0.0
        self._unanswered = b""
        self._answer_count = 0
        if self._link is None and self._faults.unplug_every_s > 0.0:
            self._folder = tempfile.TemporaryDirectory(prefix="isocharge-")
            self._link = Path(self._folder.name) / "film"
        self.port_path = self._open_port().url
        self._stop.clear()
        self._writer = threading.Thread(target=self._play, name="virtual sensor", daemon=True)
        self._writer.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop playing and close the port."""
        self._stop.set()
        if self._writer is not None:
            self._writer.join()
        self._close_port()
        self._writer = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None
            self._link = None

    def _play(self) -> None:
        """Write each frame at its time until the sensor is stopped."""
        start_s = time.perf_counter()
        for number, data in enumerate(self.frames()):
            due_s = start_s + self.paused_s + number / self._script.rate_Hz
            if self._stop.wait(max(0.0, due_s - time.perf_counter())):
                return
            lateness_s = time.perf_counter() - due_s
            if lateness_s > MAX_LATENESS_S:
                self.paused_s += lateness_s
            self._sent_s[number % SEQ_MODULUS] = time.perf_counter()
            # Count the frame before it is written, because a reader may ask for its truth as soon as it has the frame.
            self._frame_count = number + 1
            if self._faults.is_unplugged(self._script_time_s(number)):
                self._close_port()
            elif self._port is None:
                self._open_port()
                self.unplugged += 1
            is_requested = self._port is not None and self._take_request(self._port)
            if not data or self._port is None:
                continue
            if not is_requested or not self._port.write_whole(self._echo_of_request + data):
                self.withheld += 1

    @property
    def _echo_of_request(self) -> bytes:
        """The bytes that the line returns before a frame; empty if there is no echo."""
        if self._request is None or not self._echo:
            return b""
        return self._request

    def _take_request(self, port: PseudoPort) -> bool:
        """Read what the reader has sent, and return whether it contains a request since the last call.

        A sensor that sends all frames ignores what the reader sends, and the result is true.
        """
        received = port.received()  # otherwise the buffer would become full, and a reader that sends would wait forever
        if self._request is None:
            return True
        self._unanswered += received
        start = self._unanswered.rfind(self._request)
        if start < 0:
            self._unanswered = self._unanswered[-len(self._request) :]
            return False
        self._unanswered = self._unanswered[start + len(self._request) :]
        self._answer_count += 1
        return True

    def _open_port(self) -> PseudoPort:
        """Open the port, create the link, and return the port.

        Raises:
            InputError: If the link cannot be created.
        """
        port = PseudoPort()
        try:
            if self._link:
                self._link.symlink_to(port.url)
        except OSError as error:
            port.close()
            raise InputError(
                f"{self._link}: the link cannot be made ({error.strerror}); choose another path"
            ) from error
        self._port = port
        return port

    def _close_port(self) -> None:
        """Remove the link and close the port. If the port is closed already, do nothing."""
        if self._port is None:
            return
        if self._link:
            self._link.unlink(missing_ok=True)
        self._port.close()
        self._port = None


def _clean_charges(forward: Charges, script: Script) -> Array:
    """Compute the touch charges of a script, shape (n, electrodes), pC. They are zero while nothing touches.

    Args:
        forward: Forward map: charges of contacts.
        script: The presses.

    Raises:
        SceneError: If the forward map returns charges of another shape, or charges that are not finite.
    """
    is_touch = script.touching
    touch_count = int(is_touch.sum())
    contacts = np.column_stack([script.x_mm, script.y_mm, script.force_N])
    touch_pC = forward(contacts[is_touch])
    has_expected_shape = touch_pC.ndim == 2 and len(touch_pC) == touch_count
    if not has_expected_shape or not np.isfinite(touch_pC).all():
        raise SceneError(
            f"forward map: expected finite charges of shape ({touch_count}, electrodes), got shape "
            f"{touch_pC.shape} with {np.count_nonzero(~np.isfinite(touch_pC))} not finite"
        )
    charge_pC = np.zeros((len(script), touch_pC.shape[1]))
    charge_pC[is_touch] = touch_pC
    return charge_pC
