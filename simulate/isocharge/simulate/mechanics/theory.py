"""Choice of the theory of the film, and estimates of the errors that the omitted terms of a theory cause.

All theories are special cases of one formulation with two optional terms.

The first term is *bending*, the resistance of the film to bending. Bending is important near the rim and near the
probe, and for the stress at the surfaces of the film. The effect of bending reaches as far as the bending length
sqrt(D / N), where D is the bending stiffness and N is the tension force per length. If the pretension and the induced
tension are small, the bending stiffness carries the load.

The second term is *stretching*, the effect of the induced stress on the deflection. Without stretching, the deflection
is a linear function of the force. In a theory without stretching, the charges are computed from the deflection in a
second step.

All theories include the pretension. The two terms and the pretension determine the name of a theory::

    stretching  bending   theory
    no          yes       linear plate, pre-tensioned linear plate
    no          no        pre-tensioned linear membrane
    yes         no        nonlinear membrane
    yes         yes       nonlinear membrane + bending
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

LINEAR_WEIGHT = 4.0
"""Factor in the estimate of the relative error of a charge that is computed with a linear theory.

The factor multiplies the share of the load that the induced stress carries.
"""

LOCAL_WEIGHT = 0.4
"""Factor in the estimate of the relative error of a charge that is computed with a linear theory.

The factor multiplies the ratio of the strain that the footprint induces to the strain of the pretension. The ratio is
estimated for a film with a large pretension.
"""

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
        stretching: Whether the induced stress affects the deflection.
        bending: Whether the film resists bending.
        pretensioned: Whether the film has a pretension.
    """

    stretching: bool
    bending: bool
    pretensioned: bool

    @property
    def name(self) -> str:
        """Name of the theory in engineering terms, such as "nonlinear membrane + bending"."""
        if self.stretching:
            return "nonlinear membrane + bending" if self.bending else "nonlinear membrane"
        kind = "linear plate" if self.bending else "linear membrane"
        return f"pre-tensioned {kind}" if self.pretensioned else kind


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


def induced_at_probe(film: Film, probe: Probe, force: float) -> float:
    """Estimate the ratio of the strain that the footprint induces in a film to the strain of the pretension.

    For a large pretension T, the slope of the film at the footprint is F / (2 pi R h T). If the bending length exceeds
    the reach of the footprint, bending reduces the slope. The induced strain is half of the squared slope.

    Args:
        film: The film, with thickness h.
        probe: The probe, whose footprint has the reach R.
        force: Force F, N.

    Returns:
        Ratio of the strains, dimensionless. The ratio is zero for a film without pretension.
    """
    if film.pretension == 0.0:
        return 0.0
    pretension_strain = film.pretension / film.young
    membrane_slope = force / (2.0 * np.pi * probe.reach * film.thickness * film.pretension)

    # Squared ratio of the bending length to the reach of the footprint
    squared_length_ratio = slenderness(film) / pretension_strain * (film.radius / probe.reach) ** 2
    slope = membrane_slope / (1.0 + squared_length_ratio)
    return float(0.5 * slope**2 / pretension_strain)


def modelling_error(film: Film, probe: Probe, force: float, theory: Theory) -> float:
    """Estimate the relative error that the omitted terms of a theory cause in a charge.

    The error is the sum of an estimate for omitted stretching and an estimate for omitted bending. A theory with
    neither stretching nor bending cannot describe a film without pretension. A theory without bending cannot describe a
    thick film.

    Args:
        film: The film.
        probe: The probe.
        force: Force of the press, N.
        theory: The theory.

    Returns:
        The error, which is infinite if the theory cannot describe the film.
    """
    stretching_error = 0.0
    if not theory.stretching:
        has_no_stiffness = not theory.bending and film.pretension == 0.0
        if has_no_stiffness:
            return np.inf
        induced_share = DimensionlessGroups.of(film, force, bending=theory.bending).induced
        stretching_error = LINEAR_WEIGHT * induced_share + LOCAL_WEIGHT * induced_at_probe(film, probe, force)
    if theory.bending:
        return stretching_error

    length = bending_length(film, force)
    if length > MAX_MEMBRANE_BENDING_LENGTH:  # the film is too thick for a membrane
        return np.inf
    bending_error = BENDING_WEIGHT * length + bending_at_probe(film, probe, force)
    return stretching_error + bending_error


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
    """Return the cheapest theory that is sufficiently accurate, or the full theory if no cheaper theory is sufficient.

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
    is_pretensioned = film.pretension > 0.0
    full_theory = Theory(stretching=True, bending=True, pretensioned=is_pretensioned)
    error_estimate_is_valid = film.pretension >= 0.0 and film.is_axisymmetric
    if not error_estimate_is_valid:
        return full_theory

    # Both linear theories cost less than the nonlinear theory without bending.
    cheapest_first = (
        Theory(stretching=False, bending=False, pretensioned=is_pretensioned),
        Theory(stretching=False, bending=True, pretensioned=is_pretensioned),
        Theory(stretching=True, bending=False, pretensioned=is_pretensioned),
    )
    for theory in cheapest_first:
        is_linear = not theory.stretching
        if film.has_back_pressure and is_linear:  # linear theories omit the pressure on the back
            continue
        if modelling_error(film, probe, force, theory) <= 0.5 * accuracy:
            return theory
    return full_theory


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
    return Theory(
        stretching=any(theory.stretching for theory in theories),
        bending=any(theory.bending for theory in theories) or sensor.surface != "middle",
        pretensioned=theories[0].pretensioned,
    )


def theory_by_name(name: str, film: Film) -> Theory:
    """Return the theory with a given name.

    Args:
        name: "linear plate", "linear membrane", "nonlinear membrane" or "nonlinear membrane + bending". The prefix
            "pre-tensioned " of a linear theory is optional.
        film: The film. The theory includes a pretension if the film has one.

    Raises:
        SceneError: If no theory has this name, or the film has no stiffness in this theory.
    """
    is_pretensioned = film.pretension > 0.0
    theories = [
        Theory(stretching, bending, is_pretensioned) for stretching in (False, True) for bending in (False, True)
    ]
    for theory in theories:
        short_name = theory.name.removeprefix("pre-tensioned ")
        if name not in (theory.name, short_name):
            continue
        # A linear membrane without the prefix "pre-tensioned " has no pretension, and therefore no stiffness.
        if theory.name == "linear membrane":
            raise SceneError(
                "theory 'linear membrane': a film without pretension has no stiffness in it; set a pretension"
            )
        return theory
    raise SceneError(f"theory: expected one of {[theory.name for theory in theories]}, got {name!r}")
