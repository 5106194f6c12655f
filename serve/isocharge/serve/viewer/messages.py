"""Messages between the server and the live page: the description of the film, samples and requests.

The page reads the description of the film before the first sample. The description contains the geometry of the film,
the electrodes, the model and the deflection field. The geometry is a part of the metadata of the model. If the metadata
do not describe a part of the film, the page does not draw this part. The deflection field is stored in a file in the
folder of the model. The files for the released models are included in isocharge.

Samples are sent to the page in binary messages with the following little-endian fields:

- kind of the message (u8), which is 1
- zero (u8)
- number of samples in the message (u16)
- number of the message (u32)
- time of sending (f64, Unix time in seconds)
- number of records that this page has missed (u32)
- options (u32): if bit 0 is set, the page discards everything that it has shown before
- the samples

When the page has drawn a message, it sends a confirmation. The confirmation is a binary message that contains the
number (u32) of the drawn message.

A sample is a prediction record in a binary form with a fixed size. If contacts are tracked, a sample contains the
tracked contact instead of the contact of the frame. If there are more records than a browser can show, several records
are coalesced into one sample. A sample has the following little-endian fields:

- the timestamp (f64, Unix time in seconds)
- the numbers of the record that are marked for the live page in the declaration of the record (f32 each)
- the numbers of the other contact (f32 each)
- the flags (u32), with one bit for each flag of `isocharge.serve.flags`, and the highest bit for a contact
- the number of coalesced records (u32)
- the touch charge of each electrode (f32, pC)
- zeros that fill the sample up to a multiple of eight bytes

An unknown number is sent as NaN. The description of the film contains the offset of each field in a sample.

A request of the page is a JSON object, such as {"do": "marker", "text": "here"}. Each kind of request is a class in
this module. The value of `do` is the class name in lower case.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, to_builtins

from isocharge.common.errors import InputError, RequestError
from isocharge.common.printable_text import is_printable
from isocharge.common.structs import Finite, WrongKey, convert
from isocharge.serve.flags import MEANINGS
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.record.record import RECORD_FIELDS, PredictionRecord
from isocharge.serve.viewer.deflection_field import (
    DEFLECTION_FILE,
    DeflectionField,
    included_deflection_field,
    read_deflection_field,
)

FLAG_BITS = {word: 1 << position for position, word in enumerate(MEANINGS)}
"""Bit that represents each flag in a sample."""

CONTACT_BIT = 1 << 31
"""Bit of the flags of a sample that is set if the sample contains a contact."""

MAX_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest number of the type float32."""

Samples = np.ndarray[Any, np.dtype[np.void]]
"""Samples in the order of their times, shape (n,), with the type of a `SampleFormat`."""

OTHER_PREFIX = "other_"
"""Prefix of the names of the other contact's numbers in a sample."""


RECORD_NUMBERS = tuple(
    field.name
    for field in RECORD_FIELDS
    if field.meaning.is_shown_live and field.kind == "number" and field.name != "timestamp"
)
"""Names of the numbers of the record in a sample, except the timestamp, whose type is another one."""

OTHER_NUMBERS = tuple(
    part.name for field in RECORD_FIELDS if field.name == "other" for part in field.parts if part.meaning.is_shown_live
)
"""Names of the numbers of the other contact in a sample."""


