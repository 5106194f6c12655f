"""Forward maps compared with direct solves."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.simulate.conftest import COARSE

from drawn_contacts import draw_contacts
from isocharge.common.errors import SceneError, SolveError
from isocharge.simulate import (
    ChargeSpline,
    Circle,
    Domain,
    Electrode,
    Ellipse,
    Finger,
    ForwardMap,
    GrowingFinger,
    Polygon,
    Resolution,
    Theory,
    load_sensor,
)
from isocharge.simulate.forward import forward_map as forward_map_module
from isocharge.simulate.forward.charge_map import differences
from isocharge.simulate.forward.family import NODE_COUNTS, Family, NodeCount
from isocharge.simulate.forward.forward_map import INTERPOLATION_ERROR
from kept import kept
from solved_charges import relative_error, solved_charge, solved_charges, with_film, with_piezo

BIAXIAL = load_sensor("four-25um-biaxial")
PROBE = Circle(1.0)
QUICK = {"radius": 4.0, "force_range": (0.7, 1.0), "settings": COARSE}
"""A small family without bending: few and cheap solves."""
TRACED = Electrode.of_square("A", (5.0, 0.0), 3.0).with_trace(((5.0, 0.0), (-2.0, -1.0), (-9.0, -30.0)), 0.5)
"""An electrode whose trace crosses the positions of the presses."""


@pytest.fixture(params=[Polygon.triangle(2.5), pytest.param(Ellipse(2.0, 1.4), marks=pytest.mark.slow)])
def oriented_map(near_electrodes, request) -> ForwardMap:
    """A map of a probe whose orientation matters, for a sensor whose electrodes lie near the centre."""
    return kept(ForwardMap.build, near_electrodes, request.param, **QUICK)


def errors(forward_map: ForwardMap, contact: np.ndarray, rotation: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the errors of the charges of a map, compared with direct solves on the same mesh with the same theory.

    An error is relative to the charge, or to a tenth of the largest charge of the press if this is larger.
    """
    expected = solved_charges(forward_map.sensor, forward_map.probe, contact, forward_map.settings, rotation)
    scale = np.maximum(np.abs(expected), 0.1 * np.abs(expected).max(axis=1, keepdims=True))
    return np.abs(forward_map.charges(contact, rotation) - expected) / scale


