"""Names of the theories, and the error of omitted bending."""

from functools import partial

import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Ellipse, SolveSettings, Theory, load_sensor, press, touch_charge
from isocharge.simulate.mechanics.theory import theory_by_name
from isocharge.simulate.solver.error_estimate import estimated_error
from solved_charges import relative_error, solved_charge, with_film

MEMBRANE = Theory(bending=False)
AT = (0.0, -9.5)


@pytest.mark.parametrize("bending", [False, True])
def test_theory_by_name_finds_the_theory_with_this_name(bending):
    assert theory_by_name(Theory(bending).name) == Theory(bending)
    with pytest.raises(SceneError, match=r"theory: expected one of .*'nonlinear membrane', .*, got 'linear plate'"):
        theory_by_name("linear plate")


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("probe", "film"),
    [
        (Circle(1.0), {"thickness": 0.11}),
        (Ellipse(5.0, 2.0, 0.4), {"pretension": 5.0}),
    ],
)
def test_estimated_error_of_a_membrane_holds_for_a_probe_on_an_electrode(probe, film):
    """The bound is at most twice the error."""
    sensor = with_film(load_sensor("four-25um-biaxial"), **film)
    exact = solved_charge(sensor, probe, AT, 0.05, SolveSettings(accuracy=2e-4))
    membrane = press(sensor.film, probe, AT, 0.05, SolveSettings(theory=MEMBRANE))
    error = relative_error(touch_charge(sensor, membrane), exact)
    assert error <= estimated_error(membrane, partial(touch_charge, sensor)) <= 2.0 * error


def test_estimated_error_includes_the_averaged_bending_stiffness_of_an_orthotropic_film():
    """A Ritz solution with the bending stiffness of each direction differs by up to 2.8 % from one with the mean."""
    sensor = with_film(load_sensor("four-25um-biaxial"), thickness=0.5, young_ratio=2.0, axis=0.5)
    solved = press(sensor.film, Circle(5.0), (6.0, 4.0), 1.0)
    assert 0.028 < estimated_error(solved, partial(touch_charge, sensor)) < 0.3
