"""Messages between the server and the live page: the description of the film, binary samples, and requests.

The page reads the description before the first sample. The description contains the geometry, the electrodes, the model
and the deflection field. The geometry comes from the sensor in the metadata of the model. Parts of the film that the
sensor does not describe are not drawn. The deflection field is a file in the folder of the model. For the films of the
released models, the deflection field is a file of isocharge.

A binary message to the page is little-endian: kind (u8, 1), zero (u8), number of samples (u16), number of the message
(u32), time of sending (Unix time in seconds, f64), number of records that this page has missed (u32), options (u32, bit
0: discard what was shown before), and the samples. When the page has drawn a message, it sends a confirmation, which is
a binary message with the number (u32) of the drawn message.

A sample is a prediction record of fixed size. If contacts are tracked, a sample contains the tracked contact instead of
the contact of the frame. Several records are coalesced to one sample if there are more records than a browser can show.
A sample is little-endian: the timestamp (Unix time in seconds, f64); the numbers that the declaration of the record
marks for the live page (f32 each); the numbers of the other contact (f32 each); the flags (u32, one bit for each flag
of `isocharge.serve.flags`, and the highest bit for a contact); the number of coalesced records (u32); and the touch
charges (pC, f32 for each electrode). Zeros fill the sample up to a multiple of eight bytes. An unknown number is NaN.
The description of the film contains the offset of each number.

A request of the page is a JSON object such as {"do": "marker", "text": "here"}. The value of `do` is the name of one of
the request classes below in lower case.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, to_builtins

from isocharge.common.deflection_field import DeflectionField, read_deflection_field
from isocharge.common.errors import InputError, RequestError
from isocharge.common.printable_text import is_printable
from isocharge.common.structs import Finite, WrongKey, convert
from isocharge.serve.flags import MEANINGS
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.record.fields import Field
from isocharge.serve.record.record import RECORD_FIELDS, PredictionRecord

FLAG_BITS = {word: 1 << position for position, word in enumerate(MEANINGS)}
"""Bit of each flag in a sample."""

CONTACT_BIT = 1 << 31
"""Bit that is set if the sample is a contact."""

MAX_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest number of the type float32."""

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in the order of their times, shape (n,), with the type of a `SampleFormat`."""

OTHER_PREFIX = "other_"
"""Beginning of the names of the values of the other contact in a sample."""


def _live_numbers() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the numbers in a sample: those of the record, and those of its `other` contact.

    The timestamp is not among the names, because a sample contains it as a number of another type.
    """
    (other_field,) = (field for field in RECORD_FIELDS if field.name == "other")
    record_names = tuple(name for name in _live_names(RECORD_FIELDS) if name != "timestamp")
    other_names = _live_names(other_field.parts)
    return record_names, other_names


def _live_names(fields: Sequence[Field]) -> tuple[str, ...]:
    """Return the names of the fields that are numbers and are shown on the live page."""
    return tuple(field.name for field in fields if field.meaning.is_shown_live and field.kind == "number")


RECORD_NUMBERS, OTHER_NUMBERS = _live_numbers()
"""Names of the numbers of a record and of its other contact that a sample contains."""


