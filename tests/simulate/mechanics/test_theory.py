"""Which terms a scene gets, and that what is left out is as small as the result says."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    Circle,
    Film,
    Polygon,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    theory_for,
    touch_charge,
)
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, amplitude_squared
from isocharge.simulate.mechanics.theory import bending_length, choose_theory, modelling_error, theory_by_name

PROBE, AT = Circle(1e-3), (3e-3, -2e-3)


def thick(film: Film, thickness_um: float, pretension_MPa: float = 0.0) -> Film:
    return replace(film, thickness=thickness_um * 1e-6, pretension=pretension_MPa * 1e6)


NAMES = {
    (False, False, False): "linear membrane",
    (False, False, True): "pre-tensioned linear membrane",
    (False, True, False): "linear plate",
    (False, True, True): "pre-tensioned linear plate",
    (True, False, False): "nonlinear membrane",
    (True, False, True): "nonlinear membrane",
    (True, True, False): "nonlinear membrane + bending",
    (True, True, True): "nonlinear membrane + bending",
}


@pytest.mark.parametrize(("terms", "name"), NAMES.items(), ids=str)
def test_theory_has_the_name_of_its_terms(terms, name):
    assert Theory(*terms).name == name


@pytest.mark.parametrize("tense", [False, True])
@pytest.mark.parametrize("name", sorted(set(NAMES.values())))
def test_theory_by_name_gives_the_theory_of_that_name(film, name, tense):
    film = thick(film, 25.0, 1.0 if tense else 0.0)
    if name == "linear membrane" and not tense:
        with pytest.raises(SceneError, match="'linear membrane': a film without pretension has no stiffness in it"):
            theory_by_name(name, film)
    elif name.startswith("pre-tensioned") and not tense:
        with pytest.raises(SceneError, match=f"theory: expected one of .* got '{name}'"):
            theory_by_name(name, film)
    else:
        found = theory_by_name(name, film)
        assert found.name.removeprefix("pre-tensioned ") == name.removeprefix("pre-tensioned ")
        assert found.pretensioned == tense


def test_unknown_name_is_shown(film):
    with pytest.raises(SceneError, match=r"theory: expected one of \['linear membrane', .*\], got 'shell'"):
        theory_by_name("shell", film)


@pytest.mark.parametrize(
    ("thickness_um", "pretension_MPa", "force", "accuracy", "name"),
    [
        (1.0, 0.0, 1.0, 1e-3, "nonlinear membrane"),
        (5.0, 0.0, 1.0, 2e-3, "nonlinear membrane"),
        (25.0, 0.0, 1.0, 1e-3, "nonlinear membrane + bending"),
        (25.0, 0.0, 1.0, 5e-2, "nonlinear membrane"),
        (2000.0, 0.0, 1e-3, 1e-3, "linear plate"),
        (2000.0, 0.0, 1e-3, 1e-6, "linear plate"),
        (500.0, 0.0, 5.0, 1e-3, "nonlinear membrane + bending"),
        (2000.0, 5.0, 1e-3, 1e-3, "pre-tensioned linear plate"),
        (110.0, 0.0, 1e-1, 1e-12, "nonlinear membrane + bending"),
    ],
)
def test_choose_theory_gives_the_fewest_terms(film, thickness_um, pretension_MPa, force, accuracy, name):
    film = thick(film, thickness_um, pretension_MPa)
    assert choose_theory(film, PROBE, force, accuracy).name == name
    assert press(film, PROBE, AT, force, SolveSettings(accuracy=max(accuracy, 1e-4))).theory.pretensioned == (
        pretension_MPa > 0.0
    )


def test_taut_thin_film_under_a_feather_is_linear(film):
    for thickness_um in (2.0, 25.0, 200.0):
        assert not choose_theory(thick(film, thickness_um, 10.0), PROBE, 1e-6, 1e-3).stretching


@given(
    thickness=st.floats(5e-6, 2e-3),
    pretension=st.just(0.0) | st.floats(1e4, 2e7),
    force=st.floats(1e-5, 10.0),
    accuracy=st.floats(1e-6, 0.1),
)
@settings(derandomize=True)
def test_choice_is_within_the_accuracy_or_everything(thickness, pretension, force, accuracy):
    """And asking for more never takes a term away."""
    film = Film(45e-3, thickness, 3e9, 0.34, pretension)
    theory, finer = choose_theory(film, PROBE, force, accuracy), choose_theory(film, PROBE, force, 0.1 * accuracy)
    assert theory.name.endswith("+ bending") or modelling_error(film, PROBE, force, theory) <= accuracy
    assert modelling_error(film, PROBE, force, finer) <= modelling_error(film, PROBE, force, theory)
    assert modelling_error(film, PROBE, force, Theory(True, True, pretension > 0.0)) == 0.0


@given(
    thickness=st.floats(5e-6, 2e-3),
    pretension=st.just(0.0) | st.floats(1e3, 2e7),
    force=st.floats(1e-5, 10.0),
    poisson=st.floats(0.0, 0.49),
)
@settings(derandomize=True)
def test_amplitude_solves_its_cubic(thickness, pretension, force, poisson):
    """A^3 + (1.6 pretension / E + 16 pi b) A = F / (E h a): so height is one, and the load is what the cubic says."""
    film = Film(45e-3, thickness, 3e9, poisson, pretension)
    a = np.sqrt(amplitude_squared(film, force))
    b = (thickness / 45e-3) ** 2 / (12.0 * (1.0 - poisson**2))
    total = a**3 + (1.6 * pretension / 3e9 + 16.0 * np.pi * b) * a
    assert total == pytest.approx(force / (3e9 * thickness * 45e-3), rel=1e-7)
    groups = DimensionlessGroups.of(film, force, bending=True)
    assert groups.height == pytest.approx(1.0, rel=1e-6)
    assert 0.0 <= groups.induced <= 1.0 + 1e-6


def test_bending_length_follows_thickness_and_force(film):
    """l / a with l = sqrt(D / N): slack, doubling the thickness at one stress doubles it, tension lowers it."""
    assert bending_length(thick(film, 1.0), 8e-3) == pytest.approx(
        0.5 * bending_length(thick(film, 1.0), 1e-3), rel=1e-2
    )
    assert bending_length(thick(film, 25.0, 1.0), 1e-3) < bending_length(thick(film, 25.0), 1e-3)
    taut = thick(film, 25.0, 20.0)
    stiffness = taut.young * taut.thickness**3 / (12.0 * (1.0 - taut.poisson**2))
    expected = np.sqrt(stiffness / (taut.pretension * taut.thickness)) / taut.radius
    assert bending_length(taut, 1e-6) == pytest.approx(expected, rel=1e-4)


def test_theory_for_a_sensor_serves_all_forces_and_the_surface(film):
    """Linear at the small end, nonlinear at the other: nonlinear; a surface needs bending."""
    sensor = replace(load_sensor("three-25um-biaxial"), film=thick(film, 300.0))
    assert choose_theory(sensor.film, PROBE, 1e-4, 1e-3).name == "linear plate"
    assert theory_for(sensor, PROBE, (1e-4, 1e-4)).name == "linear plate"
    assert theory_for(sensor, PROBE, (1e-4, 5.0)).name == "nonlinear membrane + bending"
    thin = replace(sensor, film=thick(film, 1.0))
    assert theory_for(thin, PROBE, (1.0, 1.0)).name == "nonlinear membrane"
    assert theory_for(replace(thin, surface="top"), PROBE, (1.0, 1.0)).name == "nonlinear membrane + bending"


def test_theory_can_be_overridden(film):
    """The wrong one too: it says how wrong."""
    film = thick(film, 1000.0)
    membrane = press(film, PROBE, AT, 1.0, SolveSettings(theory=theory_by_name("nonlinear membrane", film)))
    assert membrane.theory.name == "nonlinear membrane"
    assert membrane.estimated_error == np.inf
    plate = press(film, PROBE, AT, 1.0, SolveSettings(theory=theory_by_name("linear plate", film)))
    assert 0.005 < plate.estimated_error < 0.5
    assert (
        press(
            film, PROBE, AT, 1.0, SolveSettings(theory=theory_by_name("nonlinear membrane + bending", film))
        ).estimated_error
        < 1e-3
    )


def draw(rng: np.random.Generator) -> tuple[Film, Circle | Polygon, tuple[float, float], float]:
    """A scene for one of the simpler theories: thin, thick or taut; the probe off the electrodes or on them."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    thickness, pretension = between(5e-6, 2e-3), 0.0 if rng.random() < 0.5 else between(1e5, 2e7)
    film = Film(45e-3, thickness, 3e9, float(rng.uniform(0.0, 0.49)), pretension)
    size = between(0.3e-3, 5e-3)
    probe = Circle(size) if rng.random() < 0.7 else Polygon.rectangle(2.0 * size, size, float(rng.uniform(0.0, 3.0)))
    z = 25e-3 * np.sqrt(rng.random()) * np.exp(2j * np.pi * rng.random())
    return film, probe, (float(z.real), float(z.imag)), between(1e-5, 5.0)


