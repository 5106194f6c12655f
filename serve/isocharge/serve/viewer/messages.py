"""What goes over the WebSocket: samples to the page in binary, states as JSON, and what the page asks for.

A binary message to the page, little-endian: kind (u8, 1), zero (u8), number of samples (u16), number of the message
(u32), time of sending (unix seconds, f64), records that this page has missed for good (u32), options (u32, bit 0:
forget what was shown before); then the samples, see `isocharge.serve.viewer.samples`. The page confirms what it has
drawn: the number of the message (u32), as a binary message of its own.

A request of the page is JSON, as {"do": "marker", "text": "here"}: the classes below by their names in lower case.
"""

import struct
from typing import Annotated

from msgspec import Meta, Struct

from isocharge.common.errors import RequestError
from isocharge.common.structs import WrongKey
from isocharge.serve.viewer.samples import Samples

HEADER = struct.Struct("<BBHIdII")

SAMPLES, BEGIN_ANEW = 1, 1
"""Kind of the message; option bit."""

LONGEST_MARKER = 80
"""Characters of a marker's text."""


class PageRequest(Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower):
    """What a page asks for."""


class Tare(PageRequest):
    """Take the charges at rest again."""


class Record(PageRequest):
    """Begin or end a recording."""

    on: bool


class Marker(PageRequest):
    """Note this moment."""

    text: str = ""

    def __post_init__(self) -> None:
        """Refuse what does not fit on a line."""
        if len(self.text) > LONGEST_MARKER or not self.text.isprintable():
            raise WrongKey("text", f"at most {LONGEST_MARKER} printable characters", self.text)


class Play(PageRequest):
    """Go on with the recording."""


class Pause(PageRequest):
    """Stop at this place of the recording."""


class Seek(PageRequest):
    """Go to a place of the recording, s from its start."""

    value: Annotated[float, Meta(ge=0.0, le=1e12)]


class Speed(PageRequest):
    """Play this many times as fast as it was recorded."""

    value: Annotated[float, Meta(ge=0.01, le=100.0)]


LiveRequest = Tare | Record | Marker

ReplayRequest = Play | Pause | Seek | Speed


def samples_message(number: int, sent_s: float, samples: Samples, missed: int, *, begin_anew: bool = False) -> bytes:
    """Samples for the page; at most 65535."""
    options = BEGIN_ANEW if begin_anew else 0
    header = HEADER.pack(SAMPLES, 0, len(samples), number & 0xFFFFFFFF, sent_s, missed & 0xFFFFFFFF, options)
    return header + samples.tobytes()


def confirmed_number(data: bytes) -> int:
    """The number of the message that a page has drawn.

    Raises:
        RequestError: If the data are of another length.
    """
    if len(data) != 4:
        raise RequestError(f"expected the number of a message in four bytes, got {len(data)} bytes")
    return int.from_bytes(data, "little")
