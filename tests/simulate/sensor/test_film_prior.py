"""Prior distribution of films: drawn films, and conversion between parameters and sensors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import truncnorm

from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate import Circle, Electrode, FilmPrior, load_sensor
from isocharge.simulate.sensor.film_prior import FilmSpread

PRIOR = FilmPrior(load_sensor("four-25um-uniaxial"), Circle(1.0))


def test_drawn_films_have_the_prior_distribution_within_the_bounds():
    drawn = PRIOR.draw(np.random.default_rng(0), 20_000)
    low, high = PRIOR.bounds
    assert ((drawn >= low) & (drawn <= high)).all()
    expected = truncnorm((low - PRIOR.mean) / PRIOR.std, (high - PRIOR.mean) / PRIOR.std).std()
    expected[0] = 1.0  # uniform from zero to the largest
    np.testing.assert_allclose(drawn.std(axis=0) / PRIOR.std, expected, rtol=0.02)
    np.testing.assert_allclose((drawn.mean(axis=0) - PRIOR.mean) / PRIOR.std, 0.0, atol=0.03)


def test_parameters_of_is_the_inverse_of_film():
    for parameters in PRIOR.draw(np.random.default_rng(1), 20):
        back = PRIOR.parameters_of(*PRIOR.film(parameters))
        np.testing.assert_allclose(back, parameters, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(PRIOR.parameters_of(PRIOR.sensor, PRIOR.probe), PRIOR.described, atol=1e-15)


def test_each_parameter_changes_its_attribute():
    parameters = PRIOR.described
    for name, value in (("young", np.log(1.1)), ("gain C", np.log(0.9)), ("shift_y", 0.2), ("probe_radius", 0.1)):
        parameters[PRIOR.names.index(name)] = value
    sensor, probe = PRIOR.film(parameters)
    assert (sensor.film.young, *sensor.gains) == pytest.approx((3300.0, 1.0, 1.0, 0.9, 1.0))
    assert (sensor.calibration.shift, probe) == ((0.0, 0.2), Circle(1.1))


@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        (load_sensor("three-25um-biaxial"), r"electrodes of .* \(A at .* mm\), got others \(A at .* mm\)$"),
        (replace(PRIOR.sensor, film=replace(PRIOR.sensor.film, radius=46.0)), "film radius"),
        (replace(PRIOR.sensor, readout="edge"), "readout"),
        (replace(PRIOR.sensor, piezo=replace(PRIOR.sensor.piezo, d33=-1.0)), "d33"),
        (replace(PRIOR.sensor, piezo=replace(PRIOR.sensor.piezo, d31=-20.0)), "signs"),
    ],
)
def test_parameters_of_rejects_sensors_with_other_differences(sensor, reason):
    with pytest.raises(SensorError, match=reason):
        PRIOR.parameters_of(sensor, PRIOR.probe)


AT_THE_RIM = Electrode.of_square("A", (43.0, 0.0), 3.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: FilmPrior(replace(PRIOR.sensor, electrodes=(AT_THE_RIM,)), Circle(1.0)),
            r"'A' reaches 44.53 mm .* expected 43.94 mm at most",
        ),
        (lambda: FilmSpread(young=-0.1), r"spread of young: expected a positive number, got -0\.1"),
    ],
)
def test_invalid_prior_raises_error(make, message):
    with pytest.raises((SensorError, SceneError), match=message):
        make()
