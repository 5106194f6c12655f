"""The dimensionless groups of a press, and the amplitude that makes its solution a number of order one.

Under a central force F a slack membrane, a taut one and a plate sink by

    w / a = A,   F / (E h a) ~ A^3,   (pretension / E) A,   16 pi b A   with b = (h / a)^2 / (12 (1 - poisson^2))

(Schwerin 1929; Timoshenko and Woinowsky-Krieger 1959, art. 19). Their sum is a cubic for A that holds everywhere
between. The in-plane displacement goes with A^2. What is left of the press are ratios.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.mechanics.stress import rotate_stress, stress, stress_turn
from isocharge.simulate.sensor.film import Film

MEMBRANE_STIFFNESS = 1.6
"""Force over deflection of a taut membrane, in units of pretension * thickness: 2 pi / ln(a / R), R = 0.02 a."""

PLATE_STIFFNESS = 16.0 * np.pi
"""Force over deflection of a clamped plate under a central point load, in units of its stiffness over a^2."""


@dataclass(frozen=True, eq=False)
class Anisotropy:
    """What a film has that is not the same in all directions, seen from the press.

    Attributes:
        moduli: Added to the isotropic C over E, shape (3, 3); see `mechanics.stress.stress`.
        tension: Added to the mean pretension over E A^2: (T11, T22, T12), shape (3,).
    """

    moduli: Array
    tension: Array


@dataclass(frozen=True)
class DimensionlessGroups:
    """The dimensionless groups that fix the problem; E is Young's modulus, h the thickness, a the film's radius.

    Attributes:
        amplitude2: A^2, the square of the amplitude that scales deflection by film radius.
        load: Force over E h a A^3.
        tension: Pretension over E A^2.
        bending: Bending stiffness over E h a^2 A^2, that is b / A^2; 0 leaves bending out.
        poisson: Poisson's ratio.
        anisotropy: What is not the same in all directions, if anything.
    """

    amplitude2: float
    load: float
    tension: float
    bending: float
    poisson: float
    anisotropy: Anisotropy | None = None

    @classmethod
    def of(cls, film: Film, force: float, *, bending: bool, angle: float = 0.0) -> "DimensionlessGroups":
        """The groups of a film under a force (N), with or without bending; the press lies at an angle (rad)."""
        amplitude2 = float(amplitude_squared(film, force))
        return cls(
            amplitude2=amplitude2,
            load=force / (film.young * film.thickness * film.radius * amplitude2**1.5),
            tension=film.pretension / (film.young * amplitude2),
            bending=slenderness(film) / amplitude2 if bending else 0.0,
            poisson=film.poisson,
            anisotropy=_anisotropy(film, amplitude2, angle) if film.anisotropic else None,
        )

    @property
    def height(self) -> float:
        """Approximate deflection of the middle in units of a A: one for groups from `of`."""
        linear = MEMBRANE_STIFFNESS * max(self.tension, 0.0) + PLATE_STIFFNESS * self.bending
        return float(_root(linear, self.load))

    @property
    def induced(self) -> float:
        """Approximate share of the load that the stress induced by the deflection carries: 0 linear, 1 slack."""
        return self.height**3 / self.load

    def stiffened(self, tension: float) -> "DimensionlessGroups":
        """The same press with more tension."""
        return replace(self, tension=self.tension + tension)


def scaled_stress(strained: Array, groups: DimensionlessGroups) -> Array:
    """C : E' of a scaled strain, shape (..., 3), in units of E_young A^2; see `mechanics.stress.stress`."""
    return stress(strained, groups.poisson, None if groups.anisotropy is None else groups.anisotropy.moduli)


def _anisotropy(film: Film, amplitude2: float, angle: float) -> Anisotropy:
    turn, plane = stress_turn(film.axis - angle), 1.0 / (1.0 - film.poisson**2)
    ratio = np.sqrt(film.young_ratio)
    shear = 0.0 if film.shear is None else film.shear / film.young - 0.5 / (1.0 + film.poisson)
    moduli = turn @ np.diag([plane * (ratio - 1.0), plane * (1.0 / ratio - 1.0), shear]) @ turn.T
    difference, shear = film.deviator
    tension = rotate_stress(np.array([difference, -difference, shear]), -angle) / (film.young * amplitude2)
    return Anisotropy(moduli, tension)


def slenderness(film: Film) -> float:
    """b: bending stiffness over E h a^2."""
    return (film.thickness / film.radius) ** 2 / (12.0 * (1.0 - film.poisson**2))


def amplitude_squared(film: Film, force: Array | float) -> Any:
    """A^2, of the shape and type of `force` (N)."""
    linear = MEMBRANE_STIFFNESS * max(film.pretension, 0.0) / film.young + PLATE_STIFFNESS * slenderness(film)
    return _root(linear, force / (film.young * film.thickness * film.radius)) ** 2


def _root(linear: float, right: Array | float) -> Any:
    """The real root of x^3 + linear x = right, both not negative."""
    scale = np.sqrt(linear / 3.0)
    if linear == 0.0:
        return np.cbrt(right)
    return 2.0 * scale * np.sinh(np.arcsinh(right / (2.0 * scale**3)) / 3.0)
