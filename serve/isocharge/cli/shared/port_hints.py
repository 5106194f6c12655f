"""Hints for a port whose bytes contain no frames of a known format."""

import shlex
from pathlib import Path

from isocharge.serve.port.file_source import STDIN


def no_frames_hint(port: str, device: Path | None) -> str:
    """Return advice for a port whose bytes contain no frames of a known format.

    Args:
        port: Value of `--port`.
        device: Value of `--device`; None if the option is not given.
    """
    if port == STDIN or Path(port).is_file():  # the command `isocharge serve doctor` below can only listen on a port
        return "describe the board in a device file (--device)"
    # Beginning of the sentence, which is empty without a device file
    wrong_device = f"{device} may describe another board; " if device is not None else ""
    command = f"isocharge serve doctor --port {shlex.quote(port)} --write board.toml"
    return f"{wrong_device}to find out what the board sends: {command}"
