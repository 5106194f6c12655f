"""The choice between the theories of the film, and estimates of the error that an omitted term causes.

All theories are special cases of one formulation with two optional terms. The first term is *bending*. Bending matters
near the rim and near the probe, and for the stress at the surface of the film. Bending matters up to the distance l =
sqrt(D / N), the bending length, where D is the bending stiffness and N the tension force per length. If the pretension
and the induced tension are small, bending carries the load. The second term is *stretching*, the effect of the induced
stress on the deflection. Without stretching the film is linear, and the charges are computed from the linear deflection
in a second step. The pretension is always included. The terms determine the name of the theory::

    stretching  bending   theory
    no          yes       linear plate, pre-tensioned linear plate
    no          no        pre-tensioned linear membrane
    yes         no        nonlinear membrane
    yes         yes       nonlinear membrane + bending
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, slenderness
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor

ACCURACY = 1e-3
"""Default target of the relative error of a charge, dimensionless."""

LINEAR_WEIGHT = 4.0
"""Ratio of the relative error of a charge by a linear theory to the share of the load that the induced stress
carries."""

LOCAL_WEIGHT = 0.4
"""Factor of the relative error of a charge by a linear theory of a film with a large pretension.

It multiplies the ratio of the strain that the footprint induces to the strain of the pretension.
"""

BENDING_WEIGHT = 1.5
"""Factor of the largest relative error of a charge without bending.

It multiplies the ratio of the bending length to the film radius. The largest factor in the reference cases of
tests/data is 1.41.
"""

MAX_MEMBRANE_BENDING_LENGTH = 0.3
"""Bending length, in film radii, above which a membrane does not describe the film. The error is then infinite."""

PROBE_WEIGHT = 4.0
"""Factor of the relative error of a charge without bending, for a film with a large pretension.

It multiplies the squared ratio of the bending length at the probe to the reach of the probe.
"""

INDUCED_STRAIN = 0.44
"""Radial strain at the rim of a membrane without pretension, in units of the squared amplitude A^2."""


@dataclass(frozen=True)
class Theory:
    """The terms of the film theory that are modelled.

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
    """Compute the length over which a clamped edge bends the film, in film radii.

    Args:
        film: The film.
        force: Force of the press, N.
    """
    groups = DimensionlessGroups.of(film, force, bending=True)
    tension = max(groups.tension, 0.0) + INDUCED_STRAIN * groups.height**2
    return float(np.sqrt(groups.bending / tension))


def bending_at_probe(film: Film, probe: Probe, force: float) -> float:
    """Estimate the relative change of a charge because the film with pretension bends at the footprint.

    The change is proportional to the squared ratio of the bending length to the reach of the footprint. The tension at
    the footprint is the sum of the pretension and of the stress S of a membrane without pretension. With the slope W'
    of this membrane at the footprint, the stress is S = E W'^2 / 2. The equilibrium of the stress with the load is 2 pi
    R h S W' = F, so W'^3 = F / (pi R h E). If the induced stress dominates, bending hardly changes the charges.

    Args:
        film: The film.
        probe: The probe, whose reach is R.
        force: Force F, N.

    Returns:
        Relative change, dimensionless.
    """
    slope = np.cbrt(force / (np.pi * probe.reach * film.thickness * film.young))
    pretension_strain = film.pretension / film.young
    total_strain = pretension_strain + 0.5 * slope**2
    # Squared ratio of the bending length sqrt(D / (h S)) to the reach of the footprint; D is the bending stiffness.
    squared_length_ratio = slenderness(film) / total_strain * (film.radius / probe.reach) ** 2
    pretension_share = pretension_strain / total_strain
    return PROBE_WEIGHT * float(squared_length_ratio * pretension_share)