def draw(forward_map: ForwardMap, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw contacts in the whole domain, and orientations (rad)."""
    rng, domain = np.random.default_rng(seed), forward_map.domain
    return draw_contacts(rng, count, domain.radius, domain.force_range), rng.uniform(-np.pi, np.pi, count)


def test_forward_map_agrees_with_direct_solves_between_the_nodes(three_map, near_map):
    """One map has all terms up to 8 mm. The other is a membrane with half of the presses on an electrode."""
    contact, _ = draw(near_map, 6, seed=1)
    contact[:4, :2] = [(4.9, 0.3), (0.2, 4.5), (-4.2, 0.0), (1.2, -4.5)]
    (low, high), radius = near_map.domain.force_range, near_map.domain.radius
    ends = [[radius, 0.0, low], [-radius, 0.0, high], [0.0, 0.0, low]]
    near_error = errors(near_map, np.concatenate([contact, ends]))
    assert max(near_error.max(), errors(three_map, draw(three_map, 3, seed=0)[0]).max()) < 1e-3
    assert near_error.max() / 3.0 < near_map.error <= INTERPOLATION_ERROR
    assert near_map.solves == len(near_map.table)  # a round probe needs no further rotations


def test_forward_map_agrees_with_direct_solves_for_random_orientations(oriented_map):
    """The charges have the period of the probe."""
    error = errors(oriented_map, *draw(oriented_map, 6, seed=10))
    assert np.quantile(error, 0.95) < 1e-3
    assert error.max() < 5e-3
    contact, rotation = draw(oriented_map, 50, seed=11)
    charge = oriented_map.charges(contact, rotation)
    np.testing.assert_allclose(oriented_map.charges(contact, rotation + oriented_map.probe.period), charge, rtol=1e-6)


def test_footprint_grows_with_the_cube_root_of_the_force(near_electrodes):
    """The expected charges are those of fingers with the radius that each force has, solved one by one."""
    wide_range = QUICK | {"radius": 2.5, "force_range": (0.125, 1.0)}
    sensor = with_piezo(near_electrodes, d33=-20.0)
    growing = ForwardMap.build(sensor, GrowingFinger(2.0), **wide_range)
    contact, _ = draw(growing, 3, seed=3)
    expected = np.array(
        [
            solved_charge(sensor, Finger(2.0 * force ** (1.0 / 3.0)), (x, y), force, growing.settings)
            for x, y, force in contact.tolist()
        ]
    )
    largest = np.abs(expected).max(axis=1, keepdims=True)
    assert (np.abs(growing.charges(contact) - expected) / largest).max() < 1e-3
    assert (np.abs(ChargeSpline.of(growing).charges(contact) - expected) / largest).max() < 1e-3


@pytest.mark.parametrize(
    "changes",
    [
        {"readout": "edge"},
        {"piezo": BIAXIAL.piezo},
        {"calibration": replace(BIAXIAL.calibration, shift=(0.5, -0.3), rotation=0.1)},
        {"electrodes": (TRACED, Electrode.of_square("B", (0.0, 5.0), 3.0))},
    ],
    ids=["edge", "biaxial", "calibrated", "traces"],
)
def test_one_family_of_solves_serves_every_readout(near_map, changes):
    other = replace(near_map, sensor=replace(near_map.sensor, **changes))
    assert errors(other, draw(near_map, 5, seed=4)[0]).max() < 1e-3


def test_contact_pressure(oriented_map):
    """d33 counts on the electrode under the probe, however the probe is rotated."""
    sensor = with_piezo(oriented_map.sensor, d33=-30.0)
    contact, rotation = draw(oriented_map, 4, seed=6)
    contact[:, :2] = 0.55 * np.array([electrode.centre for electrode in sensor.electrodes])  # across the inner edges
    assert errors(replace(oriented_map, sensor=sensor), contact, rotation).max() < 1e-3


FILMS = {
    "pretension": ({"pretension": 0.5}, "middle", Theory(bending=False)),
    "plate": ({"thickness": 1.0}, "middle", Theory(bending=True)),
    "surface": ({}, "top", Theory(bending=True)),
}


@pytest.mark.parametrize(("film", "surface", "theory"), FILMS.values(), ids=FILMS)
def test_forward_map_of_other_films(near_electrodes, film, surface, theory):
    sensor = replace(with_film(near_electrodes, **film), surface=surface)
    settings = replace(COARSE, theory=theory)
    forward_map = ForwardMap.build(sensor, PROBE, 2.0, (0.8, 1.0), settings)
    assert errors(forward_map, draw(forward_map, 4, seed=7)[0]).max() < 1e-3


def test_zero_force_gives_zero_charges(three_map):
    """Contacts with zero force may have any position. They are counted in the index of an error message."""
    contact = np.array([[1.0, 0.0, 0.0], [50.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [2.0, 0.0, 1.0]])
    charge = three_map.charges(contact)
    assert not charge[:3].any()
    np.testing.assert_allclose(charge[3:], three_map.charges(contact[3:]))
    with pytest.raises(SceneError, match=r"press 3 at \(8\.1, 0\) mm with 1 N is outside the forward map"):
        three_map.charges(np.concatenate([contact[:3], [[8.1, 0.0, 1.0]]]))


def test_orientations_that_are_not_finite_are_refused(three_map):
    with pytest.raises(SceneError, match=r"expected finite orientations in rad, got .*nan"):
        three_map.charges(np.full((2, 3), 1.0), np.array([0.0, np.nan]))


def test_derivatives_of_a_map_with_a_single_force_are_refused(near_electrodes):
    single = QUICK | {"force_range": (1.0, 1.0)}
    forward_map = kept(ForwardMap.build, near_electrodes, PROBE, **single)
    with pytest.raises(SceneError, match=r"one of the force 1 N; build a map from 0\.9 to 1\.1 N"):
        forward_map.derivatives(np.array([[1.0, 0.0, 1.0]]))


@pytest.mark.slow
def test_forward_map_reaches_40_mm_on_a_taut_film_of_45_mm():
    """Near the clamp the fields change over the distance from the press to the clamp."""
    sensor = load_sensor("eight-25um-biaxial-36mm")
    forward_map = kept(ForwardMap.build, sensor, PROBE, 40.0, (1.0, 1.0))
    assert forward_map.error <= INTERPOLATION_ERROR
    contact = np.array([[39.9, 0.9, 1.0], [-20.0, 34.2, 1.0], [0.7, -0.4, 1.0]])
    assert errors(forward_map, contact).max() < 1e-3


def test_charges_of_many_presses_equal_those_of_single_presses(three_map, oriented_map):
    """There are more presses than in one chunk, and an empty array is accepted."""
    for forward_map in (three_map, oriented_map):
        contact, rotation = draw(forward_map, 300, seed=8)
        charge = forward_map.charges(contact, rotation)
        for i in (0, 1, 255, 256, 299):
            one = forward_map.charges(contact[i : i + 1], rotation[i : i + 1])[0]
            np.testing.assert_allclose(charge[i], one, rtol=1e-11)
    assert three_map.charges(np.empty((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"radius": -1.0}, "radius: expected a positive number, got -1 mm"),
        ({"radius": 44.5}, r"presses up to 44\.5 mm from the centre with circle:1\.0, which reaches 1 mm, leave"),
    ],
)
def test_invalid_domains_raise_error(arguments, message):
    with pytest.raises(SceneError, match=message):
        ForwardMap.build(load_sensor("three-25um-biaxial"), PROBE, **arguments)


def test_unreachable_interpolation_error_raises_solve_error(monkeypatch):
    monkeypatch.setattr("isocharge.simulate.forward.forward_map.INTERPOLATION_ERROR", 1e-13)
    monkeypatch.setattr("isocharge.simulate.forward.family.NODE_COUNTS", NODE_COUNTS[:2])
    settings = replace(COARSE, resolution=Resolution(3, 8, 2))
    with pytest.raises(SolveError, match=r"up to 4 mm and 1 N interpolates to .* only, expected 1e-13"):
        ForwardMap.build(load_sensor("three-25um-biaxial"), PROBE, **{**QUICK, "settings": settings})


@pytest.mark.parametrize(("error", "tried"), [(0.5, [0, 2]), (1.5 * INTERPOLATION_ERROR, [0, 1])])
def test_next_number_of_nodes_is_skipped_if_the_error_is_very_large(near_map, monkeypatch, error, tried):
    counts = [NodeCount(number, number) for number in (2, 3, 4)]
    built = []
    build = partial(kept, ForwardMap.build_unchecked)

    def build_unchecked(sensor, probe, domain, count, settings, **_):
        built.append(counts.index(count))
        return build(sensor, probe, domain, counts[0], settings)

    monkeypatch.setattr(ForwardMap, "build_unchecked", build_unchecked)
    monkeypatch.setattr(forward_map_module, "node_counts", lambda _: counts)
    monkeypatch.setattr(forward_map_module, "relative_error", lambda *_: error if len(built) == 1 else 0.0)
    ForwardMap.build(near_map.sensor, PROBE, **QUICK)
    assert built == tried


UNEVEN_FILMS = {
    "tension": {"pretension": 0.75, "deviator": (0.25, 0.1)},
    "moduli": {"young_ratio": 3.4 / 2.4, "shear": 1100.0, "axis": 0.35},
    "oval": {"oval": 0.01, "oval_axis": 0.4},
}
"""Properties that make a film differ from an axisymmetric film."""


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    ("changes", "probe", "orientation"),
    [
        (
            UNEVEN_FILMS["tension"] | UNEVEN_FILMS["moduli"] | UNEVEN_FILMS["oval"],
            Ellipse(2.0, 1.4).rotated(0.5),
            "fixed",
        ),
        (UNEVEN_FILMS["moduli"], Polygon.triangle(2.5), "fixed"),
        (UNEVEN_FILMS["moduli"], Polygon.triangle(2.5), "random"),
        *((changes, PROBE, "fixed") for changes in UNEVEN_FILMS.values()),
    ],
)
def test_maps_of_films_that_are_not_axisymmetric_agree_with_direct_solves(near_electrodes, changes, probe, orientation):
    """The presses lie in all directions from the centre."""
    sensor = with_film(near_electrodes, **changes)
    settings = QUICK | {"force_range": (1.0, 1.0), "orientation": orientation}
    forward_map = kept(ForwardMap.build, sensor, probe, **settings)
    contact, rotation = draw(forward_map, 3, seed=12)
    assert errors(forward_map, contact, rotation if orientation == "random" else 0.0).max() < 1e-3


@pytest.mark.parametrize(("probe", "solves"), [(PROBE, 7), (Ellipse(2.0, 1.4), 5), (Polygon.triangle(2.5), 9)])
def test_a_probe_that_keeps_its_orientation_needs_few_turns(near_electrodes, probe, solves):
    """Nine harmonics of the rotation: an ellipse and the film are the same after half a turn, a triangle is not."""
    film = with_film(near_electrodes, **UNEVEN_FILMS["tension"]).film
    family = Family.spread(Domain(4.0, (1.0, 1.0)), film, probe, NodeCount(1, 1))
    assert len(family.turns.solved) == solves


def test_rotation_of_a_probe_whose_map_has_its_own_orientation_is_refused(near_electrodes):
    sensor = with_film(near_electrodes, **UNEVEN_FILMS["tension"])
    domain = Domain(1.0, (1.0, 1.0))
    oriented = ForwardMap.build_unchecked(sensor, Ellipse(2.0, 1.4), domain, NodeCount(1, 1, (1,)), COARSE)
    with pytest.raises(SceneError, match=r"ellipse:2.0x1.4 in its own orientation, got a rotation by 0.1 rad"):
        oriented.charges(np.array([(0.5, 0.0, 1.0)]), 0.1)


@pytest.mark.slow
def test_taut_film_with_a_ratio_of_three_between_its_pretensions_is_interpolated():
    """Under a small force, the pretension alone determines the charges, and they contain many harmonics."""
    taut = with_film(BIAXIAL, pretension=2.4, deviator=(1.2, 0.0))
    assert ForwardMap.build(taut, PROBE, 8.0, (0.05, 0.05)).error <= INTERPOLATION_ERROR


@pytest.mark.slow
def test_derivatives_under_a_narrow_probe_are_those_of_direct_solves():
    """The electrode has more integration points in a direct solve, so its differences allow short steps."""
    sensor = replace(BIAXIAL, electrodes=(Electrode.of_square("A", (0.0, 3.0), 2.0),))
    narrow = kept(ForwardMap.build, sensor, Ellipse(2.0, 0.1), 3.5, (0.9, 1.1), replace(COARSE, resolution="auto"))
    contact = np.array([[-0.11, 3.12, 1.0], [0.19, 3.29, 1.0], [0.55, 3.2, 1.0]])
    solved = partial(solved_charges, sensor, narrow.probe, settings=narrow.settings)
    assert relative_error(narrow.derivatives(contact), differences(solved, contact, (0.02, 0.02, 1e-3))) < 0.02
