"""Text of the device file for a board."""

from collections.abc import Iterator

from isocharge.common.printable_text import printable
from isocharge.common.toml_text import to_toml
from isocharge.serve.examination.port_check import Examination

HEAD = (
    "Written by `isocharge serve doctor` from what came through a port; the keys are in serve/docs/device_file.md.",
)
"""First lines of the file."""

LINES_TO_FILL_IN = {
    "counts": ("# pC_per_unit = ?    # the charge of one count, pC; with a minus where the amplifier inverts",),
    "V": (
        "# V_per_unit = 1.0    # with a minus where the amplifier inverts",
        "# feedback_pF = ?     # the feedback capacitance of the amplifiers, pF",
    ),
}
"""Lines for the section `[gain]` that the user completes, by the unit of the channels."""


def device_text(examination: Examination) -> str:
    """Return the device file of a board as TOML text.

    The file begins with comments that describe the board. The section `[gain]` comes last. If the channels are not in
    pC, this section ends with comments for the conversion to pC, which the user completes.

    Args:
        examination: Result of the port check, with the content of the device file.
    """
    head_comments = (*HEAD, *_description(examination))
    other_sections = {key: value for key, value in examination.device.items() if key != "gain"}
    text = to_toml(other_sections, head_comments)

    # The section `[gain]` comes last, so that the lines to fill in belong to it.
    gain = examination.device.get("gain")
    lines_to_fill_in = LINES_TO_FILL_IN.get(examination.unit, ())  # empty if the channels are in pC
    if gain is not None:
        text += "\n" + to_toml({"gain": gain})
    elif lines_to_fill_in:
        text += "\n[gain]\n"  # the section then consists only of comments
    for line in lines_to_fill_in:
        text += f"{line}\n"
    return text


def _description(examination: Examination) -> Iterator[str]:
    """For the device file, yield comments that describe what the board sends.

    Args:
        examination: Result of the port check.
    """
    yield f"{examination.format}; {examination.rate_Hz:.4g} frames per second"
    if examination.unused:
        yield f"channels that no electrode uses: {printable(', '.join(examination.unused))}"
