"""Boards that are not ours: a film, an amplifier, a converter, and bytes packed by hand on a line of their own.

A board plays a film at rest, with offset and noise, until it is told to press. Its frames are built by struct, json,
cobs and crcmod, never by the encoders of isocharge.
"""

import os
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from isocharge.serve.virtual_sensor.pseudo_port import PseudoPort

RATE_HZ = 400.0
STEP_S = 0.01
"""Time between two packets of frames, s."""


@dataclass
class Board:
    """A board.

    Attributes:
        encode: Frame number and charges (electrodes,), pC, to bytes.
        press_pC: Charges of the press, shape (electrodes,), pC.
        line: "pty", "udp" or "tcp"; "asked" answers on a pseudo-terminal that brings back what is sent to it.
        request: What it is asked.
        noise_pC: Standard deviation of each charge, pC.
    """

    encode: Callable[[int, np.ndarray], bytes]
    press_pC: np.ndarray
    line: str = "pty"
    request: bytes = b""
    noise_pC: float = 0.3
    url: str = ""
    pressed_from: float = float("inf")
    frames: int = 0
    stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self):
        self.rng = np.random.default_rng(len(self.press_pC))
        self.rest_pC = self.rng.uniform(-8.0, 8.0, len(self.press_pC))

    def press_in(self, seconds):
        """Press in a while, and hold."""
        self.pressed_from = time.monotonic() + seconds

    def next_frame(self):
        """The bytes of the next frame."""
        charge_pC = self.rest_pC + self.rng.normal(0.0, self.noise_pC, len(self.press_pC))
        charge_pC += self.press_pC * (time.monotonic() >= self.pressed_from)
        self.frames += 1
        return self.encode(self.frames - 1, charge_pC)

    def due(self, began):
        """The frames that are due since the last time."""
        while self.frames < (time.monotonic() - began) * RATE_HZ:
            yield self.next_frame()

    def run_pty(self, ready):
        port = PseudoPort()
        self.url = port.url
        ready.set()
        began = time.monotonic()
        while not self.stop.wait(STEP_S):
            for frame in self.due(began):
                port.write_whole(frame)
        port.close()

    def run_asked(self, ready):
        """Two wires: what the host writes comes back to it, and then the answer."""
        writer, reader = os.openpty()
        import tty

        tty.setraw(reader)
        self.url = os.ttyname(reader)
        ready.set()
        asked = b""
        while not self.stop.is_set():
            if not select.select([writer], [], [], STEP_S)[0]:
                continue
            data = os.read(writer, 100)
            os.write(writer, data)
            asked = (asked + data)[-100:]
            if asked.endswith(self.request):
                asked = b""
                time.sleep(0.0005)
                os.write(writer, self.next_frame())
        os.close(writer)
        os.close(reader)

    def run_udp(self, ready):
        """Several frames in a datagram, one or more."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            address = probe.getsockname()
        self.url = f"udp://127.0.0.1:{address[1]}"
        ready.set()
        began = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self.stop.wait(STEP_S):
                frames = list(self.due(began))
                for at in range(0, len(frames), 3):
                    sender.sendto(b"".join(frames[at : at + 3]), address)

    def run_tcp(self, ready):
        with socket.create_server(("127.0.0.1", 0)) as server:
            server.settimeout(STEP_S)
            self.url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
            ready.set()
            client, began = None, time.monotonic()
            while not self.stop.wait(STEP_S):
                data = b"".join(self.due(began))
                try:
                    client = client or server.accept()[0]
                    client.sendall(data)
                except TimeoutError:
                    continue
                except OSError:
                    client.close()
                    client = None
            if client:
                client.close()


@pytest.fixture
def plug_in():
    """Plug in a board: it sends until the test ends."""
    running = []

    def plug(board):
        ready = threading.Event()
        thread = threading.Thread(target=getattr(board, f"run_{board.line}"), args=(ready,), daemon=True)
        thread.start()
        assert ready.wait(5.0)
        running.append((board, thread))
        return board

    yield plug
    for board, thread in running:
        board.stop.set()
        thread.join(5.0)
        assert not thread.is_alive()


@pytest.fixture
def board():
    """Make a board."""
    return Board