class SampleFormat:
    """Binary layout of the samples of a sensor, which depends on the number of electrodes.

    Attributes:
        electrodes: Names of the electrodes, in the order of the charges.
        dtype: NumPy type of a sample, with named fields.
    """

    def __init__(self, electrodes: tuple[str, ...]) -> None:
        """Compute the layout of a sample. The size of a sample is a multiple of 8 bytes.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
        """
        self.electrodes = electrodes
        n_electrode = len(electrodes)
        n_number = len(RECORD_NUMBERS) + len(OTHER_NUMBERS)
        # The time has 8 bytes. All numbers, the flags, the number of records and the charges have 4 bytes each.
        used_bytes = 8 + 4 * (n_number + 2 + n_electrode)
        padding = -used_bytes % 8  # bytes that are missing to the next multiple of 8
        # Little-endian: timestamp (d), numbers (f), flags (I), number of records (I), charges (f) and padding (x)
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
        """Return the size of a sample and the offset of each field, bytes, as a JSON object for the page."""
        layout: Mapping[str, Any] = self.dtype.fields or {}  # name, and (type, offset) or (type, offset, title)
        offsets = {}
        for name, (_type, offset, *_title) in layout.items():
            if name != "padding":
                offsets[name] = offset
        return {"bytes": self.dtype.itemsize, "offsets": offsets}

    def pack(self, record: PredictionRecord) -> bytes:
        """Convert a record to the bytes of a sample.

        If the record contains a tracked contact, the sample contains the tracked contact instead of the contact of the
        frame. Unknown numbers become NaN. Numbers that are too large for the type float32 are limited to its range.
        """
        flag_bits = CONTACT_BIT if record.contact else 0
        for flag in record.flags:
            flag_bits |= FLAG_BITS[flag]

        values = []
        for name in RECORD_NUMBERS:
            value = getattr(record, name)
            if record.tracked is not None:
                value = getattr(record.tracked, name, value)  # the tracked contact has only some of the numbers
            values.append(value)
        # The field `other` is another contact that explains the charges equally well, if there is one.
        values += [None if record.other is None else getattr(record.other, name) for name in OTHER_NUMBERS]
        numbers = [math.nan if value is None else value for value in values]

        charge_by_electrode = record.charge_pC or {}
        charges = [charge_by_electrode.get(name) for name in self.electrodes]
        charge_pC = [math.nan if charge is None else charge for charge in charges]
        timestamp = math.nan if record.timestamp is None else record.timestamp
        record_count = 1  # `coalesce` adds the counts of the samples that it replaces by a single sample
        try:
            return self._struct.pack(timestamp, *numbers, flag_bits, record_count, *charge_pC)
        except OverflowError:  # a number is beyond the range of float32, which is so rare that it is not checked before
            return self._struct.pack(timestamp, *_clip(numbers), flag_bits, record_count, *_clip(charge_pC))


def _clip(values: Sequence[float]) -> list[float]:
    """Limit each number to the range of the type float32, and return the results. NaN stays NaN."""
    return [min(max(value, -MAX_FLOAT32), MAX_FLOAT32) for value in values]


def coalesce(samples: Samples, max_samples: int) -> Samples:
    """Reduce the number of samples by replacing each run of neighbouring samples with one sample of the run.

    By default, the latest sample of a run is chosen. If the latest sample is not a contact, but the run contains
    contacts, the contact with the largest force is chosen instead, so that short taps are not lost. The chosen sample
    gets the flags of all samples of the run, the largest latency in the run, and the total number of records in the
    run. The bit `CONTACT_BIT` is an exception: it is taken from the chosen sample alone.

    Args:
        samples: The samples, shape (n,).
        max_samples: Largest number of samples to return, which is at least 1.

    Returns:
        The chosen samples, shape (max_samples,). If n is at most `max_samples`, the given samples are returned.
    """
    if len(samples) <= max_samples:
        return samples
    # Index of the first sample of each run, and the number of samples as the end of the last run
    run_edges = np.linspace(0, len(samples), max_samples + 1).astype(int)
    chosen: Samples = samples[_chosen_indices(samples, run_edges)]
    contact_bit = chosen["flags"] & CONTACT_BIT

    # `reduceat` combines the values of each run, from its first sample to the last sample before the next run.
    run_starts = run_edges[:-1]
    flags_of_run = np.bitwise_or.reduceat(samples["flags"], run_starts)
    flags_without_contact = flags_of_run & ~np.uint32(CONTACT_BIT)
    chosen["flags"] = flags_without_contact | contact_bit
    chosen["records"] = np.add.reduceat(samples["records"], run_starts)
    chosen["latency_us"] = np.fmax.reduceat(samples["latency_us"], run_starts)  # ignores latencies that are NaN
    return chosen


