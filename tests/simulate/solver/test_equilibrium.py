"""Results of an equilibrium: rotated frames, error messages and error estimates."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    Circle,
    Ellipse,
    GrowingFinger,
    Polygon,
    Resolution,
    SolveSettings,
    Theory,
    deflection,
    press,
    touch_stress,
)
from isocharge.simulate.solver.equilibrium import principal_stress
from isocharge.simulate.solver.error_estimate import cautions

PROBE = Circle(1.0)
MEMBRANE = Theory(bending=False)


@pytest.mark.parametrize("accuracy", [0.0, np.nan])
def test_accuracy_without_a_mesh_raises_scene_error(film, accuracy):
    with pytest.raises(SceneError, match="accuracy: expected 1e-06 to 1, got"):
        press(film, PROBE, (0.0, 0.0), 1.0, SolveSettings(accuracy=accuracy))


@pytest.mark.parametrize(
    ("changes", "probe", "at", "force", "message"),
    [
        (
            {},
            PROBE,
            (44.5, 0.0),
            1.0,
            r"probe off the film: centre \(44\.5, 0\) mm, farthest .* circle:1\.0 45\.5 mm",
        ),
        ({}, Polygon.rectangle(10.0, 1.0), (39.9, 5.0), 1.0, r"off the film: centre \(39\.9, 5\) mm, .* rectangle"),
        ({}, PROBE, (np.nan, 0.0), 1.0, r"probe off the film: centre \(nan, 0\) mm"),
        ({}, PROBE, (np.inf, 0.0), 1.0, r"probe off the film: centre \(inf, 0\) mm"),
        ({"oval": 0.02}, PROBE, (1e300, 0.0), 1.0, r"probe off the film: centre \(1e\+300, 0\) mm"),
        ({}, GrowingFinger(1.0), (0.0, 0.0), 1e-6, r"growing-finger:1\.0 under 1e-06 N: expected a radius of at least"),
        (
            {},
            GrowingFinger(1.0),
            (0.0, 0.0),
            -1.0,
            r"growing-finger:1\.0 under -1 N: expected a radius .* press with more",
        ),
        (
            {},
            PROBE,
            (0.0, 0.0),
            200.0,
            r"force 200 N stretches a film of 0\.025 mm beyond small strains: .* got 0\.152",
        ),
        (
            {},
            Circle(0.9999),
            (44.0, 0.0),
            1.0,
            r"press at \(44, 0\) mm comes within 0\.0001 mm of the rim, too near for a",
        ),
        ({}, PROBE, (0.0, 0.0), 0.0, "force: expected at least 1e-12 N .* got 0 N"),
        ({}, Ellipse(16.0, 15.984), (36.85, 0.0), 1e-3, r"within 0\.1\d* mm of the rim: expected at least 1\.6 mm"),
        ({"oval": 0.02}, PROBE, (0.0, 43.5), 0.1, r"off the film: .* 44\.5 mm from .*, the rim 44\.1 mm"),
    ],
)
def test_invalid_press_raises_scene_error(film, changes, probe, at, force, message):
    with pytest.raises(SceneError, match=message):
        press(replace(film, **changes), probe, at, force)


@pytest.mark.parametrize("read", [deflection, touch_stress])
def test_points_off_the_film_raise_scene_error(film, read):
    solved = press(film, PROBE, (0.0, 0.0), 1.0)
    for point in ((-40.0, 30.0), (np.nan, 0.0)):
        with pytest.raises(SceneError, match=rf"point \({point[0]:.4g}, .*\) mm is off the film of radius 45 mm"):
            read(solved, np.array([(0.0, 45.0), point]))
    read(solved, np.array([(0.0, 45.0)]))


def test_compression_near_the_rim_gives_a_warning(film):
    """A press at half the radius gives no warning about wrinkles. A press at three quarters does."""
    for distance, taut in ((0.5, True), (0.75, False)):
        settings = SolveSettings(theory=MEMBRANE, resolution=Resolution(5, 8, 5))
        solved = press(film, PROBE, (distance * film.radius, 0.0), 1.0, settings)
        wrinkles = [caution for caution in cautions(solved) if "may wrinkle" in caution]
        assert (principal_stress(solved)[0] > 0.0) == taut == (not wrinkles)


def test_compression_without_a_press_gives_a_warning(film):
    compressed = replace(film, pretension=-0.1, deviator=(0.03, 0.04))
    (sentence,) = cautions(press(compressed, PROBE, (0.0, 0.0), 0.5))
    assert "without a press, the film is compressed to -0.15 MPa" in sentence


def test_stress_above_the_yield_stress_of_pvdf_gives_a_warning(film):
    """The largest stress includes the pretension."""
    light, heavy = (press(film, PROBE, (2.0, 0.0), force) for force in (0.01, 5.0))
    taut = press(replace(film, pretension=44.99), PROBE, (2.0, 0.0), 0.01)
    assert not cautions(light)
    largest = principal_stress(heavy)[1]
    assert cautions(heavy) == (f"the film is stressed to {largest:.3g} MPa; PVDF yields from 45 MPa on",)
    assert len(cautions(taut)) == 1
    assert principal_stress(taut)[0] > 44.9


def test_principal_stress_is_that_of_the_points(film):
    """No point of the film exceeds the reported stresses, at either surface."""
    solved = press(film, PROBE, (6.0, 2.0), 1.0)
    z = film.radius * np.sqrt(np.linspace(0.0, 1.0, 4000)) * np.exp(2.4j * np.arange(4000))
    z = np.concatenate([z, complex(6.0, 2.0) + 0.05 * z])
    points = np.stack([z.real, z.imag], axis=1)
    smallest, largest = principal_stress(solved)
    for surface in ("middle", "top", "bottom"):
        s11, s22, s12 = touch_stress(solved, points, surface).T
        mean = 0.5 * (s11 + s22)
        radius = np.hypot(0.5 * (s11 - s22), s12)
        assert (mean + radius).max() <= largest * 1.02
        assert surface != "middle" or (mean - radius).min() >= smallest - 0.02 * largest
