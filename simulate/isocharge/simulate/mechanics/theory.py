"""Which terms a press needs: the choice between the film's theories, and the error of leaving terms out.

One formulation, two switches. *Bending* matters within l = sqrt(D / N) of the rim, the probe and any readout at the
film's surface, N the tension force between them; where pretension and induced tension are small it carries the load.
*Stretching* is the stress that the deflection induces acting back on the deflection: without it the film is linear, and
the charges follow from the linear deflection in a second step. Pretension costs nothing and is always in.

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
"""Default target for the relative error of a charge, dimensionless."""

LINEAR_WEIGHT = 4.0
"""Relative charge error of the linear theories per unit of the share of the load that induced stress carries."""

LOCAL_WEIGHT = 0.4
"""Relative charge error per unit of (strain induced at the footprint / pretension strain), for a taut film."""

BENDING_WEIGHT = 1.5
"""Largest relative charge error without bending per unit of bending length over film radius: 1.41 in tests/data."""

MOSTLY_BENT = 0.3
"""Bending length over film radius above which a membrane is no model of a film; its error is then infinite."""

PROBE_WEIGHT = 4.0
"""Relative charge error of a taut film without bending per unit of (bending length at the probe / probe reach)^2."""

INDUCED_STRAIN = 0.44
"""Radial strain at the rim of a slack membrane, in units of A^2."""


@dataclass(frozen=True)
class Theory:
    """The terms that are modelled.

    Attributes:
        stretching: Whether the stress that the deflection induces acts back on it.
        bending: Whether the film resists bending.
        pretensioned: Whether there is pretension.
    """

    stretching: bool
    bending: bool
    pretensioned: bool

    @property
    def name(self) -> str:
        """Name in engineering terms, such as "nonlinear membrane + bending"."""
        if self.stretching:
            return "nonlinear membrane + bending" if self.bending else "nonlinear membrane"
        kind = "linear plate" if self.bending else "linear membrane"
        return f"pre-tensioned {kind}" if self.pretensioned else kind


def bending_length(film: Film, force: float) -> float:
    """l / a: length over which a clamped edge bends the film, in units of the film's radius."""
    groups = DimensionlessGroups.of(film, force, bending=True)
    tension = max(groups.tension, 0.0) + INDUCED_STRAIN * groups.height**2
    return float(np.sqrt(groups.bending / tension))


def bending_at_probe(film: Film, probe: Probe, force: float) -> float:
    """Relative change of a charge by bending at the footprint, for a film held by pretension.

    It is proportional to the square of the bending length over the footprint's reach. The tension at the footprint is
    the pretension plus that of a slack membrane under this load, S = E W'^2 / 2 with S W' in balance with the load, so
    W'^3 = F / (pi R h E). Where the induced tension is the larger one, charges hardly change.
    """
    slope2 = np.cbrt(force / (np.pi * probe.reach * film.thickness * film.young)) ** 2
    pretension = film.pretension / film.young
    strain = pretension + 0.5 * slope2
    length2 = slenderness(film) / strain * (film.radius / probe.reach) ** 2
    return PROBE_WEIGHT * float(length2 * pretension / strain)


def induced_at_probe(film: Film, probe: Probe, force: float) -> float:
    """Strain that the slope F / (2 pi R h T) of a taut film induces at the footprint, over that of the pretension T.

    Where the bending length exceeds the footprint, bending keeps the slope smaller.
    """
    if film.pretension == 0.0:
        return 0.0
    slope = force / (2.0 * np.pi * probe.reach * film.thickness * film.pretension)
    length2 = slenderness(film) * film.young / film.pretension * (film.radius / probe.reach) ** 2
    return float(0.5 * slope**2 * film.young / film.pretension / (1.0 + length2) ** 2)


def modelling_error(film: Film, probe: Probe, force: float, theory: Theory) -> float:
    """Expected relative error of a charge from the terms that a theory leaves out; infinite where it has no meaning."""
    error = 0.0
    if not theory.stretching:
        if not theory.bending and film.pretension == 0.0:
            return np.inf
        error += LINEAR_WEIGHT * DimensionlessGroups.of(film, force, bending=theory.bending).induced
        error += LOCAL_WEIGHT * induced_at_probe(film, probe, force)
    if not theory.bending:
        length = bending_length(film, force)
        error += BENDING_WEIGHT * length + bending_at_probe(film, probe, force)
        error += np.inf if length > MOSTLY_BENT else 0.0
    return error


def choose_theory(film: Film, probe: Probe, force: float, accuracy: float) -> Theory:
    """The cheapest theory whose error stays within half of the accuracy; the full one if no theory does."""
    tense = film.pretension > 0.0
    full = Theory(stretching=True, bending=True, pretensioned=tense)
    if film.pretension < 0.0 or not film.turns:  # the errors above are those of a film that is alike all round
        return full
    cheap_first = (
        Theory(stretching=False, bending=False, pretensioned=tense),
        Theory(stretching=False, bending=True, pretensioned=tense),
        Theory(stretching=True, bending=False, pretensioned=tense),
    )
    return next((each for each in cheap_first if modelling_error(film, probe, force, each) <= 0.5 * accuracy), full)


def theory_for(sensor: Sensor, probe: Probe, force_range: tuple[float, float], accuracy: float = ACCURACY) -> Theory:
    """The fewest terms that suffice for every force (N) of a range and for the surface that a sensor reads."""
    ends = [choose_theory(sensor.film, probe, force, accuracy) for force in force_range]
    return Theory(
        stretching=any(end.stretching for end in ends),
        bending=any(end.bending for end in ends) or sensor.surface != "middle",
        pretensioned=ends[0].pretensioned,
    )


def theory_by_name(name: str, film: Film) -> Theory:
    """The theory of this name, "linear plate", "linear membrane", "nonlinear membrane" or with " + bending".

    Raises:
        SceneError: If no theory has this name, or it has no stiffness for this film.
    """
    tense = film.pretension > 0.0
    options = [Theory(stretching, bending, tense) for stretching in (False, True) for bending in (False, True)]
    matching = [theory for theory in options if name in (theory.name, theory.name.removeprefix("pre-tensioned "))]
    if not matching:
        raise SceneError(f"theory: expected one of {[theory.name for theory in options]}, got {name!r}")
    if matching[0].name == "linear membrane":
        raise SceneError("theory 'linear membrane': a film without pretension has no stiffness in it; set a pretension")
    return matching[0]