def _chosen_indices(samples: Samples, run_edges: np.ndarray) -> np.ndarray:
    """Choose one sample of each run of neighbouring samples.

    The latest sample of a run is chosen. If the latest sample is not a contact, but the run contains contacts, the
    contact with the largest force is chosen instead.

    Args:
        samples: The samples, shape (n,).
        run_edges: Index of the first sample of each run, and n as the end of the last run, shape (n_run + 1,).

    Returns:
        Index of the chosen sample of each run, shape (n_run,).
    """
    is_contact = (samples["flags"] & CONTACT_BIT) != 0
    known_force_N = np.nan_to_num(samples["force_N"], nan=0.0)
    # Samples without contact get a negative value, so that the largest value of a run is a contact if there is one.
    force_N = np.where(is_contact, known_force_N, -1.0)
    latest_indices = run_edges[1:] - 1
    strongest_indices = np.array([start + int(force_N[start:stop].argmax()) for start, stop in pairwise(run_edges)])
    has_contact_ended = ~is_contact[latest_indices] & is_contact[strongest_indices]
    return np.where(has_contact_ended, strongest_indices, latest_indices)


HEADER = struct.Struct("<BBHIdII")
"""Header of a binary message to the page. The docstring of this module lists the fields."""

SAMPLES_KIND = 1
"""Value of the field `kind` of a binary message with samples."""

BEGIN_ANEW_OPTION = 1
"""Bit of the options that is set if the page must discard all earlier samples."""

MAX_MARKER_CHARACTERS = 80
"""Largest number of characters in the text of a marker."""


class PageRequest(Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower):
    """Base class of all requests that a page can send."""


class Tare(PageRequest):
    """Request to measure the tare again."""


class Record(PageRequest):
    """Request to begin or end a recording.

    Attributes:
        on: True to begin a recording, and False to end the present recording.
    """

    on: bool


class Marker(PageRequest):
    """Request to add a marker with a text at the present time of the stream."""

    text: str = ""

    def __post_init__(self) -> None:
        if len(self.text) > MAX_MARKER_CHARACTERS or not is_printable(self.text):
            raise WrongKey("text", f"at most {MAX_MARKER_CHARACTERS} printable characters", self.text)


class Play(PageRequest):
    """Request to play the recording."""


class Pause(PageRequest):
    """Request to pause the recording."""


class Seek(PageRequest):
    """Request to go to another position in the recording.

    Attributes:
        value: Time since the start of the recording, s.
    """

    value: Annotated[float, Meta(ge=0.0, le=1e12)]


class Speed(PageRequest):
    """Request to change the speed at which the recording is played.

    Attributes:
        value: Speed relative to the speed at which the recording was made.
    """

    value: Annotated[float, Meta(ge=0.01, le=100.0)]


LiveRequest = Tare | Record | Marker
"""Requests that the page of a live stream can send."""

ReplayRequest = Play | Pause | Seek | Speed
"""Requests that the page of a recording can send."""


def samples_message(number: int, sent_s: float, samples: Samples, missed: int, *, begin_anew: bool = False) -> bytes:
    """Return a binary message that contains samples for the page.

    Args:
        number: Number of the message.
        sent_s: Unix time of sending, s.
        samples: The samples, shape (n,). At most 65535 samples are allowed.
        missed: Number of records that the page has missed.
        begin_anew: Whether the page discards all earlier samples.
    """
    options = BEGIN_ANEW_OPTION if begin_anew else 0
    number_field = number & 0xFFFFFFFF  # the fields have 32 bits, and wrap to 0
    missed_field = missed & 0xFFFFFFFF
    header = HEADER.pack(SAMPLES_KIND, 0, len(samples), number_field, sent_s, missed_field, options)
    return header + samples.tobytes()


def confirmed_number(data: bytes) -> int:
    """Return the number of the message that the page has confirmed.

    Args:
        data: The confirmation, a binary message of the page.

    Raises:
        RequestError: If the confirmation does not have four bytes.
    """
    if len(data) != 4:
        raise RequestError(f"expected the number of a message in four bytes, got {len(data)} bytes")
    return int.from_bytes(data, "little")


