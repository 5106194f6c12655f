"""Deflection of a round film under a round probe, and the file that stores the deflection.

The deflection is tabulated for several forces and several distances of the probe from the centre of the film. The film
is elastically isotropic, so every press is a rotated press on the x axis. The points of the table lie on rings. A disk
automorphism maps rings around the origin to rings around the probe,

    z -> (z + c) / (1 + c z),  c = tanh((atanh(p + r) + atanh(p - r)) / 2),

where z = x + i y is a point, p is the distance of the probe from the centre and r is the radius of the probe, all in
film radii. The deflection varies smoothly over these rings. A few hundred numbers are therefore sufficient to describe
the deflection of one press. The deflection of a membrane is proportional to the cube root of the force. The deflection
is therefore divided by the cube root of the force, and the quotient is interpolated over the logarithm of the force.
The package `simulate` computes the deflection, and the live page shows it.
"""

import math
from collections.abc import Mapping
from importlib.resources import as_file, files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.structs import Finite, Positive, WrongKey, read_json

VERSION = 1
"""Version of the file format."""

DEFLECTION_FILE = "deflection.json"
"""Name of the file with the deflection field, in the folder of a dataset and in the version folder of a model."""

FILM_KEYS = ("radius_mm", "thickness_um", "young_GPa", "poisson", "pretension_MPa")
"""Properties of a film on which its deflection depends."""

N_STEPS = (1 << 16) - 1
"""Number of steps into which the largest deflection is divided, because the file stores 16-bit integers."""

MAX_NUMBERS = 1 << 18
"""Largest number of deflections in a table."""


Increasing = Annotated[tuple[Finite, ...], Meta(min_length=1)]
"""Increasing numbers; `DeflectionField` checks their order."""


class FilmField(Struct, kw_only=True):
    """Base class of the files that describe a property of one pressed film.

    Attributes:
        film: Properties of the film, with the keys `FILM_KEYS`.
        probe_radius_mm: Radius of the round probe, mm.
    """

    film: dict[str, Finite]
    probe_radius_mm: Positive

    def __post_init__(self) -> None:
        if set(self.film) != set(FILM_KEYS):  # sets, because the order of the keys does not matter
            raise WrongKey("film", f"the keys {', '.join(FILM_KEYS)}", list(self.film))

    def fits(self, film: Any) -> bool:
        """Return whether the properties of a film are equal to those of this film, except for rounding errors.

        Args:
            film: The film as a sensor file describes it. If it is not a table, or has further properties such as an
                oval clamp or a closed back, the result is False.
        """
        if not isinstance(film, Mapping) or not film.keys() <= set(FILM_KEYS):
            return False
        film_properties = {"pretension_MPa": 0.0, **film}  # the pretension is 0 if the file omits it
        return all(_is_close(film_properties.get(key), self.film[key]) for key in FILM_KEYS)


class DeflectionField(FilmField, kw_only=True):
    """Table of the deflection of one film under one probe. The attributes are the keys of the file.

    Attributes:
        force_N: Forces in increasing order, N.
        distance_mm: Distances of the probe from the centre in increasing order from 0, mm.
        rings: Radii of the rings around the origin, before the automorphism, from 0 to 1, in film radii.
        angles: Number of angles, from 0 (outwards) to pi. The other half of the film is the mirror image.
        scale_mm: Largest deflection, mm.
        deflection: Deflections in units of `scale_mm` / `N_STEPS`, as 16-bit integers.
    """

    isocharge_deflection: Annotated[int, Meta(ge=VERSION, le=VERSION, description=f"the version {VERSION}")] = VERSION
    force_N: Increasing
    distance_mm: Increasing
    rings: Increasing
    angles: Annotated[int, Meta(ge=2)]
    scale_mm: Positive
    deflection: bytes

    @classmethod
    def of(cls, film: Mapping[str, Any], deflection_mm: Array, **axes: Any) -> "DeflectionField":
        """Create the field of a film.

        Args:
            film: The film as a sensor file describes it.
            deflection_mm: Deflections, shape (forces, distances, rings, angles), mm, positive in the direction of the
                push.
            axes: The attributes `probe_radius_mm`, `force_N`, `distance_mm` and `rings`.
        """
        scale_mm = float(np.max(deflection_mm)) or 1.0  # if all deflections are 0, any positive scale is correct
        steps = np.round(np.clip(deflection_mm / scale_mm, 0.0, 1.0) * N_STEPS).astype("<u2")
        return cls(
            film={key: film[key] for key in FILM_KEYS},
            angles=deflection_mm.shape[3],
            scale_mm=scale_mm,
            deflection=steps.tobytes(),
            **axes,
        )

    def __post_init__(self) -> None:
        """Check that the values of the keys are consistent with each other.

        The forces, the distances and the rings must be in ascending
        order, without duplicates. There must be one deflection for each combination of force, distance, ring and angle.

        Raises:
            WrongKey: If the value of a key is wrong. The error names the first such key.
        """
        super().__post_init__()
        for key in ("force_N", "distance_mm", "rings"):
            numbers = getattr(self, key)
            if any(number >= next_number for number, next_number in pairwise(numbers)):
                raise WrongKey(key, "increasing numbers", list(numbers))

        expected_count = math.prod(self.shape)
        expected_bytes = 2 * expected_count  # 16-bit integers
        actual_bytes = len(self.deflection)  # decoded from base64
        if expected_count > MAX_NUMBERS or actual_bytes != expected_bytes:
            expected = f"{expected_count} integers of 2 bytes each, and at most {MAX_NUMBERS} integers"
            raise WrongKey("deflection", expected, f"{actual_bytes} bytes")

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the table: the numbers of forces, distances, rings and angles."""
        return len(self.force_N), len(self.distance_mm), len(self.rings), self.angles

    @property
    def deflection_mm(self) -> Array:
        """The deflections as an array of the shape `shape`, mm."""
        steps = np.frombuffer(self.deflection, "<u2").reshape(self.shape)
        return np.asarray(steps * (self.scale_mm / N_STEPS))


def _is_close(given: object, value: float) -> bool:
    """Return whether `given` is a number that is equal to `value`, except for rounding errors."""
    return isinstance(given, int | float) and math.isclose(given, value, rel_tol=1e-6, abs_tol=1e-12)


def read_deflection_field(path: Path) -> DeflectionField:
    """Read a deflection field from its file.

    Args:
        path: The file.

    Raises:
        InputError: If the file cannot be read, is damaged, or has an unsupported version.
    """
    return read_json(path, "a deflection field", InputError, DeflectionField)


def included_deflection_field(film: Any) -> DeflectionField | None:
    """Return the deflection field of a film that is included in isocharge, or None if there is none for this film.

    The included fields belong to the films of the released models.

    Args:
        film: The film as a sensor file describes it.
    """
    with as_file(files("isocharge.serve.viewer") / "fields") as folder:
        for field_path in sorted(folder.glob("*.json")):
            field = read_deflection_field(field_path)
            if field.fits(film):
                return field
    return None
