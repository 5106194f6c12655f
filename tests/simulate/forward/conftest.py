"""What the tests of forward maps share."""

from dataclasses import replace

import pytest

from isocharge.simulate import ChargeSpline, Circle, FilmPrior, ForwardMap, Sensor, load_sensor
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.sensor.film_prior import FilmSpread


@pytest.fixture(scope="session")
def near_electrodes() -> Sensor:
    """Uniaxial, the electrodes 5 mm from the centre, so that the probe comes to lie on them."""
    sensor = load_sensor("four-25um-uniaxial")
    inward = tuple(
        replace(e, corners=tuple((x - 0.5 * e.centre[0], y - 0.5 * e.centre[1]) for x, y in e.corners))
        for e in sensor.electrodes
    )
    return replace(sensor, electrodes=inward)


@pytest.fixture(scope="session")
def three_spline(three_map: ForwardMap) -> ChargeSpline:
    return ChargeSpline.of(three_map)


@pytest.fixture(scope="session")
def film_family() -> tuple[FilmPrior, FilmFamily]:
    """Films of a narrow spread."""
    spread = FilmSpread(pretension=0.2, young=0.02, thickness=0.02, probe_radius=0.03)
    prior = FilmPrior(load_sensor("three-25um-biaxial"), Circle(1.0), spread)
    return prior, FilmFamily.build(prior, radius=3.0, force_range=(0.8, 1.2), counts=(3, 3, 3, 2, 2))
