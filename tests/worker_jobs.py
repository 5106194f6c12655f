"""Jobs for worker processes, which start faster if they import nothing but this module."""

import os
import signal
import struct
import sys
import time
from pathlib import Path


def kill_this_process(_: bytes) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def send_half_of_a_result(began: Path) -> None:
    """Write the length of a result and its first byte to the pipe of the results, as if the rest followed."""
    frame = sys._getframe()
    while "result_queue" not in frame.f_locals:
        frame = frame.f_back
    length_and_first_byte = struct.pack("!i", 1000) + b"x"
    os.write(frame.f_locals["result_queue"]._writer.fileno(), length_and_first_byte)
    began.touch()
    time.sleep(60.0)


def waited(seconds: float) -> float:
    time.sleep(seconds)
    return seconds
