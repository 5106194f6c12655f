"""A virtual sensor: a pseudo-terminal that sends frames like a board, from any forward map.

The touch charges of the whole script are computed before it plays; the amplifier, which has a memory, processes them
block by block. Frames are written at absolute deadlines, so the rate does not drift. The writer never waits for a
reader: a frame that does not fit into the port's buffer is withheld whole and counted, and the reader sees a gap in the
frame numbers.
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


Charges = Callable[[Array], Array]
"""Contacts (x, y, F), shape (n, 3), mm and N, to touch charges, shape (n, electrodes), pC: `charges` of a ChargeMap."""

Noise = Callable[[Array, np.random.Generator], Array]
"""`noise(charge_pC, rng)`: charges to the output of an amplifier, both of shape (n, electrodes), pC.

It is called block by block in the order of time, so it may have a memory.
"""

Encode = Callable[[Frame], bytes]
"""A frame to its bytes."""

BLOCK_S = 0.5
"""Length of the blocks that the amplifier processes, s."""


class Truth(NamedTuple):
    """The press in one frame.

    Attributes:
        x_mm, y_mm: Position, mm; NaN where nothing touches.
        force_N: Force, N; 0 where nothing touches.
        charge_pC: Touch charges without noise and offset, shape (electrodes,), pC.
        sent_s: When the frame was written, on `time.perf_counter`, s.
    """

    x_mm: float
    y_mm: float
    force_N: float
    charge_pC: Array
    sent_s: float


class VirtualSensor:
    """Plays a script, over and over, from entering the context to leaving it.

    Readers may come and go. Entering the context sets the counters to 0.

    Attributes:
        port_path: Device path of the pseudo-terminal that was opened first.
        withheld: Frames that did not fit into the port, because nobody read.
        lost: Frames that a fault lost.
        corrupted: Frames that a fault damaged.
        unplugged: Times that the port vanished and came back.

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
        faults: Faults | None = None,
        link: Path | None = None,
    ) -> None:
        """Compute the charges of the script.

        Args:
            charges: Forward map; called once, for the frames in which something touches.
            script: The presses.
            noise: The amplifier; None for clean charges.
            offset_pC: Constant charge on each electrode, pC, which the reader tares away; by default drawn at random
                up to 20 pC.
            seed: Seed of noise, offset and faults.
            encode: The frame format.
            faults: By default there are no faults.
            link: Path of a symbolic link to the port while it plays. Without one, a sensor whose port vanishes makes
                its own, because the port comes back under another name.

        Raises:
            SceneError: If the forward map gives charges of another shape, or not finite.
        """
        self._rng = np.random.default_rng(seed)
        self._script, self._noise, self._encode = script, noise, encode
        self._faults, self._link = faults or Faults(), link
        self._clean_pC = _clean_charges(charges, script)
        self._next: tuple[Script, Array] | None = None
        random_pC = self._rng.uniform(-20.0, 20.0, self._clean_pC.shape[1])
        self._offset_pC = random_pC if offset_pC is None else np.asarray(offset_pC)
        self._sent_s = np.full(SEQ_MODULUS, np.nan)
        self._begin = self._frames = self.withheld = self.lost = self.corrupted = self.unplugged = 0
        self._stop = threading.Event()
        self._writer: threading.Thread | None = None
        self._port: PseudoPort | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.port_path = ""

    @property
    def url(self) -> str:
        """Path for the reader.

        Raises:
            PortError: Outside the context.
        """
        if self._writer is None:
            raise PortError("the virtual sensor does not play; use `with VirtualSensor(...) as sensor`")
        return str(self._link or self.port_path)

    @property
    def sent(self) -> int:
        """Frames that were written."""
        return self._frames - self.withheld - self.lost

    def use(self, charges: Charges, script: Script) -> None:
        """Go on with another script of the same rate, from its begin, within `BLOCK_S`; the amplifier stays as it is.

        Raises:
            SceneError: As on construction.
        """
        self._next = script, _clean_charges(charges, script)

    def frames(self) -> Iterator[bytes]:
        """The bytes of each frame from the first on, by no clock; nothing for a frame that a fault loses."""
        self.lost = self.corrupted = self._begin = 0
        block = max(1, round(BLOCK_S * self._script.rate_Hz))
        for first in itertools.count(step=block):
            if self._next is not None:
                (self._script, self._clean_pC), self._next, self._begin = self._next, None, first
            rows = range(first - self._begin, first - self._begin + block)
            clean_pC = self._clean_pC.take(rows, axis=0, mode="wrap")
            output_pC = clean_pC if self._noise is None else self._noise(clean_pC, self._rng)
            for number, row in enumerate((output_pC + self._offset_pC).tolist(), first):
                yield self._frame(number, tuple(row))

    def _frame(self, number: int, charge_pC: tuple[float, ...]) -> bytes:
        faults, t_s = self._faults, self._since_begin_s(number)
        if faults.is_silent(t_s) or (faults.lose_share and self._rng.random() < faults.lose_share):
            self.lost += 1
            return b""
        t_us = round(number / self._script.rate_Hz * (1e6 + faults.clock_ppm)) % T_US_MODULUS
        whole = self._encode(Frame(number % SEQ_MODULUS, t_us, charge_pC))
        data = corrupt(whole, faults.corrupt_share, self._rng) if faults.corrupt_share else whole
        self.corrupted += data != whole
        return data

    def _since_begin_s(self, number: int) -> float:
        """Time of a frame since the script began, s."""
        return (number - self._begin) / self._script.rate_Hz

    def truth(self, seq: int) -> Truth:
        """The press in the latest frame with this number.

        Raises:
            SceneError: If no frame had it yet.
        """
        latest = self._frames - 1
        frame = latest - (latest - seq) % SEQ_MODULUS
        if frame < 0 or not 0 <= seq < SEQ_MODULUS:
            raise SceneError(f"no frame {seq} was played; expected 0 to {min(latest, SEQ_MODULUS - 1)}")
        at, script = (frame - self._begin) % len(self._script), self._script
        x_mm, y_mm, force_N = (float(values[at]) for values in (script.x_mm, script.y_mm, script.force_N))
        return Truth(x_mm, y_mm, force_N, self._clean_pC[at], float(self._sent_s[seq]))

    def __enter__(self) -> Self:
        """Open the port and start to play.

        Raises:
            InputError: If the link cannot be made.
        """
        self._frames = self.withheld = self.unplugged = 0
        if self._link is None and self._faults.unplug_every_s > 0.0:
            self._folder = tempfile.TemporaryDirectory(prefix="isocharge-")
            self._link = Path(self._folder.name) / "film"
        self.port_path = self._plug().url
        self._stop.clear()
        self._writer = threading.Thread(target=self._play, name="virtual sensor", daemon=True)
        self._writer.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop playing and close the port."""
        self._stop.set()
        if self._writer is not None:
            self._writer.join()
        self._unplug()
        self._writer = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = self._link = None

    def _play(self) -> None:
        start = time.perf_counter()
        for number, data in enumerate(self.frames()):
            if self._stop.wait(max(0.0, start + number / self._script.rate_Hz - time.perf_counter())):
                return
            self._sent_s[number % SEQ_MODULUS] = time.perf_counter()
            self._frames = number + 1  # before writing: a quick reader may ask for the truth at once
            if self._faults.is_unplugged(self._since_begin_s(number)):
                self._unplug()
            elif self._port is None:
                self._plug()
                self.unplugged += 1
            if data and self._port is not None:
                self.withheld += not self._port.write_whole(data)

    def _plug(self) -> PseudoPort:
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

    def _unplug(self) -> None:
        if self._port is None:
            return
        if self._link:
            self._link.unlink(missing_ok=True)
        self._port.close()
        self._port = None


def _clean_charges(forward: Charges, script: Script) -> Array:
    """Touch charges of a whole script, shape (n, electrodes), pC; zero where nothing touches."""
    touching = script.touching
    pressed = forward(np.column_stack([script.x_mm, script.y_mm, script.force_N])[touching])
    if pressed.ndim != 2 or len(pressed) != touching.sum() or not np.isfinite(pressed).all():
        raise SceneError(
            f"forward map: expected finite charges of shape ({touching.sum()}, electrodes), got shape "
            f"{pressed.shape} with {np.count_nonzero(~np.isfinite(pressed))} not finite"
        )
    charges = np.zeros((len(script), pressed.shape[1]))
    charges[touching] = pressed
    return charges
