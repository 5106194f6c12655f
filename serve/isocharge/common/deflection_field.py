"""How a round film deflects under a round probe: a small table over force and distance from the centre, and its file.

The film is round and its elasticity isotropic, so a press beside the centre is a press on the x axis, turned. A disk
automorphism carries rings about the origin onto rings about the probe,

    z -> (z + c) / (1 + c z),  c = tanh((atanh(p + r) + atanh(p - r)) / 2),

p the distance of the probe and r its radius, in film radii. On these rings the deflection is smooth, and a few hundred
numbers hold it. Between two forces, the deflection over the cube root of the force is interpolated over the logarithm
of the force: that of a membrane is constant. simulate writes the file, serve shows what is in it.
"""

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import InputError
from isocharge.common.structs import Finite, Positive, WrongKey, read_json

VERSION = 1
"""Version of the file's format."""

FILM_KEYS = ("radius_mm", "thickness_um", "young_GPa", "poisson", "pretension_MPa")
"""What of a film decides how it deflects."""

STEPS = (1 << 16) - 1
"""Steps into which the largest deflection is divided."""

MOST_NUMBERS = 1 << 18
"""Largest table."""


@dataclass(frozen=True)
class DeflectionField:
    """Deflection of one film under one probe.

    Attributes:
        film: Values of `FILM_KEYS`.
        probe_radius_mm: Radius of the round probe, mm.
        force_N: Forces, increasing, N.
        distance_mm: Distances of the probe from the centre, increasing from 0, mm.
        rings: Radii of the rings about the probe before the automorphism, from 0 to 1, in film radii.
        deflection_mm: Shape (forces, distances, rings, angles), mm, positive in the direction of the push. The
            angles go from 0, outwards, to pi, and the other half is the mirror image.
    """

    film: Mapping[str, float]
    probe_radius_mm: float
    force_N: tuple[float, ...]
    distance_mm: tuple[float, ...]
    rings: tuple[float, ...]
    deflection_mm: Array

    def fits(self, film: Any) -> bool:
        """Whether a film, as a sensor file describes it, is the one of this field."""
        given = {"pretension_MPa": 0.0, **film} if isinstance(film, Mapping) else {}
        return all(_is_close(given.get(key), self.film[key]) for key in FILM_KEYS)

    def to_json(self) -> dict[str, Any]:
        """The content of the file."""
        scale_mm = float(np.max(self.deflection_mm)) or 1.0
        steps = np.round(np.clip(self.deflection_mm / scale_mm, 0.0, 1.0) * STEPS).astype("<u2")
        return {
            "isocharge_deflection": VERSION,
            "film": dict(self.film),
            "probe_radius_mm": self.probe_radius_mm,
            "force_N": list(self.force_N),
            "distance_mm": list(self.distance_mm),
            "rings": [round(ring, 6) for ring in self.rings],
            "angles": int(self.deflection_mm.shape[3]),
            "scale_mm": scale_mm,
            "deflection": base64.b64encode(steps.tobytes()).decode(),
        }


def _is_close(given: object, value: float) -> bool:
    """Whether a value is a number, and this one."""
    return isinstance(given, int | float) and math.isclose(given, value, rel_tol=1e-6, abs_tol=1e-12)


def points_mm(radius_mm: float, probe_radius_mm: float, distance_mm: float, rings: Array, angles: int) -> Complexes:
    """Points x + i y of a field's rings under a probe on the x axis, mm, shape (rings, angles)."""
    p, r = distance_mm / radius_mm, probe_radius_mm / radius_mm
    c = math.tanh(0.5 * (math.atanh(p + r) + math.atanh(p - r)))
    z = rings[:, None] * np.exp(1j * np.linspace(0.0, math.pi, angles))
    return np.asarray(radius_mm * (z + c) / (1.0 + c * z))


def read_deflection_field(path: Path) -> DeflectionField:
    """Read the file.

    Raises:
        InputError: If it cannot be read, or is no field of this version.
    """
    file = read_json(path, "a deflection field", InputError, _File)
    shares = np.frombuffer(file.deflection, "<u2").reshape(file.shape) / STEPS
    return DeflectionField(
        file.film,
        file.probe_radius_mm,
        file.force_N,
        file.distance_mm,
        file.rings,
        shares * file.scale_mm,
    )


Increasing = Annotated[tuple[Finite, ...], Meta(min_length=1)]


class _File(Struct):
    """The content of the file; `deflection` are shares of the largest, in base64."""

    isocharge_deflection: Annotated[int, Meta(ge=VERSION, le=VERSION, description=f"the version {VERSION}")]
    film: dict[str, Finite]
    probe_radius_mm: Positive
    force_N: Increasing
    distance_mm: Increasing
    rings: Increasing
    angles: Annotated[int, Meta(ge=2)]
    scale_mm: Positive
    deflection: bytes

    def __post_init__(self) -> None:
        if set(self.film) != set(FILM_KEYS):
            raise WrongKey("film", f"the keys {', '.join(FILM_KEYS)}", list(self.film))
        for key in ("force_N", "distance_mm", "rings"):
            if any(a >= b for a, b in pairwise(getattr(self, key))):
                raise WrongKey(key, "increasing numbers", list(getattr(self, key)))
        count = math.prod(self.shape)
        if count > MOST_NUMBERS or len(self.deflection) != 2 * count:
            expected = f"{count} numbers of 16 bits in base64, {MOST_NUMBERS} at most"
            raise WrongKey("deflection", expected, len(self.deflection))

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the numbers: forces, distances, rings, angles."""
        return len(self.force_N), len(self.distance_mm), len(self.rings), self.angles
