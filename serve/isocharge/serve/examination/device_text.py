"""Text of the device file for a board."""

from collections.abc import Iterator

from isocharge.common.printable_text import printable
from isocharge.common.toml_text import to_toml
from isocharge.serve.examination.port_check import Examination

HEAD = (
    "Written by `isocharge serve doctor` from what came through a port; the keys are in serve/docs/device_file.md.",
)
"""First lines of the file."""


def device_text(examination: Examination) -> str:
    """Return the device file of a board as TOML text.

    The file begins with comments that describe the board.

    Args:
        examination: Result of the port check, with the content of the device file.
    """
    return to_toml(examination.device, (*HEAD, *_description(examination)))


def _description(examination: Examination) -> Iterator[str]:
    """For the device file, yield comments that describe what the board sends.

    Args:
        examination: Result of the port check.
    """
    yield f"{examination.format}; {examination.rate_Hz:.4g} frames per second"
    if examination.unused:
        yield f"channels that no electrode uses: {printable(', '.join(examination.unused))}"