def find_deflection_field(version_folder: Path, metadata: ModelMetadata) -> DeflectionField | None:
    """Return the deflection field of the film for which a model was trained, or None if no such field is available.

    The deflection field describes the shape of the pressed film, which the page draws. If the version folder of the
    model contains a deflection field, the function returns this field. Otherwise, the function searches the deflection
    fields that are included in isocharge.

    Args:
        version_folder: Folder of the version of the model.
        metadata: Metadata of the model.

    Raises:
        InputError: If the file in the version folder is damaged.
    """
    path = version_folder / DEFLECTION_FILE
    if path.is_file():
        return read_deflection_field(path)
    return included_deflection_field(metadata.sensor.get("film"))


def describe_film(name: str, metadata: ModelMetadata, field: DeflectionField | None) -> dict[str, Any]:
    """Return the description of a film and its electrodes as a JSON object for the page.

    Args:
        name: Name of the stream, which the page shows.
        metadata: Metadata of the model.
        field: Deflection field of the film, or None if no deflection field is available.
    """
    sensor = metadata.sensor
    film = sensor.get("film")

    outlines_mm = {}
    leads_mm = {}
    for electrode, polygons in _electrode_polygons(sensor, metadata.electrodes).items():
        pad, *leads = polygons  # the first polygon is the pad; most electrodes have no leads
        outlines_mm[electrode] = pad
        if leads:
            leads_mm[electrode] = leads

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
        "deflection": to_builtins(field),
        "sample": SampleFormat(metadata.electrodes).describe(),
    }
    if leads_mm:
        description["more_mm"] = leads_mm
    return description


def _electrode_polygons(sensor: Any, electrodes: tuple[str, ...]) -> dict[str, list[list[list[float]]]]:
    """Return the polygons of each electrode at the place that a calibration has determined, if there is one.

    The first polygon of an electrode is its pad. All further polygons describe additional metal that belongs to the
    electrode, such as leads.

    Args:
        sensor: Description of the sensor in the metadata of the model, which may be incomplete.
        electrodes: Names of the electrodes.

    Returns:
        List of polygons by electrode name. Each polygon is a list of corners (x, y), mm. The result is empty if the
        description of the sensor has an unknown form.
    """
    try:
        # Each value is the centre of a square electrode (`Point`), the polygons of an electrode (`_Polygon`), or the
        # side of all squares (`float`). The type of the side is not `Positive`, because msgspec 0.22 crashes on a union
        # of a fixed tuple and a bounded number.
        parts = convert(sensor["electrodes"], dict[str, Point | float | _Polygon], "sensor", InputError)
        calibration = sensor.get("calibration") or {}
        return {
            name: [_calibrated_corners(polygon, calibration) for polygon in _designed_polygons(parts, name)]
            for name in electrodes
        }
    except (InputError, TypeError, ValueError, KeyError):  # the description has an unknown form
        return {}


Point = tuple[Finite, Finite]


class _Polygon(Struct):
    """Electrode that the sensor describes by polygons.

    Attributes:
        polygon_mm: Corners of the pad, mm.
        more_mm: Corners of further polygons, such as leads, mm.
    """

    polygon_mm: list[Point]
    more_mm: list[list[Point]] = []


def _designed_polygons(parts: Mapping[str, Any], name: str) -> list[list[Point]]:
    """Return the polygons of an electrode according to its design, before a calibration has corrected them.

    If the design contains only a point for the electrode, the electrode is a square around this point.

    Args:
        parts: Section `electrodes` of a sensor file: a point (x, y) or polygons for each electrode name, and the side
            of the squares under the key `side_mm`.
        name: Name of the electrode.

    Returns:
        The polygons, each of which is a list of corners (x, y), mm.
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
    """Rotate and shift the corners of a polygon by the results of a calibration.

    The corners are first rotated about the centre of the film, from the x axis towards the y axis, and then shifted.

    Args:
        corners: Corners (x, y) of the designed polygon, mm.
        calibration: Section `calibration` of the sensor, which contains `rotation_deg` and `shift_mm`. It is empty if
            the film was not calibrated.
    """
    shift_x, shift_y = calibration.get("shift_mm", (0.0, 0.0))
    angle = math.radians(calibration.get("rotation_deg", 0.0))
    cosine = math.cos(angle)
    sine = math.sin(angle)
    return [[cosine * x - sine * y + shift_x, sine * x + cosine * y + shift_y] for x, y in corners]