def induced_at_probe(film: Film, probe: Probe, force: float) -> float:
    """Estimate the strain that the footprint induces in a film, divided by the strain of the pretension T.

    If the pretension is large, the slope of the film at the footprint is F / (2 pi R h T). If the bending length
    exceeds the footprint, bending reduces the slope.

    Args:
        film: The film.
        probe: The probe, whose reach is R.
        force: Force F, N.

    Returns:
        Ratio of the strains, dimensionless. It is zero for a film without pretension.
    """
    if film.pretension == 0.0:
        return 0.0
    pretension_strain = film.pretension / film.young
    membrane_slope = force / (2.0 * np.pi * probe.reach * film.thickness * film.pretension)
    squared_length_ratio = slenderness(film) / pretension_strain * (film.radius / probe.reach) ** 2
    slope = membrane_slope / (1.0 + squared_length_ratio)
    return float(0.5 * slope**2 / pretension_strain)


def modelling_error(film: Film, probe: Probe, force: float, theory: Theory) -> float:
    """Estimate the relative error of a charge that is caused by the terms that a theory omits.

    The estimates of the omitted stretching and of the omitted bending are added. A theory without stretching and
    bending cannot describe a film without pretension. A theory without bending cannot describe a thick film.

    Args:
        film: The film.
        probe: The probe.
        force: Force of the press, N.
        theory: The theory.

    Returns:
        The error, which is infinite if the theory cannot describe the film.
    """
    error = 0.0
    if not theory.stretching:
        if not theory.bending and film.pretension == 0.0:
            return np.inf
        error += LINEAR_WEIGHT * DimensionlessGroups.of(film, force, bending=theory.bending).induced
        error += LOCAL_WEIGHT * induced_at_probe(film, probe, force)
    if not theory.bending:
        length = bending_length(film, force)
        if length > MAX_MEMBRANE_BENDING_LENGTH:
            return np.inf
        error += BENDING_WEIGHT * length + bending_at_probe(film, probe, force)
    return error


def choose_theory(film: Film, probe: Probe, force: float, accuracy: float) -> Theory:
    """Return the cheapest theory whose error is at most half of the accuracy, or the full theory if there is none.

    Args:
        film: The film.
        probe: The probe.
        force: Force of the press, N.
        accuracy: Target of the relative error of a charge.
    """
    is_tense = film.pretension > 0.0
    full = Theory(stretching=True, bending=True, pretensioned=is_tense)
    if film.pretension < 0.0 or not film.is_axisymmetric:  # the error estimates hold for axisymmetric films only
        return full
    cheapest_first = (  # a linear theory costs less than a nonlinear theory without bending
        Theory(stretching=False, bending=False, pretensioned=is_tense),
        Theory(stretching=False, bending=True, pretensioned=is_tense),
        Theory(stretching=True, bending=False, pretensioned=is_tense),
    )
    for theory in cheapest_first:
        omits_back_pressure = film.has_back_pressure and not theory.stretching  # as do all linear theories
        if omits_back_pressure:
            continue
        if modelling_error(film, probe, force, theory) <= 0.5 * accuracy:  # the other half is for the mesh
            return theory
    return full


def theory_for(sensor: Sensor, probe: Probe, force_range: tuple[float, float], accuracy: float = ACCURACY) -> Theory:
    """Return the theory with the fewest terms that is sufficient for all forces of a range.

    If the stress is read at an outer surface of the film, the theory includes bending.

    Args:
        sensor: The sensor.
        probe: The probe.
        force_range: Smallest and largest force, N.
        accuracy: Target of the relative error of a charge.
    """
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
    is_tense = film.pretension > 0.0
    options = [Theory(stretching, bending, is_tense) for stretching in (False, True) for bending in (False, True)]
    for theory in options:
        short_name = theory.name.removeprefix("pre-tensioned ")
        if name not in (theory.name, short_name):
            continue
        if theory.name == "linear membrane":  # without the prefix, so the film has no pretension
            raise SceneError(
                "theory 'linear membrane': a film without pretension has no stiffness in it; set a pretension"
            )
        return theory
    raise SceneError(f"theory: expected one of {[theory.name for theory in options]}, got {name!r}")