class SampleFormat:
    """The layout of the samples of a sensor with these electrodes.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        dtype: A sample as a NumPy record.
    """

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Compute the layout of a sample, whose size is a multiple of 8 bytes.

        Args:
            electrodes: Names of the electrodes.
        """
        self.electrodes = electrodes
        n_electrode = len(electrodes)
        n_number = len(RECORD_NUMBERS) + len(OTHER_NUMBERS)
        # The time has 8 bytes. All numbers, the flags, the number of records and the charges have 4 bytes each.
        used_bytes = 8 + 4 * (n_number + 2 + n_electrode)
        padding = -used_bytes % 8
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
        """Return the layout for the page: the size of a sample (bytes), and the offset of each number (bytes)."""
        layout: Mapping[str, Any] = self.dtype.fields or {}  # name, and (type, offset) or (type, offset, title)
        offsets = {}
        for name, (_type, offset, *_title) in layout.items():
            if name != "padding":
                offsets[name] = offset
        return {"bytes": self.dtype.itemsize, "offsets": offsets}

    def pack(self, record: PredictionRecord) -> bytes:
        """Return a record as the bytes of a sample.

        The sample contains the tracked contact if there is one, because the page shows it. Numbers of another contact
        that also explains the charges follow. Unknown numbers become NaN, and each flag is one bit.
        """
        bits = CONTACT_BIT if record.contact else 0
        for flag in record.flags:
            bits |= FLAG_BITS[flag]

        values = []
        for name in RECORD_NUMBERS:
            value = getattr(record, name)
            if record.tracked is not None:
                value = getattr(record.tracked, name, value)  # the tracked contact does not have all numbers
            values.append(value)
        values += [None if record.other is None else getattr(record.other, name) for name in OTHER_NUMBERS]
        numbers = [math.nan if value is None else value for value in values]

        charge_by_electrode = record.charge_pC or {}
        charges = [charge_by_electrode.get(name) for name in self.electrodes]
        charge_pC = [math.nan if charge is None else charge for charge in charges]
        timestamp = math.nan if record.timestamp is None else record.timestamp
        record_count = 1  # the page may later receive several samples as a single one, which counts all records
        try:
            return self._struct.pack(timestamp, *numbers, bits, record_count, *charge_pC)
        except OverflowError:  # a number is beyond the range of float32
            return self._struct.pack(timestamp, *_clip(numbers), bits, record_count, *_clip(charge_pC))


def _clip(values: Sequence[float]) -> list[float]:
    """Return numbers that are limited to the range of float32."""
    return [min(max(value, -MAX_FLOAT32), MAX_FLOAT32) for value in values]


def coalesce(samples: Samples, max_samples: int) -> Samples:
    """Coalesce samples. Each returned sample represents a run of neighbouring samples.

    The latest sample of a run is returned. If the latest sample is not a contact, the contact of the run with the
    largest force is returned instead, so that a short tap is not lost. The returned sample has the flags of all samples
    of the run, their largest latency, and the sum of their numbers of records. One bit of the flags is set if a sample
    is a contact. This bit is taken from the returned sample alone.

    Args:
        samples: The samples, shape (n,).
        max_samples: Largest number of samples to return, at least 1.

    Returns:
        The coalesced samples, shape (max_samples,); the unchanged samples if n is at most `max_samples`.
    """
    if len(samples) <= max_samples:
        return samples
    # Start of each run, and the end of the last run
    edges = np.linspace(0, len(samples), max_samples + 1).astype(int)
    shown: Samples = samples[_shown_positions(samples, edges)]
    contact_bit = shown["flags"] & CONTACT_BIT

    # `reduceat` combines the values from each start to the next.
    starts = edges[:-1]
    run_flags = np.bitwise_or.reduceat(samples["flags"], starts) & ~np.uint32(CONTACT_BIT)
    shown["flags"] = run_flags | contact_bit
    shown["records"] = np.add.reduceat(samples["records"], starts)
    shown["latency_us"] = np.fmax.reduceat(samples["latency_us"], starts)  # ignores latencies that are NaN
    return shown


def _shown_positions(samples: Samples, edges: np.ndarray) -> np.ndarray:
    """Return the index of the sample that represents each run of neighbouring samples, shape (n_run,).

    The latest sample represents a run. If a contact has ended in the run, its sample with the largest force does.

    Args:
        samples: The samples, shape (n,).
        edges: Start of each run, and the end of the last run, shape (n_run + 1,).
    """
    is_contact = (samples["flags"] & CONTACT_BIT) != 0
    known_force_N = np.nan_to_num(samples["force_N"], nan=0.0)
    force_N = np.where(is_contact, known_force_N, -1.0)  # every contact has a larger value than no contact
    latest = edges[1:] - 1
    strongest = np.array([start + int(force_N[start:stop].argmax()) for start, stop in pairwise(edges)])
    contact_has_ended = ~is_contact[latest] & is_contact[strongest]
    return np.where(contact_has_ended, strongest, latest)


HEADER = struct.Struct("<BBHIdII")
"""Header of a binary message to the page, as the description of this module lists it."""

SAMPLES_KIND = 1
"""Kind of a binary message with samples."""

BEGIN_ANEW_OPTION = 1
"""Option bit of a message with which the page discards all earlier samples."""

MAX_MARKER_CHARACTERS = 80
"""Largest number of characters of a marker's text."""


