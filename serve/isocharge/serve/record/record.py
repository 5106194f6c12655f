"""The prediction record, which contains a reading of a sensor and the contact that a model computed from the reading.

The fields are declared only here. The layouts of JSON and CSV, the JSON Schema and the table in the documentation are
derived from the declaration. An unknown value is None in Python and `null` in JSON. For example, the position is
unknown while nothing touches the film. The device clock is unknown if the charges come from a CSV file.
"""

import json
from collections.abc import Iterable
from functools import cache
from types import UnionType
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

from msgspec import Struct, structs

from isocharge.serve.flags import MEANINGS
from isocharge.serve.model.contact import Contact

Charges = dict[str, float | None]
"""Charges by the name of the electrode, pC. A charge is None if the device sent no number for the electrode."""

JSON_TYPES: dict[Any, str] = {
    float: "number",
    int: "integer",
    bool: "boolean",
    str: "string",
    tuple[str, ...]: "array",
    Charges: "object",
}
"""JSON type of the values of each type. Any other type is a struct, which is an object in JSON."""


class Field(NamedTuple):
    """One field of a record in JSON.

    Attributes:
        name: Key in JSON.
        json_type: Type of the value in JSON. An array contains texts. An object contains numbers.
        meaning: Description of the value, a sentence.
        may_be_null: Whether the value may be null, because it is unknown.
        parts: Fields of a struct; empty for any other value, such as an object with a number for each electrode.
        section: Section of the device file that adds the field to the records; empty for a field that every record has.
    """

    name: str
    json_type: str
    meaning: str
    may_be_null: bool
    parts: tuple["Field", ...] = ()
    section: str = ""


def fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    """Return the fields of a struct in the order of their declaration.

    The annotation of each field is `Annotated` with the type and a sentence that describes the value. A second text is
    the section of the device file that adds the field, as in `Annotated[str | None, "Event that begins.", "track"]`.
    Without a second text, every record has the field. An attribute without such an annotation is not a field of the
    JSON object.
    """
    fields: list[Field] = []
    for name, annotation in get_type_hints(struct, include_extras=True).items():  # with the metadata of `Annotated`
        if get_origin(annotation) is not Annotated:
            continue
        declared_type, meaning, *section_or_nothing = get_args(annotation)  # a list of one text or of no text
        may_be_null = isinstance(declared_type, UnionType)  # a union such as `float | None`, always with None
        value_type = get_args(declared_type)[0] if may_be_null else declared_type
        # A type that is not in `JSON_TYPES` is a struct, whose fields are the parts of the JSON object.
        nested_fields = () if value_type in JSON_TYPES else fields_of(value_type)
        json_type = JSON_TYPES.get(value_type, "object")
        fields.append(Field(name, json_type, meaning, may_be_null, nested_fields, "".join(section_or_nothing)))
    return tuple(fields)


DECIMALS = 6
"""Number of decimals in JSON and CSV. The last decimal is 1 nm, 1 uN, 1 aC or 1 us, which no sensor resolves."""


class TrackedContact(Struct, frozen=True):
    """A contact that is estimated from all frames so far.

    The tracked contact has no correlations. The correlations in the record belong to the contact of the latest frame.
    """

    x_mm: Annotated[float, "Position x."]
    y_mm: Annotated[float, "Position y."]
    force_N: Annotated[float, "Force."]
    x_std_mm: Annotated[float, "Standard deviation of x."]
    y_std_mm: Annotated[float, "Standard deviation of y."]
    force_std_N: Annotated[float, "Standard deviation of the force."]
    vx_mm_s: Annotated[float, "Velocity along x; 0 while the contact is held."]
    vy_mm_s: Annotated[float, "Velocity along y; 0 while the contact is held."]
    moving: Annotated[float, "Probability that the contact moves, 0 to 1."]


class OtherContact(Struct, frozen=True):
    """A second possible contact, which has the same charges as the tracked contact.

    The charges alone do not show which of the two contacts is real.
    """

    x_mm: Annotated[float, "Position x."]
    y_mm: Annotated[float, "Position y."]
    force_N: Annotated[float, "Force."]
    probability: Annotated[float, "Probability that this contact is the one that touches."]


class FollowedFilm(Struct, frozen=True):
    """Parameters of the film that are estimated from all touches so far."""

    pretension_MPa: Annotated[float, "Pretension for which the model answered."]
    pretension_std_MPa: Annotated[float, "Standard deviation of its change since the calibration."]
    touches: Annotated[int, "Number of touches from which the pretension was estimated."]


