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

import math
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from isocharge.common.errors import InputError
from isocharge.common.structs import Positive, WrongKey, read_json
from isocharge.serve.viewer.deflection_field import FilmField

VERSION = 1
"""Version of the file format."""

N_AXES = 4
"""Number of axes of the coefficients: distance, force, ring and angle."""


class Table(Struct):
    """Array of coefficients of a series, shape (n_distance, n_force, n_ring, n_angle), as it is stored in the file.

    Attributes:
        shape: Shape of the array.
        data: The coefficients as little-endian float32 numbers.
    """

    shape: tuple[int, ...]
    data: bytes

    def __post_init__(self) -> None:
        if len(self.shape) != N_AXES or min(self.shape) < 1:
            raise WrongKey("shape", f"{N_AXES} numbers from 1", list(self.shape))  # "from 1" means 1 or more
        expected_bytes = 4 * math.prod(self.shape)  # four bytes for each float32 number
        if len(self.data) != expected_bytes:
            raise WrongKey("data", f"{expected_bytes} bytes in base64", len(self.data))


class StressSeries(FilmField, kw_only=True):
    """Coefficients of two series that describe the stress of one film under one probe, as keys of the file.

    Attributes:
        max_distance_mm: Largest distance of the probe from the centre, mm.
        force_range_N: Smallest and largest force, N.
        max_ring: Largest |z| for which the series is valid, in film radii.
        inner: Coefficients of the series under the probe, for the logarithm of the stress in MPa.
        outer: Coefficients of the series outside the probe.
    """

    isocharge_stress: Annotated[int, Meta(ge=VERSION, le=VERSION, description=f"the version {VERSION}")] = VERSION
    max_distance_mm: Positive
    force_range_N: tuple[Positive, Positive]
    max_ring: Positive
    inner: Table
    outer: Table


def read_stress_series(path: Path) -> StressSeries:
    """Read a stress series from its file.

    Args:
        path: The file.

    Raises:
        InputError: If the file cannot be read, is damaged, or has an unsupported version.
    """
    return read_json(path, "a stress series", InputError, StressSeries)