class PageRequest(Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower):
    """Request of a page."""


class Tare(PageRequest):
    """Request to measure the tare again."""


class Back(PageRequest):
    """Request to reset the followed film to its calibration."""


class Record(PageRequest):
    """Request to begin or end a recording."""

    on: bool


class Marker(PageRequest):
    """Request to add a marker at the present time."""

    text: str = ""

    def __post_init__(self) -> None:
        if len(self.text) > MAX_MARKER_CHARACTERS or not is_printable(self.text):
            raise WrongKey("text", f"at most {MAX_MARKER_CHARACTERS} printable characters", self.text)


class Play(PageRequest):
    """Request to play the recording."""


class Pause(PageRequest):
    """Request to pause the recording."""


class Seek(PageRequest):
    """Request to go to a position in the recording, s from its start."""

    value: Annotated[float, Meta(ge=0.0, le=1e12)]


class Speed(PageRequest):
    """Request to change the speed, relative to the recorded speed."""

    value: Annotated[float, Meta(ge=0.01, le=100.0)]


LiveRequest = Tare | Back | Record | Marker
"""Request of the page of a live stream."""

ReplayRequest = Play | Pause | Seek | Speed
"""Request of the page of a recording."""


def samples_message(number: int, sent_s: float, samples: Samples, missed: int, *, begin_anew: bool = False) -> bytes:
    """Return a binary message with samples for the page.

    Args:
        number: Number of the message.
        sent_s: Unix time of sending, s.
        samples: At most 65535 samples.
        missed: Number of records that the page has missed.
        begin_anew: Whether the page discards all earlier samples.
    """
    options = BEGIN_ANEW_OPTION if begin_anew else 0
    header = HEADER.pack(SAMPLES_KIND, 0, len(samples), number & 0xFFFFFFFF, sent_s, missed & 0xFFFFFFFF, options)
    return header + samples.tobytes()


def confirmed_number(data: bytes) -> int:
    """Return the number of the message that a page confirms.

    Raises:
        RequestError: If the confirmation does not have four bytes.
    """
    if len(data) != 4:
        raise RequestError(f"expected the number of a message in four bytes, got {len(data)} bytes")
    return int.from_bytes(data, "little")


DEFLECTION_FILE = "deflection.json"
"""Name of the file with the deflection field in a version folder."""


def find_field(model: Path, metadata: ModelMetadata) -> DeflectionField | None:
    """Return the deflection field of the film for which a model was trained; None if there is none.

    The version folder of the model may contain the field. Otherwise the fields that isocharge contains for the films of
    its released models are searched for a field of this film.

    Args:
        model: Version folder.
        metadata: Metadata of the model.

    Raises:
        InputError: If the file in the version folder is damaged.
    """
    path = model / DEFLECTION_FILE
    if path.is_file():
        return read_deflection_field(path)
    film = metadata.sensor.get("film")
    with as_file(files("isocharge.serve.viewer") / "fields") as folder:
        for field_path in sorted(folder.glob("*.json")):
            field = read_deflection_field(field_path)
            if field.fits(film):
                return field
    return None


