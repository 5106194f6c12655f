"""The prediction record: the same fields for every source and output.

A field that is unknown is None (null): a CSV file of charges has no device time, a film that nobody touches has no
position.
"""

import json
from typing import Any, NamedTuple

from isocharge.serve.prediction.contact import Contact

DECIMALS = 6
"""Decimals of numbers in JSON: 1 nm, 1 uN, 1 aC, 1 us, all far below what a sensor resolves."""

Charges = dict[str, float | None]
"""Electrode name to charge, pC; None where the device sent no number."""


class PredictionRecord(NamedTuple):
    """One reading of a sensor and the model's answer.

    Attributes:
        timestamp: Host time of the reading, unix seconds: the device's clock fitted to the arrivals; the arrival itself
            where the device sends no clock.
        t_device_us: The device's clock, us, without its wraps.
        seq: The device's sequence number, as sent.
        x_mm, y_mm: Position in the frame `frame_id`, mm; None out of contact.
        force_N: Force, N; 0 out of contact.
        x_std_mm, y_std_mm, force_std_N: Standard deviations; None out of contact.
        misfit: Distance from the nearest single contact the model knows, in standard deviations; None out of contact.
        xy_correlation, xF_correlation, yF_correlation: Correlations of position and force; None out of contact, and
            from a model that gives none.
        contact: Whether something touches.
        charge_pC: Touch charges, the model's input.
        charge_raw_pC: Charges as the device sent them, after the gain.
        tare_pC: The tare that was subtracted.
        flags: Words, see `isocharge.serve.flags`.
        latency_us: From the arrival of the reading's last byte to this record, us.
        model: `name/version`.
        frame_id: Name of the sensor.
        tracked: The contact by all frames up to now, where contacts are followed: the fields of a `Tracked`.
        event: What begins with this record: `press`, `hold`, `slide`, `tap` or `release`.
        other: Where the film folds and it is not known which contact it is, the fields of an `Other`.
        film: Where the film is followed: `pretension_MPa` for which the model answered, `pretension_std_MPa`, and how
            many `touches` have told it; without it the record is written without this field.
        follows: Whether contacts are followed; without it the record is written without `tracked`, `event`
            and `other`.
    """

    timestamp: float | None
    t_device_us: int | None
    seq: int | None
    x_mm: float | None
    y_mm: float | None
    force_N: float | None
    x_std_mm: float | None
    y_std_mm: float | None
    force_std_N: float | None
    misfit: float | None
    xy_correlation: float | None
    xF_correlation: float | None
    yF_correlation: float | None
    contact: bool
    charge_pC: Charges | None
    charge_raw_pC: Charges | None
    tare_pC: Charges | None
    flags: tuple[str, ...]
    latency_us: float | None
    model: str
    frame_id: str
    tracked: dict[str, float] | None = None
    event: str | None = None
    other: dict[str, float] | None = None
    film: dict[str, float] | None = None
    follows: bool = False

    @property
    def written(self) -> tuple[str, ...]:
        """Names of the fields that it is written with, in the order above."""
        return FIELDS + OF_TRACKING * self.follows + OF_FILM * (self.film is not None)

    def to_json(self) -> str:
        """One line of strictly valid JSON, keys in the order above, numbers to six decimals.

        Raises:
            ValueError: If a number is not finite.
        """
        values = self._asdict()
        return _ENCODE({name: _plain(values[name]) for name in self.written})


OF_TRACKING = ("tracked", "event", "other")
"""Fields that a record has where contacts are followed."""

OF_FILM = ("film",)
"""Those where the film is followed."""

FIELDS = tuple(name for name in PredictionRecord._fields if name not in (*OF_TRACKING, *OF_FILM, "follows"))

UNKNOWN: dict[str, Any] = dict.fromkeys(Contact._fields)
"""The fields of the contact where nothing was computed."""

OUT_OF_CONTACT: dict[str, Any] = UNKNOWN | {"force_N": 0.0}
"""The fields of the contact where nothing touches."""

_ENCODE = json.JSONEncoder(allow_nan=False).encode


def _plain(value: Any) -> Any:
    """A value as JSON can write it. `is` on the class is the fastest test, and this runs 20 times for each record."""
    kind = value.__class__
    if kind is float:
        return round(value, DECIMALS)
    if kind is dict:
        return {name: charge if charge is None else round(charge, DECIMALS) for name, charge in value.items()}
    return value
