"""Text of the device file that fits a board."""

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
    pC, the section ends with comments for the conversion to pC, which the user completes.
    """
    head_comments = (*HEAD, *_description(examination))
    other_sections = {key: value for key, value in examination.device.items() if key != "gain"}
    text = to_toml(other_sections, head_comments)

    # The heading of the section is also needed if the section consists only of comments.
    gain = examination.device.get("gain")
    lines_to_fill_in = LINES_TO_FILL_IN.get(examination.unit, ())
    if gain is not None:
        text += "\n" + to_toml({"gain": gain})
    elif lines_to_fill_in:
        text += "\n[gain]\n"
    for line in lines_to_fill_in:
        text += f"{line}\n"
    return text


def _description(examination: Examination) -> Iterator[str]:
    """Yield comments that describe what the board sends."""
    yield f"{examination.format}; {examination.rate_Hz:.4g} frames per second"
    if examination.unused:
        yield f"channels that no electrode uses: {printable(', '.join(examination.unused))}"
