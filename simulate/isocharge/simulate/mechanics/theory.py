"""Choice of the theory of the film, and estimates of the errors that the omitted terms of a theory cause.

Stretching is always geometrically nonlinear and includes the pretension. *Bending*, the resistance of the film to
bending, is optional. Bending is important near the rim and near the probe, and for the stress at the surfaces of the
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
from isocharge.simulate.sensor.sensor import Sensor

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

PROBE_WEIGHT = 4.0
"""Factor in the estimate of the relative error of a charge that is computed without bending.

The factor multiplies the squared ratio of the bending length at the probe to the reach of the probe, and the share of
the pretension in the tension at the probe.
"""

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


def bending_length(film: Film, force: float) -> float:
    """Compute the distance from the clamped edge over which the film is bent, in film radii.

    Args:
        film: The film.
        force: Force of the press, N.
    """
    groups = DimensionlessGroups.of(film, force, bending=True)
    tension = max(groups.tension, 0.0) + INDUCED_STRAIN * groups.height**2
    return float(np.sqrt(groups.bending / tension))


def bending_at_probe(film: Film, probe: Probe, force: float) -> float:
    """Estimate by how much the bending of the film at the footprint changes a charge, relative to the charge.

    The tension at the footprint is the sum of the pretension and the induced stress S. The estimated change is
    proportional to two factors: the squared ratio of the bending length to the reach R of the footprint, and the share
    of the pretension in the tension. The induced stress is estimated for a membrane without pretension. If w' is the
    slope of the membrane at the footprint, the stress is S = E w'^2 / 2. The vertical force at the footprint is 2 pi R
    h S w' = F. The equations for the stress and for the force result in w'^3 = F / (pi R h E). If the induced stress is
    much larger than the pretension, bending hardly changes the charges.

    Args:
        film: The film, with Young's modulus E and thickness h.
        probe: The probe, whose footprint has the reach R.
        force: Force F, N.

    Returns:
        Relative change, dimensionless.
    """
    slope = np.cbrt(force / (np.pi * probe.reach * film.thickness * film.young))  # w'
    induced_strain = 0.5 * slope**2
    pretension_strain = film.pretension / film.young
    total_strain = pretension_strain + induced_strain

    # The squared bending length is the bending stiffness over the tension force per length. In squared film radii, it
    # is the slenderness over the total strain.
    squared_length_ratio = slenderness(film) / total_strain * (film.radius / probe.reach) ** 2
    pretension_share = pretension_strain / total_strain
    return PROBE_WEIGHT * float(squared_length_ratio * pretension_share)


def modelling_error(film: Film, probe: Probe, force: float, theory: Theory) -> float:
    """Estimate the relative error that omitted bending causes in a charge.

    Args:
        film: The film.
        probe: The probe.
        force: Force of the press, N.
        theory: The theory.

    Returns:
        The error; zero with bending, and infinite for a thick film without bending.
    """
    if theory.bending:
        return 0.0
    length = bending_length(film, force)
    if length > MAX_MEMBRANE_BENDING_LENGTH:  # the film is too thick for a membrane
        return np.inf
    return BENDING_WEIGHT * length + bending_at_probe(film, probe, force)


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


def choose_theory(film: Film, probe: Probe, force: float, accuracy: float) -> Theory:
    """Return the theory without bending if it is sufficiently accurate, or else the theory with bending.

    The estimated error of the theory must not exceed half of the required accuracy. The other half is for the mesh.

    Args:
        film: The film.
        probe: The probe.
        force: Force of the press, N.
        accuracy: Largest allowed relative error of a charge.

    Raises:
        SceneError: If the strains are too large for Saint-Venant-Kirchhoff elasticity.
    """
    check_strains(film, force)
    error_estimate_is_valid = film.pretension >= 0.0 and film.is_axisymmetric
    membrane = Theory(bending=False)
    if error_estimate_is_valid and modelling_error(film, probe, force, membrane) <= 0.5 * accuracy:
        return membrane
    return Theory(bending=True)


def theory_for(sensor: Sensor, probe: Probe, force_range: tuple[float, float], accuracy: float = ACCURACY) -> Theory:
    """Return the theory with the fewest terms that is sufficient for all forces of a range.

    If the sensor reads the stress at an outer surface of the film, the theory includes bending.

    Args:
        sensor: The sensor.
        probe: The probe.
        force_range: Smallest and largest force, N.
        accuracy: Largest allowed relative error of a charge.
    """
    # The largest and the smallest force may require different terms, so the terms of both theories are combined.
    theories = [choose_theory(sensor.film, probe, force, accuracy) for force in force_range]
    return Theory(bending=any(theory.bending for theory in theories) or sensor.surface != "middle")


def theory_by_name(name: str) -> Theory:
    """Return the theory with a given name: "nonlinear membrane" or "nonlinear membrane + bending".

    Raises:
        SceneError: If no theory has this name.
    """
    theories = {theory.name: theory for theory in (Theory(bending=False), Theory(bending=True))}
    if name not in theories:
        raise SceneError(f"theory: expected one of {list(theories)}, got {name!r}")
    return theories[name]