class PredictionRecord(Struct, frozen=True, kw_only=True, dict=True):
    """One reading of a sensor and the contact that a model computed from the reading.

    The annotations of the fields describe the values. The page `serve/docs/record.md` contains a table of all fields.

    Attributes:
        sections: Sections of the device file whose stages process contacts. JSON and CSV contain `tracked`, `event` and
            `other` only if "track" is among these sections, and `film` only if "follow" is among them.
    """

    timestamp: Annotated[float | None, "Time of the reading, unix seconds."]
    t_device_us: Annotated[int | None, "Clock of the device, us, without its wraps."]
    seq: Annotated[int | None, "Sequence number, as the device sent it."]
    x_mm: Annotated[float | None, "Position x in the frame frame_id, mm; null out of contact."]
    y_mm: Annotated[float | None, "Position y, mm; null out of contact."]
    force_N: Annotated[float | None, "Force, N; 0 out of contact."]
    x_std_mm: Annotated[float | None, "Standard deviation of x, mm."]
    y_std_mm: Annotated[float | None, "Standard deviation of y, mm."]
    force_std_N: Annotated[float | None, "Standard deviation of the force, N."]
    misfit: Annotated[
        float | None, "Distance of the charges from the nearest single contact, in standard deviations of the noise."
    ]
    xy_correlation: Annotated[float | None, "Correlation of the errors of x and y, -1 to 1."]
    xF_correlation: Annotated[float | None, "Correlation of the errors of x and the force."]
    yF_correlation: Annotated[float | None, "Correlation of the errors of y and the force."]
    contact: Annotated[bool, "Whether something touches."]
    charge_pC: Annotated[Charges | None, "Touch charges by electrode, the model's input, pC."]
    charge_raw_pC: Annotated[
        Charges | None, "Readings of the board by electrode, converted to pC by `[gain]` and not processed further."
    ]
    tare_pC: Annotated[Charges | None, "Charges at rest that were subtracted, by electrode, pC."]
    flags: Annotated[tuple[str, ...], "Words that name events or reasons not to trust the contact; see the page Flags."]
    latency_us: Annotated[float | None, "Time since the program read the last byte of the frame, us."]
    model: Annotated[str, "The model, name/version."]
    frame_id: Annotated[str, "Name of the sensor, the frame of x and y."]
    tracked: Annotated[
        TrackedContact | None,
        "Contact that was estimated from all frames of the touch up to now; null out of contact.",
        "track",
    ] = None
    event: Annotated[
        str | None,
        "Event that begins with this record: press, hold, slide, tap or release; null if none begins.",
        "track",
    ] = None
    other: Annotated[
        OtherContact | None,
        "Second possible contact with the same charges, on a film with folds; null if there is none.",
        "track",
    ] = None
    film: Annotated[FollowedFilm | None, "Estimated film for which the model answered.", "follow"] = None
    sections: tuple[str, ...] = ()

    def to_json(self) -> str:
        """Return the record as one line of strictly valid JSON, in which numbers are rounded to six decimals.

        The line is computed only once. It is then stored in the `__dict__` of the record, because a record is immutable
        and has no field for the line.

        Raises:
            ValueError: If a number is not finite.
        """
        stored_line: str | None = self.__dict__.get("line")  # None at the first call
        if stored_line is not None:
            return stored_line
        values: dict[str, Any] = {}
        for field in record_fields(self.sections):
            value = getattr(self, field.name)
            if isinstance(value, float):
                value = round(value, DECIMALS)
            elif value and field.json_type == "object":  # the charges by electrode, or a struct of numbers
                numbers = value if isinstance(value, dict) else structs.asdict(value)
                value = {name: None if number is None else round(number, DECIMALS) for name, number in numbers.items()}
            values[field.name] = value
        line = _ENCODE(values)
        self.__dict__["line"] = line
        return line

    @property
    def json_values(self) -> dict[str, Any]:
        """Values of the fields by name, as JSON contains them."""
        values: dict[str, Any] = json.loads(self.to_json())
        return values


RECORD_FIELDS: tuple[Field, ...] = fields_of(PredictionRecord)
"""All fields of a record, in their order."""

UNKNOWN_CONTACT: dict[str, Any] = dict.fromkeys(Contact._fields)
"""Values of the fields of a contact if nothing was computed."""

NO_CONTACT: dict[str, Any] = UNKNOWN_CONTACT | {"force_N": 0.0}
"""Values of the fields of a contact if nothing touches the film."""


def flags_in_order(flags: Iterable[str]) -> tuple[str, ...]:
    """Return each of the flags once, in the order of `MEANINGS`. A record contains its flags in this order."""
    present = set(flags)
    return tuple(flag for flag in MEANINGS if flag in present)


@cache
def record_fields(sections: tuple[str, ...] = ()) -> tuple[Field, ...]:
    """Return the fields that every record has, and the fields that sections of the device file add.

    Args:
        sections: Names of the sections. Sections that add no field are ignored.
    """
    return tuple(field for field in RECORD_FIELDS if field.section in ("", *sections))


_ENCODE = json.JSONEncoder(allow_nan=False).encode
