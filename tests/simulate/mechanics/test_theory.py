"""Choice of the theory, and the error of the omitted terms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Film, Polygon, SolveSettings, Theory, load_sensor, press, touch_charge
from isocharge.simulate.mechanics.theory import (
    choose_theory,
    modelling_error,
    theory_by_name,
    theory_for,
)

PROBE = Circle(1.0)
AT = (3.0, -2.0)


def thick(film: Film, thickness: float, pretension: float = 0.0) -> Film:
    return replace(film, thickness=thickness, pretension=pretension)


@pytest.mark.parametrize("bending", [False, True])
def test_theory_by_name_finds_the_theory_with_this_name(bending):
    assert theory_by_name(Theory(bending).name) == Theory(bending)
    with pytest.raises(SceneError, match=r"theory: expected one of .*'nonlinear membrane', .*, got 'linear plate'"):
        theory_by_name("linear plate")


@pytest.mark.parametrize(
    ("thickness", "pretension", "force", "accuracy", "name"),
    [
        (0.001, 0.0, 1.0, 1e-3, "nonlinear membrane"),
        (0.005, 0.0, 1.0, 2e-3, "nonlinear membrane"),
        (0.025, 0.0, 1.0, 1e-3, "nonlinear membrane + bending"),
        (0.025, 0.0, 1.0, 5e-2, "nonlinear membrane"),
        (2.0, 0.0, 1e-3, 1e-6, "nonlinear membrane + bending"),
        (0.5, 0.0, 5.0, 1e-3, "nonlinear membrane + bending"),
        (0.025, 5.0, 1e-4, 3e-2, "nonlinear membrane + bending"),
        (0.002, 10.0, 1e-6, 1e-2, "nonlinear membrane"),
        (0.11, 0.0, 1e-1, 1e-12, "nonlinear membrane + bending"),
    ],
)
def test_choose_theory_gives_the_fewest_terms(film, thickness, pretension, force, accuracy, name):
    assert choose_theory(thick(film, thickness, pretension), PROBE, force, accuracy).name == name


@given(
    thickness=st.floats(0.005, 2.0),
    pretension=st.just(0.0) | st.floats(0.01, 20.0),
    force=st.floats(1e-5, 10.0),
    accuracy=st.floats(1e-6, 0.1),
)
@settings(derandomize=True)
def test_chosen_theory_is_accurate_or_the_full_theory(thickness, pretension, force, accuracy):
    """A higher accuracy never removes a term."""
    film = Film(45.0, thickness, 3000.0, 0.34, pretension)
    theory = choose_theory(film, PROBE, force, accuracy)
    finer = choose_theory(film, PROBE, force, 0.1 * accuracy)
    assert theory.name.endswith("+ bending") or modelling_error(film, PROBE, force, theory) <= accuracy
    assert modelling_error(film, PROBE, force, finer) <= modelling_error(film, PROBE, force, theory)
    assert modelling_error(film, PROBE, force, Theory(bending=True)) == 0.0


def test_theory_for_a_sensor_suffices_for_all_forces_and_the_surface(film):
    sensor = replace(load_sensor("three-25um-biaxial"), film=thick(film, 0.3))
    assert theory_for(sensor, PROBE, (1e-4, 5.0)).name == "nonlinear membrane + bending"
    thin = replace(sensor, film=thick(film, 0.001))
    assert theory_for(thin, PROBE, (1.0, 1.0)).name == "nonlinear membrane"
    assert theory_for(replace(thin, surface="top"), PROBE, (1.0, 1.0)).name == "nonlinear membrane + bending"


def draw(rng: np.random.Generator) -> tuple[Film, Circle | Polygon, tuple[float, float], float]:
    """Draw a press on a thin or thick film with or without pretension."""

    def between(low: float, high: float) -> float:
        """Draw a number whose logarithm is uniform."""
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    thickness = between(0.005, 2.0)
    pretension = 0.0 if rng.random() < 0.5 else between(0.1, 20.0)
    film = Film(45.0, thickness, 3000.0, float(rng.uniform(0.0, 0.49)), pretension)
    size = between(0.3, 5.0)
    probe = Circle(size) if rng.random() < 0.7 else Polygon.rectangle(2.0 * size, size, float(rng.uniform(0.0, 3.0)))
    z = 25.0 * np.sqrt(rng.random()) * np.exp(2j * np.pi * rng.random())
    return film, probe, (float(z.real), float(z.imag)), between(1e-5, 5.0)


def test_modelling_error_is_an_upper_bound_of_the_difference_of_theories():
    """The charges of a simpler theory differ from those of the complete theory by at most the modelling error.

    The difference is relative to the largest charge of the press, and both theories use the same mesh. A hundredth of
    the accuracy is added because Newton's method stops at a small residual.
    """
    rng = np.random.default_rng(5)
    accuracy = 1e-2
    count = 4
    while count:
        film, probe, at, force = scene = draw(rng)
        theory = choose_theory(film, probe, force, accuracy)
        bound = modelling_error(film, probe, force, theory)
        if bound > 0.0:
            count -= 1
            sensor = replace(load_sensor("three-25um-uniaxial"), film=film)
            full = press(film, probe, at, force, SolveSettings(theory=Theory(bending=True)))
            same_mesh = SolveSettings(theory=theory, resolution=full.mesh.resolution, layer=full.mesh.layer)
            exact = touch_charge(sensor, full)
            charge = touch_charge(sensor, press(film, probe, at, force, same_mesh))
            error = float(np.abs(charge - exact).max() / np.abs(exact).max())
            assert error <= bound + 0.01 * accuracy, (theory.name, error, bound, scene)
