"""Layouts over a disk: limits on a grid, with what nobody knows, folds and twins."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import (
    ChargeFunction,
    ChargeSpline,
    Circle,
    Electrode,
    ForwardMap,
    assess_layout,
    load_sensor,
    noise_model,
)
from isocharge.simulate.identifiability.cramer_rao import cramer_rao, limits_at

REFERENCE = noise_model("reference")


def four_charges(extra: float = 300.0) -> ChargeFunction:
    """Three charges that fold at x = 3 mm; the fourth rises with x by so much (1/m)."""

    def charge(contact):
        x, y, force = contact.T
        columns = [3.0 + 1e3 * (x - x**2 / 6e-3) / 3.0, 3.0 + 300.0 * y, np.full(len(x), 3.0), 3.0 + extra * x]
        return 3e-10 * force[:, None] ** (2.0 / 3.0) * np.stack(columns, axis=1)

    return ChargeFunction(charge, 5e-3, (0.05, 2.0))


def test_limits_on_a_square_grid():
    model = four_charges()
    assessed = assess_layout(model, REFERENCE, radius=4e-3, forces=(0.1, 1.0), spacing=0.5e-3)
    steps = 0.5 * np.arange(-8, 9)
    inside = sum(np.hypot(x, y) <= 4.0 for x in steps for y in steps)
    assert assessed.position.shape == (inside, 2)
    assert assessed.limit.shape == assessed.relative_force.shape == (2, inside)
    contact = np.column_stack([assessed.position, np.full(inside, 1.0)])
    np.testing.assert_allclose(assessed.limit[1], limits_at(model, contact, REFERENCE).position)
    np.testing.assert_allclose(assessed.relative_force[1], limits_at(model, contact, REFERENCE).force)
    assert assessed.worst == assessed.limit.max()
    assert assessed.rms == pytest.approx(np.sqrt((assessed.limit**2).mean()))
    assert assessed.determined
    assert (assessed.fold_radius, assessed.twin_radius) == (np.inf, np.inf)


def test_folds_and_twins_count_only_within_the_radius():
    wide, narrow = (assess_layout(four_charges(0.0), REFERENCE, radius=radius) for radius in (4.5e-3, 2.5e-3))
    assert wide.fold_radius == pytest.approx(3e-3, abs=5e-5)
    assert wide.twin_radius < 4.5e-3
    assert not wide.determined
    assert "folds 3.0 mm" in wide.words
    assert "same charges" in wide.words
    assert narrow.determined
    assert not len(narrow.folds)
    assert not len(assess_layout(four_charges(0.0), REFERENCE, twins=False).twins)


def test_an_error_above_the_allowed_one_is_not_determined():
    assessed = assess_layout(four_charges(), REFERENCE, radius=2e-3)
    assert not replace(assessed, error=0.9 * assessed.worst).determined


def test_nuisances_are_noise_that_the_electrodes_share():
    """Unknowns with a prior, marginalised, are correlated noise: covariance diag(1/i) + N N' (Woodbury)."""
    rng = np.random.default_rng(3)
    charge, jacobian = rng.uniform(1e-10, 1e-9, (20, 5)), rng.normal(size=(20, 5, 3)) * [1e-7, 1e-7, 1e-9]
    nuisance = 1e-11 * rng.normal(size=(20, 5, 2))
    limits = cramer_rao(charge, jacobian, REFERENCE, nuisance)
    for i in range(20):
        noise = np.diag(1.0 / REFERENCE.information(charge[i])) + nuisance[i] @ nuisance[i].T
        expected = np.linalg.inv(jacobian[i].T @ np.linalg.inv(noise) @ jacobian[i])
        np.testing.assert_allclose(limits.covariance[i, :3, :3], expected, rtol=1e-6)


def test_what_nobody_knows_raises_the_limit():
    def gains(contact):
        return 0.002 * np.eye(4) * four_charges().charge(contact)[:, :, None]

    alone = assess_layout(four_charges(), REFERENCE, radius=2e-3, twins=False)
    unknown = assess_layout(four_charges(), REFERENCE, radius=2e-3, twins=False, nuisance=gains)
    assert (unknown.limit > 1.2 * alone.limit).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"radius": 6e-3}, "expected up to the charge model's 5 mm, got 6 mm"),
        ({"forces": (3.0,)}, "expected 0.05 to 2 N"),
        ({"forces": ()}, "expected at least one force"),
    ],
)
def test_what_the_charges_do_not_cover_is_refused(words, message):
    with pytest.raises(SceneError, match=message):
        assess_layout(four_charges(), REFERENCE, **words)


def test_fewer_than_three_charges_are_refused():
    two = ChargeFunction(lambda contact: four_charges().charge(contact)[:, :2], 5e-3, (0.05, 2.0))
    with pytest.raises(SceneError, match="at least three electrodes, got 2"):
        assess_layout(two, REFERENCE)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("places_mm", "worst", "rms"),
    [
        (((3.9, -14.5), (10.4, 10.7), (-14.2, 3.8)), 0.129e-3, 0.088e-3),
        (((0.5, -14.1), (-5.1, 6.3), (-0.2, -0.3), (8.6, 1.1)), 0.099e-3, 0.043e-3),
        pytest.param(((0.0, -10.0), (8.660254, 5.0), (-8.660254, 5.0)), 0.239e-3, 0.091e-3, marks=pytest.mark.slow),
        pytest.param(
            ((10.0, 0.0), (0.0, 10.0), (-10.0, 0.0), (0.0, -10.0)), 0.098e-3, 0.046e-3, marks=pytest.mark.slow
        ),
    ],
    ids=["three, free", "four, free", "three on a circle", "four on a circle"],
)
def test_layouts_whose_limits_are_known(film, places_mm, worst, rms):
    """Within 8 mm at 1 N, from an independent search over layouts; the worst depends on the grid by 4 %."""
    electrodes = [
        Electrode.of_square(name, (1e-3 * x, 1e-3 * y), 3e-3) for name, (x, y) in zip("ABCD", places_mm, strict=False)
    ]
    layout = replace(film, sensor=replace(film.sensor, electrodes=tuple(electrodes)))
    assessed = assess_layout(ChargeSpline.of(layout), REFERENCE)
    assert assessed.worst == pytest.approx(worst, rel=0.04)
    assert assessed.rms == pytest.approx(rms, rel=0.015)
    assert assessed.determined


@pytest.fixture(scope="module")
def film():
    return ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1e-3), 8e-3)
