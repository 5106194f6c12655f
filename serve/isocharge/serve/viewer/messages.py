"""What goes over the WebSocket: samples to the page in binary, states as JSON, and what the page asks for.

A binary message to the page, little-endian: kind (u8, 1), film (u8), number of samples (u16), number of the message
(u32), time of sending (unix seconds, f64), records that this page has missed for good (u32), options (u32, bit 0:
forget what was shown before); then the samples, see `isocharge.serve.viewer.sample`. The page confirms what it has
drawn: the number of the message (u32), as a binary message of its own.
"""

import struct
from dataclasses import dataclass
from typing import Any

from isocharge.common.errors import RequestError
from isocharge.common.tables import Table, parse_json
from isocharge.serve.viewer.coalesce import Samples

HEADER = struct.Struct("<BBHIdII")

SAMPLES, BEGIN_ANEW = 1, 1
"""Kind of the message; option bit."""

LIVE_ACTIONS = ("tare", "record", "marker")

REPLAY_ACTIONS = ("play", "pause", "seek", "speed")

LONGEST_MARKER = 80
"""Characters of a marker's text."""

SPEEDS = (0.01, 100.0)
"""Slowest and fastest replay, times the recorded pace."""


@dataclass(frozen=True)
class PageRequest:
    """What a page asks for.

    Attributes:
        action: One of the live or replay actions.
        film: Number of the film.
        is_on: Of `record`: whether to start.
        text: Of `marker`.
        value: Of `seek`, s from the start; of `speed`, times the recorded pace.
    """

    action: str
    film: int
    is_on: bool = False
    text: str = ""
    value: float = 0.0


def samples_message(
    film: int, number: int, sent_s: float, samples: Samples, missed: int, *, begin_anew: bool = False
) -> bytes:
    """Samples for the page; at most 65535."""
    options = BEGIN_ANEW if begin_anew else 0
    header = HEADER.pack(SAMPLES, film, len(samples), number & 0xFFFFFFFF, sent_s, missed & 0xFFFFFFFF, options)
    return header + samples.tobytes()


def confirmed_number(data: bytes) -> int:
    """The number of the message that a page has drawn.

    Raises:
        RequestError: If the data are of another length.
    """
    if len(data) != 4:
        raise RequestError(f"expected the number of a message in four bytes, got {len(data)} bytes")
    return int.from_bytes(data, "little")


def parse_request(text: str, actions: tuple[str, ...], films: int) -> PageRequest:
    """What a page asks for.

    Args:
        text: The message.
        actions: Those that this page has.
        films: Number of films.

    Raises:
        RequestError: If it is not a request of this form.
    """
    table = Table(parse_json(text, "", RequestError), "request", RequestError)
    table.only("do", "film", "on", "text", "value")
    action = table.choice("do", actions)
    film = table.whole("film", least=0, default=0)
    if film >= films:
        table.refuse("film", f"a number below {films}")
    return PageRequest(action, film, **_details(action, table))


def _details(action: str, table: Table) -> dict[str, Any]:
    if action == "record":
        return {"is_on": table.flag("on")}
    if action == "marker":
        text = table.text("text", default="", or_empty=True)
        if len(text) > LONGEST_MARKER or not text.isprintable():
            table.refuse("text", f"at most {LONGEST_MARKER} printable characters")
        return {"text": text}
    if action == "seek":
        return {"value": table.number("value", least=0.0, most=1e12)}
    if action == "speed":
        return {"value": table.number("value", least=SPEEDS[0], most=SPEEDS[1])}
    return {}
