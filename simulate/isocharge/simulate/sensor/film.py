"""The film and its piezoelectric coefficients."""

import math
from dataclasses import dataclass
from typing import Literal

from isocharge.common.errors import SensorError
from isocharge.simulate.sensor.size_check import check_length, check_stress

Surface = Literal["middle", "top", "bottom"]
"""Where in the thickness the stress is read; the probe touches the top."""

LEAST_RADIUS, LEAST_THICKNESS = 1.0, 1e-4
"""Smallest radius and thickness of a film, mm: smaller numbers are in metres."""

MOST_PIEZO = 1e5
"""Largest coefficient, pC/N or pC/(mm^2 K): thirty times that of the strongest crystals."""

LEAST_PIEZO = 1e-3
"""Smallest coefficient d31, d32 or d33 other than 0, pC/N: smaller numbers are in C/N; PVDF has 1 to 30 pC/N."""

LEAST_YOUNG, MOST_YOUNG, MOST_PRETENSION = 1e-6, 1e7, 1e4
"""Bounds of Young's modulus and of the pretension of a film, MPa: larger numbers are in pascals."""


MOST_RATIO, MOST_OVAL = 10.0, 0.1
"""Largest E1 / E2 and largest e of an oval clamp: beyond, the mesh and the start of a solve are not tried."""


MOST_SLACK = 10.0
"""Largest pretension below 0, MPa: a film that is too long by 0.2 %; light presses wrinkle a slack one."""


MOST_COAT = 5.0
"""Largest stiffness of a coat over the film's: tested up to this; beyond, the coat's bending counts, too."""


@dataclass(frozen=True)
class Coat:
    """Metal or ink that stiffens parts of a film: isotropic, of the film's Poisson's ratio, without tension of its own.

    Attributes:
        stiffness: Young's modulus times thickness, N/mm.
        layers: What is coated at least once, and what twice, on both sides: convex polygons without common area,
            anticlockwise corners (x, y) on the real film, mm.
    """

    stiffness: float
    layers: tuple[tuple[tuple[tuple[float, float], ...], ...], ...]

    def __repr__(self) -> str:
        """Without the corners."""
        return f"Coat({self.stiffness:.4g} N/mm, {len(self.layers[0])} parts)"