def describe_film(name: str, metadata: ModelMetadata, field: DeflectionField | None) -> dict[str, Any]:
    """Return the description of a film for the page as a JSON object.

    Args:
        name: Name of the stream.
        metadata: Metadata of the model.
        field: Deflection field of the film; None if there is none.
    """
    sensor = metadata.sensor
    film = sensor.get("film")

    # The first polygon of an electrode is its pad. The others, if there are any, are leads.
    electrode_polygons = _electrode_polygons(sensor, metadata.electrodes)
    outlines_mm = {electrode: pad for electrode, (pad, *_) in electrode_polygons.items()}
    leads_mm = {electrode: leads for electrode, (_, *leads) in electrode_polygons.items() if leads}
    description = {
        "name": name,
        "model": metadata.label,
        "sensor": metadata.frame_id,
        "electrodes": list(metadata.electrodes),
        "outlines_mm": outlines_mm,
        "radius_mm": film.get("radius_mm") if isinstance(film, dict) else None,
        "working_area_mm": [[float(x), float(y)] for x, y in metadata.working_area_mm],
        "force_range_N": list(metadata.force_range_N),
        "probes": list(metadata.probes),
        "unnoticed": to_builtins(metadata.unnoticed),
        "deflection": None if field is None else field.to_json(),
        "sample": SampleFormat(metadata.electrodes).describe(),
    }
    if leads_mm:
        description["more_mm"] = leads_mm
    return description


def _electrode_polygons(sensor: Any, electrodes: tuple[str, ...]) -> dict[str, list[list[list[float]]]]:
    """Return the polygons of each electrode on the real film, which a calibration may have rotated and shifted.

    The first polygon is the pad, and the others are further metal such as leads.

    Args:
        sensor: Description of the sensor in the metadata of the model, which may be incomplete.
        electrodes: Names of the electrodes.

    Returns:
        Polygons by electrode, each a list of corners (x, y), mm; empty if the sensor has an unknown form.
    """
    try:
        # A part is a point or a polygon for each electrode, and a number for the side of all square electrodes. The
        # number is not `Positive`, because msgspec 0.22 crashes on a union of a fixed tuple and a bounded number.
        parts = convert(sensor["electrodes"], dict[str, Point | float | _Polygon], "sensor", InputError)
        calibration = sensor.get("calibration") or {}
        return {
            name: [_calibrated_corners(polygon, calibration) for polygon in _designed_polygons(parts, name)]
            for name in electrodes
        }
    except (InputError, TypeError, ValueError, KeyError):
        return {}


Point = tuple[Finite, Finite]


class _Polygon(Struct):
    """Electrode of a sensor that is described by polygons.

    Attributes:
        polygon_mm: Corners of the pad, mm.
        more_mm: Corners of further polygons, such as leads, mm.
    """

    polygon_mm: list[Point]
    more_mm: list[list[Point]] = []


def _designed_polygons(parts: Mapping[str, Any], name: str) -> list[list[Point]]:
    """Return the polygons of an electrode in the design, each a list of corners (x, y), mm.

    An electrode without polygons is a square around a point.

    Args:
        parts: Section `electrodes` of a sensor file: a point (x, y) or a polygon for each electrode name, and the side
            of the squares under the key `side_mm`.
        name: Name of the electrode.
    """
    part = parts[name]
    if isinstance(part, _Polygon):
        return [part.polygon_mm, *part.more_mm]
    x_mm, y_mm = part
    half_side_mm = 0.5 * parts["side_mm"]
    left = x_mm - half_side_mm
    right = x_mm + half_side_mm
    bottom = y_mm - half_side_mm
    top = y_mm + half_side_mm
    return [[(left, bottom), (right, bottom), (right, top), (left, top)]]


def _calibrated_corners(corners: list[Point], calibration: Any) -> list[list[float]]:
    """Rotate corners about the centre, and then shift them. The angle and the shift are results of a calibration.

    Args:
        corners: Corners (x, y) in the design, mm.
        calibration: Section `calibration` of a sensor, with `rotation_deg` and `shift_mm`; empty for a design.
    """
    shift_x, shift_y = calibration.get("shift_mm", (0.0, 0.0))
    angle = math.radians(calibration.get("rotation_deg", 0.0))
    cosine = math.cos(angle)
    sine = math.sin(angle)
    return [[cosine * x - sine * y + shift_x, sine * x + cosine * y + shift_y] for x, y in corners]
