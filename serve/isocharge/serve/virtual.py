"""A virtual sensor: a pseudo-terminal that sends frames like a board, from any forward map.

The charges of the whole script are computed before it plays, so that the writer thread only packs and writes. It keeps
absolute deadlines, so the rate does not drift. It never waits for a reader: a frame that does not fit into the port's
buffer is withheld whole, and counted, and its number is missing in what the reader sees.
"""

import itertools
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from isocharge.errors import PortError, SceneError
from isocharge.serve.arrays import Array
from isocharge.serve.binary import encode_frame
from isocharge.serve.frames import SEQ_MODULUS, T_US_MODULUS, Frame
from isocharge.serve.pseudo_port import PseudoPort
from isocharge.serve.script import Script

ForwardMap = Callable[[Array, Array, Array], Array]
"""`charge_pC(x_mm, y_mm, force_N)`: arrays of shape (n,) to touch charges of shape (n, electrodes), pC."""
Noise = Callable[[Array, np.random.Generator], Array]
"""`noise(charge_pC, rng)`: charges of shape (n, electrodes), pC, to what an amplifier makes of them."""


class Truth(NamedTuple):
    """What was pressed in one frame.

    Attributes:
        x_mm, y_mm: Position, mm; not a number where nothing touches.
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

    Readers may come and go. `sent` and `withheld` count frames; both start anew with each playing.

    Example:
        >>> with VirtualSensor(charges, wander(seed=1)) as sensor:  # doctest: +SKIP
        ...     with Port(sensor.url) as port:
        ...         records = stream(port, predictor)
    """

    def __init__(
        self,
        charge_pC: ForwardMap,
        script: Script,
        *,
        noise: Noise | None = None,
        offset_pC: Sequence[float] | None = None,
        seed: int = 0,
    ) -> None:
        """Compute what will be played.

        Args:
            charge_pC: Forward map; called once, for the frames in which something touches.
            script: What is pressed.
            noise: Of the amplifier; None for clean charges.
            offset_pC: Constant charge on each electrode, pC, for the reader to tare away; by default up to 20 pC
                drawn at random.
            seed: Of noise and offset.

        Raises:
            SceneError: If the forward map gives charges of another shape, or not finite.
        """
        rng = np.random.default_rng(seed)
        self._script = script
        self._clean_pC = _clean_charges(charge_pC, script)
        electrodes = self._clean_pC.shape[1]
        offset = rng.uniform(-20.0, 20.0, electrodes) if offset_pC is None else np.asarray(offset_pC)
        played = self._clean_pC if noise is None else noise(self._clean_pC, rng)
        self._played_pC = [tuple(row) for row in (played + offset).tolist()]
        self._sent_s = np.full(SEQ_MODULUS, np.nan)
        self._stop = threading.Event()
        self._writer: threading.Thread | None = None
        self._port: PseudoPort | None = None
        self._frames = 0
        self.withheld = 0

    @property
    def url(self) -> str:
        """Path of the pseudo-terminal to read from.

        Raises:
            PortError: Outside the context.
        """
        if self._port is None:
            raise PortError("the virtual sensor does not play; use `with VirtualSensor(...) as sensor`")
        return self._port.url

    @property
    def sent(self) -> int:
        """Frames that were written."""
        return self._frames - self.withheld

    def __enter__(self) -> Self:
        """Open the port and begin to play."""
        self._port = PseudoPort()
        self._stop.clear()
        self._frames = self.withheld = 0
        self._writer = threading.Thread(target=self._play, args=(self._port,), name="virtual sensor", daemon=True)
        self._writer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop, and make the port vanish."""
        self._stop.set()
        if self._writer is not None and self._port is not None:
            self._writer.join()
            self._port.close()
        self._writer = self._port = None

    def truth(self, seq: int) -> Truth:
        """What was pressed in the latest frame with this number.

        Raises:
            SceneError: If there was none yet.
        """
        latest = self._frames - 1
        frame = latest - (latest - seq) % SEQ_MODULUS
        if frame < 0 or not 0 <= seq < SEQ_MODULUS:
            raise SceneError(f"no frame {seq} was played; expected 0 to {min(latest, SEQ_MODULUS - 1)}")
        at, script = frame % len(self._script), self._script
        x_mm, y_mm, force_N = (float(values[at]) for values in (script.x_mm, script.y_mm, script.force_N))
        return Truth(x_mm, y_mm, force_N, self._clean_pC[at], float(self._sent_s[seq]))

    def _play(self, port: PseudoPort) -> None:
        start = time.perf_counter()
        for frame in itertools.count():
            due = start + frame / self._script.rate_Hz
            if self._stop.wait(max(0.0, due - time.perf_counter())):
                return
            self._send(port, frame)

    def _send(self, port: PseudoPort, frame: int) -> None:
        seq, t_us = frame % SEQ_MODULUS, round(frame * 1e6 / self._script.rate_Hz) % T_US_MODULUS
        data = encode_frame(Frame(seq, t_us, self._played_pC[frame % len(self._script)]))
        self._sent_s[seq] = time.perf_counter()
        self._frames = frame + 1  # before writing: a quick reader asks for the truth at once
        if not port.write_whole(data):
            self.withheld += 1


def _clean_charges(charge_pC: ForwardMap, script: Script) -> Array:
    """Touch charges of a whole script, shape (n, electrodes), pC; zero where nothing touches."""
    touching = script.touching
    pressed = charge_pC(script.x_mm[touching], script.y_mm[touching], script.force_N[touching])
    if pressed.ndim != 2 or len(pressed) != touching.sum() or not np.isfinite(pressed).all():
        raise SceneError(
            f"forward map: expected finite charges of shape ({touching.sum()}, electrodes), got shape "
            f"{pressed.shape} with {np.count_nonzero(~np.isfinite(pressed))} not finite"
        )
    charges = np.zeros((len(script), pressed.shape[1]))
    charges[touching] = pressed
    return charges
