"""Fixtures for the tests of forward maps."""

from dataclasses import replace

import pytest

from isocharge.simulate import (
    ChargeSpline,
    Circle,
    FilmPrior,
    ForwardMap,
    Resolution,
    Sensor,
    SolveSettings,
    Theory,
    load_sensor,
)
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.sensor.film_prior import FilmSpread
from kept import kept


@pytest.fixture(scope="session")
def near_electrodes() -> Sensor:
    """A uniaxial sensor with electrodes 5 mm from the centre, so that the probe can lie on them."""
    sensor = load_sensor("four-25um-uniaxial")
    inward = tuple(
        replace(e, corners=tuple((x - 0.5 * e.centre[0], y - 0.5 * e.centre[1]) for x, y in e.corners))
        for e in sensor.electrodes
    )
    return replace(sensor, electrodes=inward)


@pytest.fixture(scope="session")
def near_map(near_electrodes: Sensor) -> ForwardMap:
    """A forward map of a membrane with few solves. The probe can lie on the electrodes."""
    theory = Theory(stretching=True, bending=False, pretensioned=False)
    settings = SolveSettings(theory=theory, resolution=Resolution(4, 8, 4))
    return kept(ForwardMap.build, near_electrodes, Circle(1.0), 5.0, (0.3, 1.0), settings)


@pytest.fixture(scope="session")
def near_spline(near_map: ForwardMap) -> ChargeSpline:
    return kept(ChargeSpline.of, near_map, spacing=0.25)


def narrow_family(prior: FilmPrior) -> FilmFamily:
    """The family is compared with four direct solves instead of 24."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("isocharge.simulate.forward.film_family.CHECK_COUNT", 4)
        return FilmFamily.build(prior, radius=3.0, force_range=(0.8, 1.2), counts=(2, 2, 2, 2, 2))


@pytest.fixture(scope="session")
def film_family() -> tuple[FilmPrior, FilmFamily]:
    """A prior distribution with small standard deviations, and the family of its films."""
    spread = FilmSpread(pretension=0.2, young=0.02, thickness=0.02, probe_radius=0.03)
    prior = FilmPrior(load_sensor("three-25um-biaxial"), Circle(1.0), spread)
    return prior, kept(narrow_family, prior)
