"""What goes to the page and comes from it: the description of the film, samples in binary, requests.

The description is what the page has to know before the first sample: geometry, electrodes, model, deflection field. A
model carries its sensor whole, as the simulator wrote it; what is missing there is not drawn. The field lies beside the
model, or is shipped for the films of the released ones.

A binary message to the page, little-endian: kind (u8, 1), zero (u8), number of samples (u16), number of the message
(u32), time of sending (unix seconds, f64), records that this page has missed for good (u32), options (u32, bit 0:
forget what was shown before); then the samples. The page confirms what it has drawn: the number of the message (u32),
as a binary message of its own.

A sample is a prediction record of fixed size, with the tracked contact in place of the frame's where contacts are
tracked; many are coalesced to as few as a browser can show. It contains, little-endian: the timestamp (unix seconds,
f64); the numbers that the declaration of the record marks for the live page (f32 each), then those of the other
contact; the flags (u32, a bit for each word of `isocharge.serve.flags`, the highest bit for contact); the number of
records that the sample stands for (u32); and the touch charges (pC, f32 for each electrode). Zeros fill it up to a
multiple of eight bytes. An unknown number is NaN. The description of the film tells the page the offset of each number.

A request of the page is JSON, as {"do": "marker", "text": "here"}: the classes below by their names in lower case.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.deflection_field import DeflectionField, read_deflection_field
from isocharge.common.errors import InputError, RequestError
from isocharge.common.printable_text import is_printable
from isocharge.common.structs import Finite, WrongKey, convert
from isocharge.serve.flags import MEANINGS
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.record.fields import Field
from isocharge.serve.record.record import RECORD_FIELDS, PredictionRecord

FLAG_BITS = {word: 1 << position for position, word in enumerate(MEANINGS)}
"""The bit of each word."""

CONTACT_BIT = 1 << 31

LARGEST = float(np.finfo(np.float32).max)

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in their order, shape (n,), of a `SampleFormat`."""


OTHER_PREFIX = "other_"
"""Beginning of the names of the values of the other contact in a sample."""


def _live_numbers() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the numbers of a record, and of its `other` contact, that the samples contain."""

    def names(fields: Sequence[Field]) -> tuple[str, ...]:
        return tuple(field.name for field in fields if field.meaning.is_shown_live and field.kind == "number")

    (other,) = (field for field in RECORD_FIELDS if field.name == "other")
    numbers = tuple(name for name in names(RECORD_FIELDS) if name != "timestamp")
    return numbers, names(other.parts)


RECORD_NUMBERS, OTHER_NUMBERS = _live_numbers()


class SampleFormat:
    """The layout of the samples of a sensor with these electrodes.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        dtype: A sample as a NumPy record.
    """

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Compute the layout."""
        self.electrodes = electrodes
        n_electrode = len(electrodes)
        n_number = len(RECORD_NUMBERS) + len(OTHER_NUMBERS)
        padding = -(8 + 4 * (n_number + 2 + n_electrode)) % 8
        self._struct = struct.Struct(f"<d{n_number}fII{n_electrode}f{padding}x")
        names = (*RECORD_NUMBERS, *(f"{OTHER_PREFIX}{name}" for name in OTHER_NUMBERS))
        fields: list[Any] = [
            ("timestamp", "<f8"),
            *((name, "<f4") for name in names),
            ("flags", "<u4"),
            ("records", "<u4"),
            ("charge_pC", "<f4", (n_electrode,)),
        ]
        if padding:
            fields.append(("padding", f"V{padding}"))
        self.dtype = np.dtype(fields)

    def describe(self) -> dict[str, Any]:
        """Return the layout for the page: the size of a sample, and the place of each number in it, bytes."""
        offsets = {name: self.dtype.fields[name][1] for name in self.dtype.names or () if self.dtype.fields}
        offsets.pop("padding", None)
        return {"bytes": self.dtype.itemsize, "offsets": offsets}

    def pack(self, record: PredictionRecord) -> bytes:
        """Return a record as a sample."""
        bits = CONTACT_BIT if record.contact else 0
        for word in record.flags:
            bits |= FLAG_BITS[word]
        values = [getattr(record, name) for name in RECORD_NUMBERS]
        tracked = record.tracked
        if tracked is not None:
            values = [getattr(tracked, name, value) for name, value in zip(RECORD_NUMBERS, values, strict=True)]
        other = record.other
        values += [None if other is None else getattr(other, name) for name in OTHER_NUMBERS]
        numbers = [math.nan if value is None else value for value in values]
        charges = record.charge_pC or {}
        charge_pC = [math.nan if (q := charges.get(name)) is None else q for name in self.electrodes]
        timestamp = math.nan if record.timestamp is None else record.timestamp
        try:
            return self._struct.pack(timestamp, *numbers, bits, 1, *charge_pC)
        except OverflowError:  # a number that no float32 can hold
            clipped = [[min(max(value, -LARGEST), LARGEST) for value in part] for part in (numbers, charge_pC)]
            return self._struct.pack(timestamp, *clipped[0], bits, 1, *clipped[1])