def difference(scene: tuple, accuracy: float) -> tuple[float, float, str]:
    """Real error of what is left out (of the worst charge, over the press's largest), its estimate, and the theory."""
    film, probe, at, force = scene
    theory = choose_theory(film, probe, force, accuracy)
    sensor = replace(load_sensor("three-25um-uniaxial"), film=film)
    full = press(film, probe, at, force, SolveSettings(theory=Theory(True, True, film.pretension > 0.0)))
    simple = press(film, probe, at, force, SolveSettings(theory=theory, resolution=full.resolution, layer=full.layer))
    exact, charge = touch_charge(sensor, full), touch_charge(sensor, simple)
    return (
        float(np.abs(charge - exact).max() / np.abs(exact).max()),
        modelling_error(film, probe, force, theory),
        theory.name,
    )


def scenes(seed: int, count: int, accuracy: float) -> list[tuple]:
    """Seeded scenes that get a simpler theory at this accuracy."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        scene = draw(rng)
        if modelling_error(scene[0], scene[1], scene[3], choose_theory(scene[0], scene[1], scene[3], accuracy)) > 0.0:
            found.append(scene)
    return found


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("accuracy", [1e-3, 1e-2])
def test_modelling_error_bounds_the_real_difference(accuracy):
    """A hundredth of the accuracy is for the digits of Newton's method, where next to nothing is left out."""
    for scene in scenes(5, 16, accuracy):
        error, bound, name = difference(scene, accuracy)
        assert error <= bound + 0.01 * accuracy, (name, error, bound, scene)
        assert error <= accuracy, (name, error, scene)


@pytest.mark.slow
@pytest.mark.parametrize("accuracy", [1e-3, 1e-2, 0.1])
def test_modelling_error_bounds_the_real_difference_in_many_scenes(accuracy):
    for scene in scenes(6, 150, accuracy):
        error, bound, name = difference(scene, accuracy)
        assert error <= bound + 0.01 * accuracy, (name, error, bound, scene)


def test_bending_matters_at_a_small_probe_on_a_taut_film(film):
    """The bending length is as long as the probe is wide: a membrane's slopes there are not the film's."""
    scene = (thick(film, 20.0, 10.0), Circle(0.1e-3), (5e-3, 3e-3), 1e-4)
    error, bound, name = difference(scene, 1e-2)
    assert error <= max(bound, 1e-5), (name, error, bound)
    assert modelling_error(scene[0], scene[1], scene[3], Theory(True, False, True)) > 0.1
