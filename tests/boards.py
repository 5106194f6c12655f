"""Simulated board for tests. It sends over TCP and waits for its reader, so no frame is lost on a busy machine."""

import signal
import socket
import threading
import time
from contextlib import suppress

import numpy as np

from isocharge.serve import Chunk, Frame, encode_frame
from isocharge.serve.examination.listening import ReceivedData

BATCH = 20
"""Frames that are sent at once."""


def encoded_frames(rows, rate_Hz=200.0):
    """Yield the bytes of each frame of a board that sends rows of charges, pC, at a rate."""
    for number, row in enumerate(rows):
        yield encode_frame(Frame(number % 65536, round(1e6 * number / rate_Hz), tuple(row)))


def received(data, rate_Hz, start_s=1.7e9):
    """What a program receives at a port from a board that sends pieces of data at a rate."""
    chunks = [Chunk(piece, start_s + number / rate_Hz, 0) for number, piece in enumerate(data)]
    return ReceivedData("/dev/ttyACM0", 115200, chunks=chunks, seconds=len(chunks) / rate_Hz)


class TcpBoard:
    """Sends rows of charges, pC, as frames to whoever connects; a context manager.

    The rows may come from a generator, which then runs beside the reader: what it does between two rows happens between
    two frames. An error in it stops the command that reads, and the test.

    Attributes:
        url: Of the port.
    """

    def __init__(self, rows, rate_Hz=2000.0):
        self._rows, self._rate_Hz = iter(rows), rate_Hz
        self._stop, self._error = threading.Event(), None
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._play, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join(10)
        if self._error is not None:
            raise self._error

    def _play(self):
        try:
            connection, _ = self._server.accept()
            connection.settimeout(30)
            with connection:
                self._send(connection)
        except ConnectionError:  # the reader has gone
            pass
        except Exception as error:
            if not self._stop.is_set():
                self._error = error
                interrupt()

    def _send(self, connection):
        waiting = []
        for data in encoded_frames(self._rows, self._rate_Hz):
            waiting.append(data)
            if len(waiting) == BATCH:
                connection.sendall(b"".join(waiting))
                waiting.clear()
                if self._stop.wait(BATCH / self._rate_Hz):
                    return
        connection.sendall(b"".join(waiting))


def taps(film, at=(3.0, -2.0), force_N=1.0, rest=300, press=200):
    """Rows without end: a rest that is long enough for a tare, a press, and so on; noise of 0.1 pC."""
    rng, pressed = np.random.default_rng(2), film.charge_pC([at[0]], [at[1]], [force_N])[0]
    while True:
        for number in range(rest + press):
            yield (rng.normal(0.0, 0.1, 3) + (pressed if number >= rest else 0.0)).tolist()


def until(rows, is_true, seconds=60.0):
    """Rows until something is true."""
    end = time.monotonic() + seconds
    while not is_true():
        assert time.monotonic() < end, "what the board waits for did not happen"
        yield next(rows)


def interrupt(number=signal.SIGINT):
    """A signal to this process, as Ctrl-C to the command that it runs."""
    signal.pthread_kill(threading.main_thread().ident, number)