def coalesce(samples: Samples, most: int) -> Samples:
    """At most `most` samples that stand for all: each for a run of neighbours.

    Of a run, the newest sample counts if it is a contact, else the hardest press: a tap between two pictures is shown.
    Flags are those of the whole run, the latency its largest, and `records` add up.

    Args:
        samples: Shape (n,).
        most: At least 1.
    """
    if len(samples) <= most:
        return samples
    edges = np.linspace(0, len(samples), most + 1).astype(int)
    shown: Samples = samples[_shown_of_runs(samples, edges)]
    starts = edges[:-1]
    contact = shown["flags"] & CONTACT_BIT
    shown["flags"] = np.bitwise_or.reduceat(samples["flags"], starts) & ~np.uint32(CONTACT_BIT) | contact
    shown["records"] = np.add.reduceat(samples["records"], starts)
    shown["latency_us"] = np.fmax.reduceat(samples["latency_us"], starts)
    return shown


def _shown_of_runs(samples: Samples, edges: np.ndarray) -> np.ndarray:
    """The position of the sample that is shown of each run, shape (runs,)."""
    touching = (samples["flags"] & CONTACT_BIT) != 0
    force = np.where(touching, np.nan_to_num(samples["force_N"], nan=0.0), -1.0)
    last = edges[1:] - 1
    hardest = np.array([start + int(force[start:stop].argmax()) for start, stop in pairwise(edges)])
    missed_tap = ~touching[last] & touching[hardest]
    return np.where(missed_tap, hardest, last)


HEADER = struct.Struct("<BBHIdII")

SAMPLES, BEGIN_ANEW = 1, 1
"""Kind of the message; option bit."""

LONGEST_MARKER = 80
"""Characters of a marker's text."""


class PageRequest(Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower):
    """What a page asks for."""


class Tare(PageRequest):
    """Take the charges at rest again."""


class Back(PageRequest):
    """Go back to the film as it was calibrated."""


class Record(PageRequest):
    """Begin or end a recording."""

    on: bool


class Marker(PageRequest):
    """Note this moment."""

    text: str = ""

    def __post_init__(self) -> None:
        """Refuse what does not fit on a line."""
        if len(self.text) > LONGEST_MARKER or not is_printable(self.text):
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


LiveRequest = Tare | Back | Record | Marker

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


FILE = "deflection.json"
"""Name of the field in a model's version folder."""


def find_field(model: Path, metadata: ModelMetadata) -> DeflectionField | None:
    """The field of the film for which a model was trained; None if there is none.

    Args:
        model: Version folder.
        metadata: Of the model.

    Raises:
        InputError: If the file in the model's folder is damaged.
    """
    if (model / FILE).is_file():
        return read_deflection_field(model / FILE)
    film = metadata.sensor.get("film")
    with as_file(files("isocharge.serve.viewer") / "fields") as folder:
        fields = map(read_deflection_field, sorted(folder.glob("*.json")))
        return next((field for field in fields if field.fits(film)), None)


def describe_film(name: str, metadata: ModelMetadata, field: DeflectionField | None) -> dict[str, Any]:
    """A film for the page, as JSON.

    Args:
        name: Of the stream, for people.
        metadata: Of the model that answers.
        field: How the film deflects; None if nobody computed it.
    """
    sensor = metadata.sensor
    film, shapes = sensor.get("film"), _shapes_mm(sensor, metadata.electrodes)
    more = {electrode: polygons[1:] for electrode, polygons in shapes.items() if polygons[1:]}
    return {
        "name": name,
        "model": metadata.label,
        "sensor": metadata.frame_id,
        "electrodes": list(metadata.electrodes),
        "outlines_mm": {electrode: polygons[0] for electrode, polygons in shapes.items()},
        "radius_mm": film.get("radius_mm") if isinstance(film, dict) else None,
        "working_area_mm": [[float(x), float(y)] for x, y in metadata.working_area_mm],
        "force_range_N": list(metadata.force_range_N),
        "probes": list(metadata.probes),
        "deflection": None if field is None else field.to_json(),
        "sample": SampleFormat(metadata.electrodes).describe(),
        **({"more_mm": more} if more else {}),
    }


def _shapes_mm(sensor: Any, electrodes: tuple[str, ...]) -> dict[str, list[list[list[float]]]]:
    """Corners of each electrode's pad and of its further metal, on the real film; none for a sensor of another form."""
    try:
        # not `Positive`: msgspec 0.22 crashes on a tuple of fixed length beside a number with bounds
        parts = convert(sensor["electrodes"], dict[str, Point | float | _Polygon], "sensor", InputError)
        calibration = sensor.get("calibration") or {}
        return {name: [_placed(polygon, calibration) for polygon in _polygons(parts, name)] for name in electrodes}
    except (InputError, TypeError, ValueError, KeyError):
        return {}


Point = tuple[Finite, Finite]


class _Polygon(Struct):
    polygon_mm: list[Point]
    more_mm: list[list[Point]] = []


def _polygons(parts: Mapping[str, Any], name: str) -> list[list[Point]]:
    if isinstance(part := parts[name], _Polygon):
        return [part.polygon_mm, *part.more_mm]
    (x, y), half = part, 0.5 * parts["side_mm"]
    return [[(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]]


def _placed(corners: list[tuple[float, float]], calibration: Any) -> list[list[float]]:
    """Corners after the calibration's turn and shift."""
    shift_x, shift_y = calibration.get("shift_mm", (0.0, 0.0))
    angle = math.radians(calibration.get("rotation_deg", 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return [[c * x - s * y + shift_x, s * x + c * y + shift_y] for x, y in corners]
