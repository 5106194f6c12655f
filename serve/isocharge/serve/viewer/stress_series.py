"""Stress of a round film under a round probe as a Chebyshev series, and the file that stores the series.

The film is round and elastically isotropic, so every press is a rotated press on the x axis. A disk automorphism maps
rings around the origin to rings around the probe (see `isocharge.serve.viewer.deflection_field`). Let z be a point of
the film before the automorphism, in film radii. Let s0 be the radius of the ring that the automorphism maps to the edge
of the probe:

    s0 = tanh((atanh(p + r) - atanh(p - r)) / 2),

where p is the distance of the probe from the centre and r is the radius of the probe, both in film radii. Let s11 and
s22 be the normal stresses. The function ln(s11 + s22) is smooth under the probe, and also smooth outside the probe. One
series describes the function under the probe, and another series describes the function outside the probe:

    ln(s11 + s22) = sum c_ijkm T_i(p') T_j(l') T_k(u) T_m(cos(arg z)).

Here T are Chebyshev polynomials, p' is the distance of the probe, and l' is the logarithm of the force, both scaled to
[-1, 1]. Under the probe, the argument u is 2 (|z| / s0)^2 - 1. Outside the probe, u is a linear function of ln|z| that
is -1 at s0 and 1 at `max_ring`.

An electrode of area A on a film with d31 = d32 collects the charge d31 * A * mean(s11 + s22). The package `simulate`
writes the file, and the playground computes charges from the file.
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.structs import Finite, Positive, WrongKey, read_json
from isocharge.serve.viewer.deflection_field import is_same_film

VERSION = 1
"""Version of the file format."""

N_AXES = 4
"""Number of axes of the coefficients: distance, force, ring and angle."""


@dataclass(frozen=True)
class StressSeries:
    """Coefficients of two Chebyshev series that describe the stress of one film under one probe.

    Attributes:
        film: Properties of the film, with the keys `isocharge.serve.viewer.deflection_field.FILM_KEYS`.
        probe_radius_mm: Radius of the round probe, mm.
        max_distance_mm: Largest distance of the probe from the centre, mm.
        force_range_N: Smallest and largest force, N.
        max_ring: Largest |z| for which the series is valid, in film radii.
        inner: Coefficients of the series under the probe, shape (n_distance, n_force, n_ring, n_angle). The series
            describes the logarithm of the stress in MPa.
        outer: Coefficients of the series outside the probe, with the same axes as `inner`.
    """

    film: Mapping[str, float]
    probe_radius_mm: float
    max_distance_mm: float
    force_range_N: tuple[float, float]
    max_ring: float
    inner: Array
    outer: Array

    def fits(self, film: Any) -> bool:
        """Return whether a film has the same properties as the film of this series.

        Args:
            film: The film as a sensor file describes it. If it is not a table, the result is False.
        """
        return is_same_film(film, self.film)

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file in which the series is stored."""
        return {
            "isocharge_stress": VERSION,
            "film": dict(self.film),
            "probe_radius_mm": self.probe_radius_mm,
            "max_distance_mm": self.max_distance_mm,
            "force_range_N": list(self.force_range_N),
            "max_ring": self.max_ring,
            "inner": _to_table(self.inner),
            "outer": _to_table(self.outer),
        }


def read_stress_series(path: Path) -> StressSeries:
    """Read a stress series from its file.

    Args:
        path: The file.

    Raises:
        InputError: If the file cannot be read, is damaged, or has an unsupported version.
    """
    file = read_json(path, "a stress series", InputError, _File)
    return StressSeries(
        film=file.film,
        probe_radius_mm=file.probe_radius_mm,
        max_distance_mm=file.max_distance_mm,
        force_range_N=file.force_range_N,
        max_ring=file.max_ring,
        inner=file.inner.coefficients,
        outer=file.outer.coefficients,
    )


class _Table(Struct):
    """Array of coefficients as it is stored in the file.

    The key `data` contains the coefficients as little-endian float32 numbers, encoded in base64.
    """

    shape: tuple[int, ...]
    data: bytes

    def __post_init__(self) -> None:
        if len(self.shape) != N_AXES or min(self.shape) < 1:
            raise WrongKey("shape", f"{N_AXES} numbers from 1", list(self.shape))  # "from 1" means 1 or more
        expected_bytes = 4 * int(np.prod(self.shape))  # four bytes for each float32 number
        if len(self.data) != expected_bytes:
            raise WrongKey("data", f"{expected_bytes} bytes in base64", len(self.data))

    @property
    def coefficients(self) -> Array:
        """The coefficients as an array of float64."""
        return np.frombuffer(self.data, "<f4").reshape(self.shape).astype(float)


class _File(Struct):
    """Content of the file of a stress series."""

    isocharge_stress: int
    film: dict[str, Finite]
    probe_radius_mm: Positive
    max_distance_mm: Positive
    force_range_N: tuple[Positive, Positive]
    max_ring: Positive
    inner: _Table
    outer: _Table

    def __post_init__(self) -> None:
        if self.isocharge_stress != VERSION:
            raise WrongKey("isocharge_stress", f"the version {VERSION}", self.isocharge_stress)


def _to_table(coefficients: Array) -> dict[str, Any]:
    """Convert an array of coefficients to the form in which the file stores them; see `_Table`."""
    data = coefficients.astype("<f4").tobytes()
    return {"shape": list(coefficients.shape), "data": base64.b64encode(data).decode()}