@dataclass(frozen=True)
class Film:
    """The clamped circular film.

    Attributes:
        radius: mm.
        thickness: mm.
        young: Young's modulus, MPa.
        poisson: Poisson's ratio, 0 <= poisson < 0.5; of an orthotropic film sqrt(nu12 nu21).
        pretension: Uniform second Piola-Kirchhoff stress without load, MPa, tension positive: the mean of T11 and T22.
        deviator: (T11 - T22) / 2 and T12 of a pretension that is not the same in all directions, MPa.
        young_ratio: E1 / E2 of an orthotropic film; `young` is then sqrt(E1 E2).
        shear: Its shear modulus G12, MPa; None for young / (2 (1 + poisson)).
        axis: Angle of its axis 1 from x, rad, anticlockwise.
        oval: e of a clamp that is no circle: its half axes are radius * (1 + e) and radius * (1 - e).
        oval_axis: Angle of the longer one from x, rad.
        coat: What stiffens parts of it, if anything.
    """

    radius: float
    thickness: float
    young: float
    poisson: float
    pretension: float = 0.0
    deviator: tuple[float, float] = (0.0, 0.0)
    young_ratio: float = 1.0
    shear: float | None = None
    axis: float = 0.0
    oval: float = 0.0
    oval_axis: float = 0.0
    coat: Coat | None = None

    @property
    def anisotropic(self) -> bool:
        """Whether elasticity or pretension differ between directions."""
        return self.deviator != (0.0, 0.0) or self.young_ratio != 1.0 or self.shear is not None

    @property
    def around(self) -> dict[str, object]:
        """All that is not alike all round the film, by the names of the attributes."""
        names = ("deviator", "young_ratio", "shear", "axis", "oval", "oval_axis", "coat")
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(Film, name)}

    @property
    def turns(self) -> bool:
        """Whether the film turned about its centre is the same film: a press at (r, theta) is then one at (r, 0)."""
        return not self.anisotropic and self.oval == 0.0 and self.coat is None

    def __post_init__(self) -> None:
        check_length("film radius", self.radius, LEAST_RADIUS, SensorError)
        check_length("film thickness", self.thickness, LEAST_THICKNESS, SensorError)
        check_stress("film young", self.young, LEAST_YOUNG, MOST_YOUNG, SensorError)
        check_stress("film pretension", self.pretension, -MOST_SLACK, MOST_PRETENSION, SensorError)
        if not 0.0 <= self.poisson < 0.5:
            raise SensorError(f"film poisson: expected 0 <= poisson < 0.5, got {self.poisson}")
        stiffest = MOST_COAT * self.young * self.thickness
        if self.coat is not None and not 0.0 < self.coat.stiffness <= stiffest:
            raise SensorError(
                f"film coat: expected Young's modulus times thickness up to {MOST_COAT:g} times the film's, "
                f"{stiffest:.4g} N/mm, got {self.coat.stiffness:.4g} N/mm"
            )
        for name, value in zip(("(T11 - T22) / 2", "T12"), self.deviator, strict=True):
            check_stress(f"film pretension, {name}", value, -MOST_PRETENSION, MOST_PRETENSION, SensorError)
        if self.shear is not None:
            check_stress("film shear", self.shear, LEAST_YOUNG, MOST_YOUNG, SensorError)
        if not 1.0 / MOST_RATIO <= self.young_ratio <= MOST_RATIO:
            raise SensorError(
                f"film young: expected E1 / E2 from 1/{MOST_RATIO:g} to {MOST_RATIO:g}, got {self.young_ratio:g}"
            )
        if not abs(self.oval) <= MOST_OVAL:
            raise SensorError(f"film oval: expected a share up to {MOST_OVAL:g}, got {self.oval}")
        if not (math.isfinite(self.axis) and math.isfinite(self.oval_axis)):
            raise SensorError(f"film axis, oval_axis: expected finite angles, got {self.axis}, {self.oval_axis}")
        if self.thickness > 0.1 * self.radius:
            raise SensorError(
                f"film thickness: expected at most a tenth of the radius ({self.radius:g} mm), "
                f"got {self.thickness:.6g} mm; this is a solid, not a film"
            )


@dataclass(frozen=True)
class Piezo:
    """Piezoelectric strain coefficients in pC/N, and the pyroelectric one.

    Charge counts as positive as that of a stretch does where d31 > 0. PVDF is polarised by what it holds in its
    thickness: what thins the film raises the charge, what thickens it lowers it. So beside d31 = 20 pC/N it has
    d33 = -33 (pressure thins) and pyro = -30 (heat thickens; Kepler and Anderson 1978), whatever data sheets print
    without a sign. A film that is wired the other way round has all signs turned.

    Attributes:
        d31, d32: Charge of tension along x and y, pC/N.
        d33: Charge of tension through the thickness, pC/N.
        d12: Charge of shear, 2 d12 s12, pC/N: of turned axes (d31 - d32) / 2 times sin of twice their angle.
        pyro: Charge of warming a film that is free to expand, pC/(mm^2 K).
    """

    d31: float
    d32: float
    d33: float = 0.0
    pyro: float = 0.0
    d12: float = 0.0

    def __post_init__(self) -> None:
        for name, d in vars(self).items():
            if not abs(d) <= MOST_PIEZO:
                raise SensorError(f"piezo {name}: expected a number up to {MOST_PIEZO:g} in size, got {d}")
            if name != "pyro" and 0.0 < abs(d) < LEAST_PIEZO:
                raise SensorError(f"piezo {name}: expected pC/N, got {d:.6g} pC/N; {d:.6g} C/N are {1e12 * d:.6g} pC/N")
        if self.d31 == self.d32 == self.d12 == 0.0:
            raise SensorError("piezo d31 and d32 are both 0: such a film gives no charge")
