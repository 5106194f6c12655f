"""The text of a proposed device file, with a word on what the user has to fill in."""

from collections.abc import Iterator

from isocharge.common.toml_text import to_toml
from isocharge.serve.examination.port_check import Examination

HEAD = (
    "Written by `isocharge serve doctor` from what came through a port; the keys are in serve/docs/device_file.md.",
)

TO_FILL_IN = {
    "counts": ("# pC_per_unit = ?    # the charge of one count, pC; with a minus where the amplifier inverts",),
    "V": (
        "# V_per_unit = 1.0    # with a minus where the amplifier inverts",
        "# feedback_pF = ?     # the feedback capacitance of the amplifiers, pF",
    ),
}
"""Lines for the section `[gain]` by the unit of the channels."""


def device_text(examination: Examination) -> str:
    """The content of a device file, TOML; what is not known of the gain is a comment to fill in."""
    table = {key: value for key, value in examination.device.items() if key != "gain"}
    text = to_toml(table, (*HEAD, *_words(examination)))
    gain = examination.device.get("gain")
    lines = TO_FILL_IN.get(examination.unit, ())
    if gain is not None:
        text += "\n" + to_toml({"gain": gain})
    elif lines:
        text += "\n[gain]\n"
    return text + "".join(f"{line}\n" for line in lines)


def _words(examination: Examination) -> Iterator[str]:
    yield f"{examination.format}; {examination.rate_Hz:.4g} frames per second"
    if examination.unused:
        yield f"channels that no electrode uses: {', '.join(examination.unused)}"
