"""Theories of the film, and an estimate of the error of a charge that is computed without bending.

Stretching is always geometrically nonlinear and includes the pretension. *Bending*, the resistance of the film to
bending, can be omitted. Bending is important near the rim and near the probe, and for the stress at the surfaces of the
film. The effect of bending reaches as far as the bending length sqrt(D / N), where D is the bending stiffness and N is
the tension force per length. If the pretension and the induced tension are small, the bending stiffness carries the
load.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, amplitude_squared, slenderness
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe

ACCURACY = 1e-3
"""Default target of the relative error of a charge, dimensionless."""

MAX_AMPLITUDE2 = 0.1
"""Largest squared amplitude A^2 for which Saint-Venant-Kirchhoff elasticity is valid, dimensionless.

The strains are of the order A^2.
"""

MIN_FORCE_N = 1e-12
"""Smallest force of a press, N. The dimensionless groups of a press with a far smaller force are not finite numbers."""

BENDING_WEIGHT = 1.5
"""Factor in the estimate of the relative error of a charge that is computed without bending.

The factor multiplies the ratio of the bending length to the film radius. The largest factor in the reference cases of
tests/data is 1.41.
"""

MAX_MEMBRANE_BENDING_LENGTH = 0.3
"""Bending length, in film radii, above which a membrane does not describe the film. The error is then infinite."""

INDUCED_STRAIN = 0.44
"""Radial strain at the rim of a membrane without pretension, in units of the squared amplitude A^2."""


@dataclass(frozen=True)
class Theory:
    """Terms that a theory of the film includes.

    Attributes:
        bending: Whether the film resists bending.
    """

    bending: bool

    @property
    def name(self) -> str:
        """Name of the theory in engineering terms."""
        return "nonlinear membrane + bending" if self.bending else "nonlinear membrane"


WITH_BENDING = Theory(bending=True)
"""Theory with all terms, which is the default."""


def bending_length(film: Film, force: float) -> float:
    """Compute the distance from the clamped edge over which the film is bent, in film radii.

    Args:
        film: The film.
        force: Force of the press, N.
    """
    groups = DimensionlessGroups.of(film, force, bending=True)
    tension = max(groups.tension, 0.0) + INDUCED_STRAIN * groups.height**2
    return float(np.sqrt(groups.bending / tension))


def modelling_error(film: Film, probe: Probe, force: float, theory: Theory) -> float:
    """Estimate the relative error that omitted bending causes in a charge.

    The error has two parts. The first part is proportional to the bending length at the clamp. The second part is
    proportional to the squared ratio of the bending length at the footprint to the reach R of the footprint, and is
    larger if most of the tension at the footprint is pretension. The slope w' of the film at the footprint follows from
    the vertical force 2 pi R h S w' = F and the induced stress S = E w'^2 / 2, so that w'^3 = F / (pi R h E).

    Args:
        film: The film, with Young's modulus E and thickness h.
        probe: The probe, whose footprint has the reach R.
        force: Force F of the press, N.
        theory: The theory.

    Returns:
        The error; zero with bending, and infinite for a thick film without bending.
    """
    if theory.bending:
        return 0.0
    length = bending_length(film, force)
    if length > MAX_MEMBRANE_BENDING_LENGTH:
        return np.inf
    slope = np.cbrt(force / (np.pi * probe.reach * film.thickness * film.young))
    pretension_strain = max(film.pretension, 0.0) / film.young
    strain = pretension_strain + 0.5 * slope**2
    squared_length_ratio = slenderness(film) / strain * (film.radius / probe.reach) ** 2
    probe_weight = 0.5 + 5.0 * pretension_strain / strain  # empirical, for an electrode beside the footprint
    return float(BENDING_WEIGHT * length + probe_weight * squared_length_ratio)


def check_strains(film: Film, force: float) -> None:
    """Raise an error if a force is too small to be computed, or too large for Saint-Venant-Kirchhoff elasticity.

    Args:
        film: The film.
        force: Force of the press, N.

    Raises:
        SceneError: If the force is smaller than `MIN_FORCE_N`, or if the squared amplitude exceeds `MAX_AMPLITUDE2` or
            is not finite.
    """
    if force < MIN_FORCE_N:
        raise SceneError(f"force: expected at least {MIN_FORCE_N:g} N, got {force:.4g} N")
    with np.errstate(over="ignore"):  # the amplitude of a huge force is infinite, and is refused
        squared_amplitude = amplitude_squared(film, force)
    if not squared_amplitude <= MAX_AMPLITUDE2:
        raise SceneError(
            f"force {force:.4g} N stretches a film of {film.thickness:.4g} mm beyond small strains: expected "
            f"(F / (E h a))^(2/3) up to {MAX_AMPLITUDE2:g}, got {squared_amplitude:.3g}"
        )


def theory_by_name(name: str) -> Theory:
    """Return the theory with a given name: "nonlinear membrane" or "nonlinear membrane + bending".

    Raises:
        SceneError: If no theory has this name.
    """
    theories = {theory.name: theory for theory in (Theory(bending=False), Theory(bending=True))}
    if name not in theories:
        raise SceneError(f"theory: expected one of {list(theories)}, got {name!r}")
    return theories[name]
